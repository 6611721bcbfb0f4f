"""Charts: what stands where in the drawing, read back from the SVG."""

import math
import re
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.html.charts import BINS, Bar, Chart, Curve, bars_svg, curves_svg, directions_svg, dots_svg, short


def parsed(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def drawn(chart: Chart) -> ElementTree.Element:
    return parsed(curves_svg(chart))


def paths(svg: ElementTree.Element, kind: str) -> list[np.ndarray]:
    """The corners (n, 2) of the path in every group of one class."""
    groups = [g for g in svg.iter("g") if g.get("class") == kind]
    found = []
    for group in groups:
        (use,) = list(group.iter("use")) or [ElementTree.Element("use", x="0", y="0")]
        shift = [float(use.attrib["x"]), float(use.attrib["y"])]
        found += [corners(path.attrib["d"]) + shift for path in list(group.iter("path"))[:1]]
    return found


def corners(d: str) -> np.ndarray:
    return np.array(re.findall(r"[ML] (\S+) (\S+)", d), dtype=float)


def as_number(label: str) -> float:
    label = label.replace("\N{MINUS SIGN}", "-")
    units = {"k": 1e3, "M": 1e6}
    return float(label.replace(",", "").rstrip("kM")) * units.get(label[-1], 1)


def height_scale(svg: ElementTree.Element) -> list[tuple[float, float]]:
    """(value, y) of every horizontal line of the grid."""
    group = next(g for g in svg.iter("g") if g.get("class") == "y-axis")
    ticks = [(g.find(".//text"), g.find(".//path")) for g in group if g.find(".//text") is not None]
    return [(as_number(text.text or ""), corners(path.attrib["d"])[0, 1]) for text, path in ticks if path is not None]


def read_off(svg: ElementTree.Element, y: np.ndarray, logarithmic: bool = False) -> np.ndarray:
    """Values at heights of the drawing, as a reader would find them between the labelled lines."""
    (v0, y0), (v1, y1) = height_scale(svg)[0], height_scale(svg)[-1]
    if logarithmic:
        return 10 ** (math.log10(v0) + (y - y0) / (y1 - y0) * (math.log10(v1) - math.log10(v0)))
    return v0 + (y - y0) / (y1 - y0) * (v1 - v0)


def view(svg: ElementTree.Element) -> list[float]:
    left, top, width, height = map(float, svg.attrib["viewBox"].split())
    assert (left, top) == (0, 0)
    return [width, height]


def test_curve_passes_where_its_axis_says() -> None:
    values = [3.0, 17.0, 8.0, 26.0]
    svg = drawn(Chart("PSNR", (Curve("a", [0, 10, 20, 40], values),)))
    (line,) = paths(svg, "curve")
    assert read_off(svg, line[:, 1]) == pytest.approx(values, abs=1e-3)
    x = line[:, 0]
    assert (x[1] - x[0]) / (x[-1] - x[0]) == pytest.approx(0.25, abs=1e-4)


def test_logarithmic_curve_passes_where_its_axis_says() -> None:
    values = [0.5, 0.02, 0.003]
    svg = drawn(Chart("loss", (Curve("a", [0, 1, 2], values),), logarithmic=True))
    (line,) = paths(svg, "curve")
    assert read_off(svg, line[:, 1], logarithmic=True) == pytest.approx(values, rel=1e-3)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_long_curve_becomes_means_within_their_range(logarithmic: bool) -> None:
    steps = np.arange(BINS * 10)
    values = np.where(steps % 2 == 0, 1.0, 4.0)
    svg = drawn(Chart("noise", (Curve("a", steps.tolist(), values.tolist()),), logarithmic=logarithmic))
    (line,), (band,) = paths(svg, "curve"), paths(svg, "band")
    assert len(line) <= BINS
    assert read_off(svg, line[:, 1], logarithmic) == pytest.approx(2.0 if logarithmic else 2.5, abs=0.01)
    heights = read_off(svg, band[:, 1], logarithmic)
    assert (heights.min(), heights.max()) == (pytest.approx(1.0, abs=0.01), pytest.approx(4.0, abs=0.01))


def test_curves_share_axes_and_differ_in_color() -> None:
    text = curves_svg(Chart("two", (Curve("a", [0, 1], [0.0, 1.0]), Curve("b", [1, 2], [1.0, 2.0]))))
    first, second = paths(parsed(text), "curve")
    assert first[-1].tolist() == second[0].tolist()
    assert "stroke: var(--c0)" in text
    assert "stroke: var(--c1)" in text


def test_every_color_comes_from_the_page() -> None:
    for text in every_kind():
        assert not re.search(r"#[0-9a-f]{6}\b(?!\))", re.sub(r"(?:href=\"|url\()#\w+", "", text)), text
        assert "font-family" not in text


def test_what_is_not_finite_is_left_out() -> None:
    svg = drawn(Chart("gaps", (Curve("a", [0, 1, 2, 3], [1.0, math.nan, math.inf, 2.0]),)))
    (line,) = paths(svg, "curve")
    assert len(line) == 2
    svg = drawn(Chart("log", (Curve("a", [0, 1, 2], [1.0, 0.0, -1.0]),), logarithmic=True))
    assert len(list(svg.iter("use"))) == 1, "a single point is a dot"


@pytest.mark.parametrize(("steps", "values"), [([5], [2.0]), ([0, 1, 2], [7.0, 7.0, 7.0]), ([3, 3], [1.0, 2.0])])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_single_points_and_flat_curves_stay_inside(steps: list[int], values: list[float], logarithmic: bool) -> None:
    svg = drawn(Chart("flat", (Curve("a", steps, values),), logarithmic=logarithmic))
    dots = [np.array([[float(use.attrib["x"]), float(use.attrib["y"])]]) for use in svg.iter("use")]
    (line,) = dots if len(steps) == 1 else paths(svg, "curve")
    assert ((line >= 0) & (line <= view(svg))).all()
    assert height_scale(svg)


def test_nothing_recorded_is_said() -> None:
    assert "Nothing was recorded" in curves_svg(Chart("empty", (Curve("a", [], []),)))
    assert "Nothing was recorded" in curves_svg(Chart("empty", ()))


@pytest.mark.parametrize(("low", "high"), [(0.0012, 123_456.0), (2e-6, 3e-5), (999.0, 1234.0), (-0.3, 0.4)])
def test_labels_keep_inside_the_drawing(low: float, high: float) -> None:
    for logarithmic in (False, True):
        svg = drawn(Chart("loss", (Curve("a", [0, 100_000], [low, high]),), logarithmic=logarithmic))
        for text in svg.iter("text"):
            x, reach = float(text.attrib["x"]), 7.5 * len(text.text or "")  # a digit of 13 units' height is 7.5 wide
            anchor = re.search(r"text-anchor: (\w+)", text.attrib["style"])
            right = x + {"middle": reach / 2, "end": 0}[anchor[1] if anchor else ""]
            assert right - reach >= -1, text.text
            assert right <= view(svg)[0] + 1, text.text


def test_text_cannot_break_out_of_the_drawing() -> None:
    svg = drawn(Chart('"><script>', (Curve("a", [0, 1], [0.0, 1.0]),), x_label="<b> $x^2$"))
    assert svg.attrib["aria-label"] == '"><script>'
    assert not list(svg.iter("b"))
    assert "<b> $x^2$" in [text.text for text in svg.iter("text")]


def every_kind() -> list[str]:
    return [
        curves_svg(Chart("a", (Curve("a", [0, 1], [0.5, 1.0]),), logarithmic=True)),
        dots_svg("b", [Curve(name, [0, 1, 5], [0.8, 0.4, 0.9]) for name in "abcdef"], 0.7),
        bars_svg("c", [Bar("left knee", 50.0, "left"), Bar("head", 3.0, "trunk", pale=True)], 180, 45, "°"),
        directions_svg("d", [(-60.0, 120.0)], [0.0, 90.0]),
    ]


def test_the_same_data_gives_the_same_bytes_whatever_the_user_has_set() -> None:
    first = every_kind()
    with matplotlib.rc_context({"svg.hashsalt": None, "font.size": 30, "lines.linewidth": 9, "svg.fonttype": "path"}):
        assert every_kind() == first
    for text in first:
        assert not re.search(r"\b20\d\d-\d\d-\d\d\b", text), "no date"
        assert "http" not in text, "no address"


def test_ids_are_kept_only_where_something_refers_to_them() -> None:
    for text in every_kind():
        ids = re.findall(r'\bid="([^"]+)"', text)
        assert all(f"#{one}" in text for one in ids)


def test_dots_stand_at_their_values_and_name_them() -> None:
    svg = parsed(dots_svg("IoU", [Curve("left <1>", [3, 7], [0.9, 0.6]), Curve("b", [4], [0.8])], bad_below=0.7))
    dots = [(title.text, float(use.attrib["y"])) for use in svg.iter("use") for title in use.iter("title")]
    assert [text for text, _ in dots] == ["left <1> at 3: 0.90", "left <1> at 7: 0.60", "b at 4: 0.80"]
    assert read_off(svg, np.array([y for _, y in dots])) == pytest.approx([0.9, 0.6, 0.8], abs=1e-3)
    (bad,) = paths(svg, "bad")
    assert read_off(svg, bad[:, 1]).max() == pytest.approx(0.7, abs=1e-3)


def test_bars_are_as_long_as_their_values_and_end_at_the_axis() -> None:
    svg = parsed(
        bars_svg("turns", [Bar("a", 90.0, "left"), Bar("b", 45.0, "right"), Bar("c", 400.0, "trunk")], 180, 45, "°")
    )
    widths = [np.ptp(corner[:, 0]) for corner in paths(svg, "bar")]
    assert widths[0] / widths[1] == pytest.approx(2)
    assert widths[2] / widths[0] == pytest.approx(2), "a bar is cut at the end of the axis"
    assert "400°" in [text.text for text in svg.iter("text")]


def test_directions_are_seen_from_above_with_the_front_below_and_the_left_at_the_right() -> None:
    svg = parsed(directions_svg("seen", [], [0.0, 90.0, 180.0, 270.0]))
    front, left, back, right = (corner.mean(0) for corner in paths(svg, "mark"))
    assert front[1] > left[1] > back[1]
    assert left[0] > front[0] > right[0]
    words = {text.text: (float(text.attrib["x"]), float(text.attrib["y"])) for text in svg.iter("text")}
    assert words["front"][1] > front[1]
    assert words["left"][0] > left[0]
    sector = paths(parsed(directions_svg("seen", [(60.0, 60.0)], [])), "covered")[0]
    middle = sector.mean(0) - np.array(view(svg)) / 2
    assert middle[0] > 10, "a sector from 60 to 120 degrees is at the right"
    assert paths(parsed(directions_svg("seen", [(0.0, 360.0)], [])), "covered")


@given(st.floats(-1e7, 1e7))
def test_short_numbers_say_what_they_stand_for(value: float) -> None:
    assert as_number(short(value)) == pytest.approx(value, rel=1e-5, abs=1e-9)
