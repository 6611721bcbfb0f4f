"""Masks as a fit needs them: how far each place is from the person, and where the outline runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage
from torch import Tensor

from twofold.images import read_grey
from twofold.kernels.parallel import in_parts

GRID = 128
"""Cells along the longer side of a mask's surroundings; a cell is about one percent of a person's height."""

POINTS = 160
"""Points along an outline, some 3 cm apart."""

_MARGIN = 0.35
"""Surroundings of a mask, as a share of its longer side: what is farther off counts as this far."""


@dataclass(frozen=True)
class Outlines:
    """The masks of one camera through a clip.

    Attributes:
        outside: how far a cell is from the person, pixels; 0 inside.
        corner: pixel (column, row) at the centre of each grid's first cell.
        cell: pixels from one cell to the next.
        points: places on the outline, pixels (column, row).
        normals: of the outline there, unit, outwards.
        known: 1 for frames with a mask, else 0; the others' arrays hold nothing of use.
        size: median over the clip of the longer side of the mask's box, pixels.
    """

    outside: Float[Tensor, "t g g"]
    corner: Float[Tensor, "t 2"]
    cell: Float[Tensor, "t"]
    points: Float[Tensor, "t k 2"]
    normals: Float[Tensor, "t k 2"]
    known: Float[Tensor, "t"]
    size: float

    def __getitem__(self, times: slice) -> "Outlines":
        parts = {name: value[times] for name, value in vars(self).items() if name != "size"}
        return Outlines(**parts, size=self.size)

    def away(self, pixels: Float[Tensor, "t n 2"]) -> Float[Tensor, "t n"]:
        """How far places are from the person, pixels, differentiable; 0 inside."""
        place = (pixels - self.corner[:, None]) / self.cell[:, None, None]
        # A number that is not finite would crash the lookup.
        place = torch.nan_to_num(2 * place / (GRID - 1) - 1, nan=0.0, posinf=9.0, neginf=-9.0)
        found = torch.nn.functional.grid_sample(
            self.outside[:, None], place[:, :, None], padding_mode="border", align_corners=True
        )
        return found[:, 0, :, 0]


Mask = UInt8[np.ndarray, "h w"] | Path
"""A mask (0..255, the person above 127) or the image file that holds it."""


def open_mask(mask: Mask) -> UInt8[np.ndarray, "h w"]:
    """The mask as an array.

    Raises:
        TwofoldError: its file is damaged.
    """
    if not isinstance(mask, Path):
        return mask
    return read_grey(mask)


def trace_outlines(masks: Sequence[Mask]) -> Outlines:
    """Outlines of the masks of a clip."""
    parts = in_parts(len(masks), lambda a, b: [_trace(open_mask(mask)) for mask in masks[a:b]], 8, long=True)
    traced = [one for part in parts for one in part]
    outside, corner, cell, points, normals, longer = (
        torch.from_numpy(np.stack(part)).float() for part in zip(*traced, strict=True)
    )
    size = float(longer[longer > 0].median()) if bool((longer > 0).any()) else 1.0
    return Outlines(outside, corner, cell, points, normals, (longer > 0).float(), size)


def _trace(mask: UInt8[np.ndarray, "h w"]) -> tuple[np.ndarray, ...]:
    rows, columns = (np.flatnonzero((mask > 127).any(axis)) for axis in (1, 0))
    if len(rows) < 3 or len(columns) < 3:
        # Without a person everything would be infinitely far from one.
        nothing = np.zeros((POINTS, 2))
        return np.zeros((GRID, GRID)), np.zeros(2), np.ones(()), nothing, nothing, np.zeros(())
    low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])
    longer = float((high - low).max() + 1)
    side = int(np.ceil(longer * (1 + 2 * _MARGIN)))
    left, top = np.floor((low + high) / 2 - side / 2).astype(int).tolist()
    cell = side / GRID
    corner = np.array([left, top]) + (cell - 1) / 2
    window = Image.fromarray(mask).crop((left, top, left + side, top + side))
    # Areas where pixels are smaller than cells; where they are larger, areas would make stairs.
    grid = np.asarray(window.resize((GRID, GRID), Image.Resampling.BOX if cell > 1 else Image.Resampling.BILINEAR))
    centers = corner[:, None] + cell * np.arange(GRID)
    # Beyond the image nothing is known: the person may go on there.
    beyond = ~(
        ((centers[1] > -0.5) & (centers[1] < mask.shape[0] - 0.5))[:, None]
        & ((centers[0] > -0.5) & (centers[0] < mask.shape[1] - 0.5))[None]
    )
    person = grid > 127
    outside = np.asarray(ndimage.distance_transform_edt(~person)) * cell if person.any() else np.zeros((GRID, GRID))
    points, normals = _outline(grid, beyond)
    return np.where(beyond, 0, outside), corner, np.array(cell), corner + cell * points, normals, np.array(longer)


def _outline(
    grid: UInt8[np.ndarray, "g g"], beyond: np.ndarray
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]:
    """Evenly many points along the half-way level of a mask, in cells, and the outward normals."""
    from skimage.measure import find_contours

    smooth = ndimage.gaussian_filter(grid.astype(np.float32), 0.7)
    pieces = [piece for piece in find_contours(np.pad(smooth, 1), 127.5) if len(piece) > 8]
    if not pieces:
        return np.zeros((POINTS, 2)), np.zeros((POINTS, 2))
    places = np.concatenate(pieces) - 1
    cells = np.clip(np.rint(places).astype(int), 0, GRID - 1)
    near = np.asarray(ndimage.binary_dilation(beyond, iterations=2), dtype=bool)
    places = places[~near[cells[:, 0], cells[:, 1]]]
    if len(places) == 0:
        return np.zeros((POINTS, 2)), np.zeros((POINTS, 2))
    places = places[np.linspace(0, len(places) - 1, POINTS).round().astype(int)]
    slope = np.stack([ndimage.map_coordinates(-g, places.T, order=1, mode="nearest") for g in np.gradient(smooth)], 1)
    normals = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    return places[:, ::-1], normals[:, ::-1]
