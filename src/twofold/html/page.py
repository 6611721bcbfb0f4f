"""HTML pages from the templates of this package: Jinja2 with every text escaped, style and images inside the page.

A page needs nothing else and asks no host for anything; it has no script but that of the interactive character
(`twofold.html.interactive`), is readable on a phone, and follows the reader's choice of light or dark.
"""

import base64
import functools
import html
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxtyping import UInt8
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from numpy import ndarray
from PIL import Image

from twofold.errors import TwofoldError
from twofold.images import read_header

TEMPLATES = Path(__file__).parent / "templates"
IMAGE_KINDS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}
"""Files that every browser shows, by the end of their name."""


@dataclass(frozen=True)
class KeyMetric:
    """One of the large numbers at the top.

    Attributes:
        label: what it is.
        value: as it is to be read, "27.1".
        unit: behind the value.
        goal: what it should be, "at least 26 dB"; empty for none.
        met: whether it is.
    """

    label: str
    value: str
    unit: str = ""
    goal: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Table:
    """Lines of text under headings; a line of a single cell is a heading within the table."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    folded: str = ""
    """Where given, the table is shown when these words are clicked."""


@dataclass(frozen=True)
class EmbeddedVideo:
    """A video as the page holds it.

    Attributes:
        source: a data address with the whole content.
        caption: below it; empty for none.
        size: width and height, pixels, where they are known.
    """

    source: str
    caption: str = ""
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class EmbeddedImage:
    """An image as the page holds it.

    Attributes:
        source: a data address with the whole content.
        width: pixels.
        height: pixels.
        caption: below it; empty for none.
    """

    source: str
    width: int
    height: int
    caption: str = ""


def render(template: str, **values: object) -> bytes:
    """A whole page, UTF-8.

    Args:
        template: a file of `templates`, "report.html" for instance.
        values: what it shows, by name; texts are escaped, `Markup` and the drawings of `charts` are not.
    """
    # A file's name may hold bytes that are no text.
    return _environment().get_template(template).render(values).encode(errors="replace")


def rich_text(text: str) -> Markup:
    """Escaped text with `code` and links.

    >>> str(rich_text("`a < b`, see https://example.org."))
    '<code>a &lt; b</code>, see <a href="https://example.org">https://example.org</a>.'
    """
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return Markup(re.sub(r"https?://[^\s<]*[^\s<.,;:)]", r'<a href="\g<0>">\g<0></a>', escaped))


def paragraphs(text: str) -> Markup:
    """Text whose paragraphs are parted by blank lines, each as `rich_text`."""
    parts = (part for part in re.split(r"\n\s*\n", text.strip()) if part)
    return Markup("").join(Markup("<p>{}</p>").format(rich_text(part)) for part in parts)


def embedded_image(
    image: Path | UInt8[ndarray, "h w c"], caption: str = "", kind: Literal["png", "jpeg"] = "png"
) -> EmbeddedImage:
    """An image with its content inside.

    Args:
        image: a file (PNG, JPEG, WebP), taken as it is, or pixels (of three channels, or as PNG with opacity of four).
        caption: to show below it.
        kind: how pixels are stored.

    Raises:
        TwofoldError: the file is missing or of another kind.
    """
    if isinstance(image, Path):
        found = IMAGE_KINDS.get(image.suffix.lower())
        if found is None or not image.is_file():
            problem = "is missing" if found else f"is not one of {', '.join(IMAGE_KINDS)}"
            raise TwofoldError(f"The report's image {image} {problem}.")
        content, stored = image.read_bytes(), found
        header = read_header(image)
        width, height = header.width, header.height
    else:
        buffer = io.BytesIO()
        options = {"quality": 92, "subsampling": 0} if kind == "jpeg" else {"optimize": True}
        Image.fromarray(image).save(buffer, kind.upper(), **options)
        content, stored, (height, width) = buffer.getvalue(), kind, image.shape[:2]
    return EmbeddedImage(f"data:image/{stored};base64,{base64.b64encode(content).decode()}", width, height, caption)


def embedded_video(path: Path, caption: str = "", size: tuple[int, int] | None = None) -> EmbeddedVideo:
    """A video (MP4) with its content inside, of this width and height.

    Raises:
        TwofoldError: the file is missing or of another kind.
    """
    if path.suffix.lower() != ".mp4":
        raise TwofoldError(f"The report's video {path} is no .mp4.")
    if not path.is_file():
        raise TwofoldError(f"The report's video {path} is missing; render it first.")
    return EmbeddedVideo(f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}", caption, size)


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(rich=rich_text, paragraphs=paragraphs)
    return environment
