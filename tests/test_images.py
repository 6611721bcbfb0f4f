"""Images that are none, are cut, or are far larger than they look."""

import io
import struct
import subprocess
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image, ImageOps

from twofold import images
from twofold.errors import TwofoldError
from twofold.images import MAX_PIXELS, load_image, read_grey, read_header, read_rgb, upright_size

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n"


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *after: bytes) -> bytes:
    """A PNG whose checksums are all right, grey, with any content behind its header."""
    start = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + start + b"".join(after) + chunk(b"IEND", b"")


def image(**options) -> Image.Image:
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8), **options)


def refusal(read, path) -> str:
    with pytest.raises(TwofoldError) as error:  # warnings are errors, too
        read(path)
    text = str(error.value)
    assert "\n" not in text
    assert str(path) in text
    return text


@pytest.mark.parametrize("kind", images.FORMATS)
def test_each_format_is_read_and_known_by_its_content(kind, tmp_path):
    image().save(tmp_path / "a.png", kind, **({"lossless": True} if kind == "WEBP" else {}))
    header = read_header(tmp_path / "a.png")
    assert (header.width, header.height, header.mode) == (30, 20, "RGB")
    assert load_image(tmp_path / "a.png").size == (30, 20)
    assert read_grey(tmp_path / "a.png").shape == (20, 30)
    if kind != "JPEG":
        np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), np.asarray(image()))


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_the_size_is_told_the_right_way_up_as_is_the_image(kind, orientation, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = orientation
    image().save(tmp_path / "a", kind, exif=exif)
    assert upright_size(tmp_path / "a") == ((20, 30) if orientation == 6 else (30, 20))
    assert ImageOps.exif_transpose(load_image(tmp_path / "a")).size == upright_size(tmp_path / "a")


def test_nothing_that_starts_another_program_is_opened(tmp_path, monkeypatch):
    def started(*arguments, **options):
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "Popen", started)
    (tmp_path / "a.png").write_bytes(EPS)
    for read in (read_header, load_image, read_rgb, read_grey):
        assert "is no image of a known kind" in refusal(read, tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["GIF", "PPM", "ICO", "PDF", "TGA", "PCX"])
def test_other_formats_are_refused(kind, tmp_path):
    image().save(tmp_path / "a.png", kind)
    assert "is no image of a known kind (PNG, JPEG, WEBP, TIFF, BMP)" in refusal(load_image, tmp_path / "a.png")


BROKEN = {
    "no pixels": png(30, 20),
    "few pixels": png(30, 20, chunk(b"IDAT", zlib.compress(bytes(31 * 20))[:9])),
    "no compression": png(30, 20, chunk(b"IDAT", b"these are no pixels")),
    "a filter that there is not": png(3, 2, chunk(b"IDAT", zlib.compress(b"\x09abc\x09abc"))),
    "no size": png(0, 20, chunk(b"IDAT", zlib.compress(bytes(31)))),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_pillow_verifies_but_cannot_decode_is_damaged(name, tmp_path):
    (tmp_path / "a.png").write_bytes(BROKEN[name])
    if name not in ("no size", "no pixels"):
        with Image.open(tmp_path / "a.png") as image:
            image.verify()
    for read in (load_image, read_rgb, read_grey):
        assert "is damaged" in (said := refusal(read, tmp_path / "a.png")) or "no image" in said


@pytest.mark.parametrize("kind", images.FORMATS)
def test_cut_files_are_damaged(kind, tmp_path):
    buffer = io.BytesIO()
    image().save(buffer, kind)
    for share in (0.1, 0.5, 0.9):
        (tmp_path / "a.png").write_bytes(buffer.getvalue()[: int(share * len(buffer.getvalue()))])
        refusal(read_rgb, tmp_path / "a.png")


@pytest.mark.parametrize("side", [9_000, 12_000, 30_000, 2**31 - 1])
@pytest.mark.parametrize("read", [read_header, load_image])
def test_bombs_are_one_sentence_without_a_warning(read, side, tmp_path):
    assert side**2 > MAX_PIXELS
    (tmp_path / "a.png").write_bytes(png(side, side, chunk(b"IDAT", zlib.compress(bytes(99)))))
    assert "has more pixels than the 80 million of a large image" in refusal(read, tmp_path / "a.png")


def test_many_threads_leave_the_list_of_warnings_as_it_was(tmp_path):
    (tmp_path / "a.png").write_bytes(png(9_500, 9_500))
    image().save(tmp_path / "b.png")
    before = list(warnings.filters)

    def read(name: str) -> None:
        if name == "a.png":
            refused = pytest.raises(TwofoldError)
            with refused:
                read_header(tmp_path / name)
        else:
            read_rgb(tmp_path / name)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(read, ["a.png", "b.png"] * 40))
    assert list(warnings.filters) == before
