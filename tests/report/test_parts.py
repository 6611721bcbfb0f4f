"""The report: a page that stands alone, shows what it was given, and lets no text break it."""

import base64
import io
import json
import math
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from twofold.errors import TwofoldError
from twofold.report.parts import (
    CaptionedImage,
    Chart,
    Commands,
    Curve,
    KeyMetric,
    Row,
    Section,
    Table,
    Video,
    key_metric,
    metrics_table,
    number,
    write_report,
)

METRICS = {
    "novel_view": {
        "psnr_box": {"value": 27.3, "protocol": "over the box"},
        "each": [1.0, 2.0],
        "images": 6,
        "by_camera": {"left": 1728, "right": 0.5},
    },
    "geometry": {"chamfer_cm": {"value": None, "protocol": "no true mesh"}},
    "seconds": {"total": 151.26},
    "recipe": "quick",
}
VOID = {"meta", "img", "br", "path", "link", "input"}


class Page(HTMLParser):
    """Every element with its attributes, all text, and whether tags close in the order they opened."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (12, 9, 3), dtype=np.uint8)


def full_page(folder: Path) -> Page:
    (folder / "films").mkdir()
    (folder / "films" / "a turn.mp4").write_bytes(b"film")
    Image.fromarray(image(1)).save(folder / "kept.png")
    path = write_report(
        folder,
        "Seed 3",
        [
            Section(
                "Unseen views",
                "First `code`.\n\nSecond, https://example.org/a.",
                (
                    Row((CaptionedImage(image(), "truth"), CaptionedImage(folder / "kept.png", "avatar")), "Camera 2"),
                    Row((CaptionedImage(torch.zeros(4, 4, 3)), CaptionedImage(torch.ones(4, 4)))),
                ),
            ),
            Section("Motion", "", (Video("films/a turn.mp4", "once around"),)),
            Section(
                "Training", "", (Chart("loss", (Curve("total", [0, 1], [1.0, 0.5]), Curve("part", [0], [1.0]))),) * 2
            ),
            Section("Figures", "", (metrics_table(METRICS),)),
            Section("Go on", "", (Commands((("twofold render run --size <n>", "Larger."),)),)),
        ],
        subtitle="40 frames",
        key_metrics=[
            KeyMetric("Novel view", "27.3", "dB", "26 dB", True),
            KeyMetric("Pose", "20.1", "dB", "24 dB", False),
        ],
        lead=CaptionedImage(image(2)),
        credit="By nobody.",
    )
    assert path == folder / "report.html"
    return Page(path.read_text(encoding="utf-8"))


def test_page_shows_all_it_was_given(tmp_path: Path) -> None:
    page = full_page(tmp_path)
    titles = ["Seed 3", "40 frames", "Unseen views", "Camera 2", "By nobody.", "twofold render run --size <n>"]
    captions = ["truth", "avatar", "once around", "total", "part"]
    figures = ["27.3 dB", "✓ 26 dB", "✗ 24 dB", "psnr_box", "over the box"]
    for words in titles + captions + figures:
        assert words in page.text, words
    assert len(page.all("svg")) == 1 + 2, "the logo and two charts"
    assert [a["href"] for a in page.all("a")] == ["https://example.org/a"]
    assert page.all("video")[0]["src"] == "data:video/mp4;base64," + base64.b64encode(b"film").decode()


def test_images_are_inside_the_page_pixel_by_pixel(tmp_path: Path) -> None:
    images = full_page(tmp_path).all("img")
    sources = [str(a["src"]) for a in images]
    contents = [base64.b64decode(s.removeprefix("data:image/png;base64,"), validate=True) for s in sources]
    arrays = [np.asarray(Image.open(io.BytesIO(content)).convert("RGB")) for content in contents]
    expected = [image(2), image(), image(1), np.zeros((4, 4, 3)), np.full((4, 4, 3), 255)]
    assert len(arrays) == len(expected)
    assert all(np.array_equal(a, e) for a, e in zip(arrays, expected, strict=True))
    assert [(a["width"], a["height"]) for a in images[:2]] == [("9", "12"), ("9", "12")]
    assert contents[2] == (tmp_path / "kept.png").read_bytes()


def test_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    page = full_page(tmp_path)
    assert not page.all("script")
    assert not page.all("link")
    sources = [str(a.get("src", "")) for _, a in page.elements if "src" in a]
    assert all(s.startswith("data:") for s in sources)
    (policy,) = [a["content"] for a in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert "script-src" not in policy
    style = "".join(page.texts)
    assert "url(" not in style
    assert "@import" not in style
    assert "prefers-color-scheme: dark" in style


def test_no_text_can_break_the_page(tmp_path: Path) -> None:
    evil = "\"'><script>alert(1)</script>&amp;"
    chart = Chart(evil, (Curve(evil, [0, 1], [0.0, 1.0]), Curve("b", [0], [1.0])), x_label=evil)
    parts = (
        Row((CaptionedImage(image(), evil),), evil),
        chart,
        Table((evil,), ((evil,), (evil, evil))),
        Commands(((evil, evil),)),
    )
    path = write_report(
        tmp_path, evil, [Section(evil, evil, parts)], evil, [KeyMetric(evil, evil, evil, evil)], credit=evil
    )
    page = Page(path.read_text(encoding="utf-8"))
    assert not page.all("script")
    assert page.text.count("<script>alert(1)</script>&amp;") >= 15
    assert page.all("img")[0]["alt"] == evil


def test_missing_or_unknown_files_are_one_clear_sentence(tmp_path: Path) -> None:
    def written(part: Row | Video) -> None:
        write_report(tmp_path, "x", [Section("y", "", (part,))])

    with pytest.raises(TwofoldError, match=r"video .*turn\.mp4 is missing"):
        written(Video("turn.mp4"))
    with pytest.raises(TwofoldError, match=r"video .*lead\.mp4 is missing"):
        write_report(tmp_path, "x", [], lead=Video("lead.mp4"))
    with pytest.raises(TwofoldError, match=r"image .*a\.png is missing"):
        written(Row((CaptionedImage(tmp_path / "a.png"),)))
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(TwofoldError, match=r"a\.exr is not one of \.png, \.jpg"):
        written(Row((CaptionedImage(tmp_path / "a.exr"),)))
    with pytest.raises(TwofoldError, match="Cannot write"):
        write_report(tmp_path / "none", "x", [])
    assert not list(tmp_path.glob("*.html"))


def test_verdicts_compare_with_their_goal() -> None:
    view = key_metric(METRICS, "novel_view.psnr_box", "Novel view", "dB", at_least=26.0)
    assert view == KeyMetric("Novel view", "27.30", "dB", "goal ≥ 26 dB", True)
    assert key_metric(METRICS, "novel_view.psnr_box", "x", at_least=28).met is False
    assert key_metric(METRICS, "seconds.total", "x", "s", at_most=180.0) == KeyMetric(
        "x", "151", "s", "goal ≤ 180 s", True
    )
    assert key_metric(METRICS, "seconds.total", "x", "s", at_most=150.0).met is False
    assert key_metric(METRICS, "novel_view.images", "x") == KeyMetric("x", "6.00", "", "", None)


@pytest.mark.parametrize("key", ["geometry.chamfer_cm", "geometry.nothing", "nothing.at.all", "novel_view", "recipe"])
def test_what_was_not_measured_is_a_dash_and_meets_no_goal(key: str) -> None:
    missing = key_metric(METRICS, key, "x", "cm", at_most=1.0)
    assert missing == KeyMetric("x", "\N{EN DASH}", "", "goal ≤ 1 cm", False)
    assert key_metric(METRICS, key, "x").met is None
    assert key_metric({"a": math.nan}, "a", "x", "cm", at_most=1.0) == missing


def test_every_number_stands_beside_its_protocol() -> None:
    assert metrics_table(json.loads(json.dumps(METRICS))).rows == (
        ("recipe", "quick", ""),
        ("Novel view",),
        ("psnr_box", "27.30", "over the box"),
        ("images", "6", ""),
        ("Novel view, by camera",),
        ("left", "1,728", ""),
        ("right", "0.5000", ""),
        ("Geometry",),
        ("chamfer_cm", "\N{EN DASH}", "no true mesh"),
        ("Seconds",),
        ("total", "151.3", ""),
    )


def test_numbers_have_the_digits_that_help() -> None:
    assert [number(v) for v in (0.0, -0.5, 1234.5, 99.999, 1e-5)] == ["0.0000", "-0.5000", "1,234", "100.00", "1.0e-05"]


def test_a_path_of_a_video_is_taken_as_it_is_and_a_name_from_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page that is written to `demo`, seen from where the command runs, has its videos in `demo` and not below."""
    monkeypatch.chdir(tmp_path)
    place = Path("demo")
    place.mkdir()
    (place / "turn.mp4").write_bytes(b"film")
    pages = [write_report(place, "x", [Section("y", "", (Video(file),))]) for file in (place / "turn.mp4", "turn.mp4")]
    assert all("data:video/mp4;base64,Zmlsb" in page.read_text() for page in pages)
