"""The parts of a page: texts, images, and what lies in the package."""

import base64
import io
import re

import jinja2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from twofold.errors import TwofoldError
from twofold.html.page import TEMPLATES, Table, embedded_image, paragraphs, render, rich_text


@given(st.text())
def test_no_text_becomes_a_tag_of_its_own(text: str) -> None:
    for made in (rich_text(text), paragraphs(text)):
        tags = {part.partition(">")[0].split()[0] for part in str(made).split("<")[1:]}
        assert tags <= {"p", "/p", "code", "/code", "a", "/a"}


def test_paragraphs_are_parted_by_blank_lines() -> None:
    assert str(paragraphs("One `a<b`.\n\nTwo.\n")) == "<p>One <code>a&lt;b</code>.</p><p>Two.</p>"
    assert str(paragraphs(" ")) == ""


def test_an_image_holds_the_content_that_it_was_given(tmp_path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (12, 9, 3), dtype=np.uint8)
    made = embedded_image(pixels, "caption")
    assert (made.width, made.height, made.caption) == (9, 12, "caption")
    content = base64.b64decode(made.source.removeprefix("data:image/png;base64,"), validate=True)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(content))), pixels)
    Image.fromarray(pixels).save(tmp_path / "a.jpg")
    kept = embedded_image(tmp_path / "a.jpg")
    assert base64.b64decode(kept.source.removeprefix("data:image/jpeg;base64,")) == (tmp_path / "a.jpg").read_bytes()


def test_a_missing_or_unknown_image_is_one_sentence(tmp_path) -> None:
    with pytest.raises(TwofoldError, match=r"image .*a\.png is missing"):
        embedded_image(tmp_path / "a.png")
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(TwofoldError, match=r"a\.exr is not one of \.png, \.jpg"):
        embedded_image(tmp_path / "a.exr")


def test_a_page_that_was_not_given_what_it_shows_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError):
        render("report.html", title="x")


def test_wide_tables_scroll_and_narrow_ones_stack_on_a_phone() -> None:
    def shown(columns: int) -> str:
        tables = [{"kind": "tables", "parts": [Table(("a",) * columns, (("b",) * columns,))]}]
        section = {"heading": "x", "text": "", "boxes": tables}
        return render(
            "report.html", title="x", subtitle="", key_metrics=[], lead=None, sections=[section], credit="",
            script=None, policy="",
        ).decode()  # fmt: skip

    assert '<div class="stack">' in shown(3)
    assert '<div class="scroll">' in shown(4)


@pytest.mark.parametrize("file", sorted(TEMPLATES.iterdir()), ids=lambda file: file.name)
def test_no_file_of_the_package_names_a_host(file) -> None:
    text = file.read_text()
    assert "://" not in text
    assert "@import" not in text
    assert "url(" not in text
    # No script but the one that the page's policy names by its hash; data elements have a type that is not run.
    scripts = re.findall(r"<script[^>]*>", text)
    run = [tag for tag in scripts if not re.search(r' type="(application/json|text/plain)"', tag)]
    assert run == (["<script>"] if file.name == "report.html" else [])
    assert text.count("<script>{{ script }}</script>") == len(run)


def test_colors_of_the_light_page_are_those_of_the_dark_one() -> None:
    light, dark = (TEMPLATES / "base.css").read_text().split("prefers-color-scheme: dark")
    names = {part.split(":")[0].strip() for part in light.split("--")[1:]} - {"mono"}
    assert names == {part.split(":")[0].strip() for part in dark.split("}")[0].split("--")[1:]}
