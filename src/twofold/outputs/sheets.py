"""Images side by side with labels, and images of what has no colour of its own: normals, differences."""

from collections.abc import Sequence
from typing import TypeAlias

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from twofold.geometry.cameras import Camera
from twofold.metrics.image import to_8bit

SheetImage: TypeAlias = Float[Tensor, "_ _ 3"] | Float[Tensor, "_ _"] | UInt8[np.ndarray, "_ _ 3"]
"""Colours or shades in 0..1, or bytes as they are stored."""

Font: TypeAlias = ImageFont.FreeTypeFont | ImageFont.ImageFont
PAPER, INK, FAINT = (255, 255, 255), (32, 34, 38), (112, 116, 124)


def sheet(
    rows: Sequence[Sequence[SheetImage | None]],
    row_labels: Sequence[str] = (),
    column_labels: Sequence[str] = (),
    title: str = "",
    footer: str = "",
    height: int | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """A table of images on white, labelled above the columns and left of the rows.

    Args:
        rows: images, or None for an empty place; rows may differ in length.
        row_labels: one for each row, or none; long ones are broken between words.
        column_labels: one for each column, or none.
        title: above it all.
        footer: below it all, for credit and explanation.
        height: of every image in pixels; by default that of the tallest. Widths follow.

    Raises:
        ValueError: there is no image, or the labels do not match the table.
    """
    images = [[None if p is None else as_bytes(p) for p in row] for row in rows]
    present = [p for row in images for p in row if p is not None]
    columns = max((len(row) for row in rows), default=0)
    if not present:
        raise ValueError("a sheet needs at least one image")
    for labels, count, name in ((row_labels, len(rows), "row"), (column_labels, columns, "column")):
        if labels and len(labels) != count:
            raise ValueError(f"the sheet has {count} {name}s, but {len(labels)} {name} labels came")
    tall = height or max(p.shape[0] for p in present)
    cells = [[None if p is None else _scaled(p, tall) for p in row] for row in images]

    size = round(min(max(0.062 * tall, 13), 34))
    font, large, small = (ImageFont.load_default(s) for s in (size, 1.35 * size, 0.85 * size))
    gap = max(size // 3, 4)
    margin = 2 * size
    widths = [_column_width(cells, column, column_labels, font) for column in range(columns)]
    lines = [_broken(label, font, 7 * size) for label in row_labels]
    left = margin + (max(_extent(line, font) for text in lines for line in text) + size if row_labels else 0)
    top = margin + (round(2.3 * size) if title else 0) + (round(1.6 * size) if column_labels else 0)
    page_width = max(left + sum(widths) + gap * (columns - 1) + margin, round(2 * margin + _extent(title, large)))
    notes = _broken(footer, small, page_width - 2 * margin) if footer else []
    bottom = top + len(cells) * tall + gap * (len(cells) - 1)
    page = Image.new("RGB", (page_width, bottom + margin + round(1.2 * size * len(notes))), PAPER)
    draw = ImageDraw.Draw(page)

    if title:
        draw.text((margin, margin), title, INK, large, anchor="lt")
    starts = [left + sum(widths[:i]) + gap * i for i in range(columns)]
    for start, width, label in zip(starts, widths, column_labels, strict=False):
        draw.text((start + width / 2, top - 0.55 * size), label, INK, font, anchor="ms")
    for i, row in enumerate(cells):
        y = top + i * (tall + gap)
        for start, width, cell in zip(starts, widths, row, strict=False):
            if cell is not None:
                page.paste(cell, (start + (width - cell.width) // 2, y))
        for j, line in enumerate(lines[i] if lines else []):
            baseline = y + tall / 2 + 1.25 * size * (j + 0.5 - len(lines[i]) / 2)
            draw.text((left - size, baseline), line, INK, font, anchor="rm")
    for j, line in enumerate(notes):
        draw.text((margin, bottom + 0.75 * size + 1.2 * size * j), line, FAINT, small, anchor="lt")
    return np.asarray(page).copy()


ERROR_RANGE = 0.25
"""The mean absolute difference of colours that an error map shows brightest."""


def error_map(color: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Mean absolute difference of the channels, from black (0) over red to pale yellow (`ERROR_RANGE` and more)."""
    error = ((color - truth).abs().mean(-1) / ERROR_RANGE).clamp(0, 1)
    return torch.from_numpy(matplotlib.colormaps["inferno"](error.cpu().numpy())[..., :3]).float()


def color_normals(
    normals: Float[Tensor, "h w 3"], opacity: Float[Tensor, "h w"], camera: Camera | None = None
) -> Float[Tensor, "h w 3"]:
    """Normals as colours on white: red to the right, green up, blue towards the viewer.

    Args:
        normals: composited along rays, so of any length up to 1.
        opacity: share of each pixel that is covered.
        camera: turns world normals to the viewer, so that colours mean the same from all sides; without, world axes.
    """
    if camera is not None:
        upright = torch.tensor([1.0, -1.0, -1.0], device=normals.device)
        normals = (normals @ camera.world_to_camera[:3, :3].to(normals).T) * upright
    unit = normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return 1 + opacity[..., None] * (0.5 * unit - 0.5)


def residual_image(
    full: Float[Tensor, "h w 3"], base: Float[Tensor, "h w 3"], gain: float = 1.0
) -> Float[Tensor, "h w 3"]:
    """What the detail branch adds to the base: grey where nothing, brighter or darker by `gain` times the change."""
    return (0.5 + gain * (full - base)).clamp(0, 1)


def as_bytes(image: SheetImage) -> UInt8[np.ndarray, "h w 3"]:
    """Any image as three bytes a pixel; shades become grey."""
    if isinstance(image, np.ndarray):
        return image
    stored = to_8bit(image).cpu().numpy()
    return stored if stored.ndim == 3 else np.repeat(stored[..., None], 3, axis=-1)


def _scaled(source: np.ndarray, height: int) -> Image.Image:
    image = Image.fromarray(source)
    if image.height == height:
        return image
    width = max(round(image.width * height / image.height), 1)
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _column_width(cells: list[list[Image.Image | None]], column: int, labels: Sequence[str], font: Font) -> int:
    column_cells = [row[column] for row in cells if column < len(row)]
    widths = [cell.width for cell in column_cells if cell is not None]
    return max([*widths, _extent(labels[column], font) if labels else 1])


def _extent(text: str, font: Font) -> int:
    return round(font.getlength(text))


def _broken(text: str, font: Font, width: int) -> list[str]:
    """Lines of whole words that fit the width; one word alone may be wider."""
    lines: list[str] = []
    for word in text.split():
        if lines and _extent(f"{lines[-1]} {word}", font) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines or [""]
