"""Charts: what stands where in the drawing, read back from the SVG."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.html.charts import BINS, HEIGHT, LEFT, RIGHT, WIDTH, Chart, Curve, axis_ticks, chart_svg


def drawn(chart: Chart) -> ElementTree.Element:
    return ElementTree.fromstring(chart_svg(chart))


def points(element: ElementTree.Element) -> np.ndarray:
    return np.array([[float(v) for v in pair.split(",")] for pair in element.attrib["points"].split()])


def as_number(label: str) -> float:
    units = {"k": 1e3, "M": 1e6}
    return float(label.replace(",", "").rstrip("kM")) * units.get(label[-1], 1)


def height_scale(svg: ElementTree.Element) -> list[tuple[float, float]]:
    """(value, y) of every line of the grid."""
    labels = [t for t in svg.iter("text") if t.attrib["text-anchor"] == "end" and "dy" in t.attrib]
    return [(as_number(t.text or ""), float(t.attrib["y"])) for t in labels]


def read_off(svg: ElementTree.Element, y: np.ndarray, logarithmic: bool = False) -> np.ndarray:
    """Values at heights of the drawing, as a reader would find them between the labelled lines."""
    (v0, y0), (v1, y1) = height_scale(svg)[0], height_scale(svg)[-1]
    if logarithmic:
        return 10 ** (math.log10(v0) + (y - y0) / (y1 - y0) * (math.log10(v1) - math.log10(v0)))
    return v0 + (y - y0) / (y1 - y0) * (v1 - v0)


def test_curve_passes_where_its_axis_says() -> None:
    values = [3.0, 17.0, 8.0, 26.0]
    svg = drawn(Chart("PSNR", (Curve("a", [0, 10, 20, 40], values),)))
    (line,) = svg.iter("polyline")
    assert read_off(svg, points(line)[:, 1]) == pytest.approx(values, abs=0.05)
    x = points(line)[:, 0]
    assert (x[0], x[-1]) == (LEFT, WIDTH - RIGHT)
    assert (x[1] - x[0]) / (x[-1] - x[0]) == pytest.approx(0.25, abs=0.001)


def test_logarithmic_curve_passes_where_its_axis_says() -> None:
    values = [0.5, 0.02, 0.003]
    svg = drawn(Chart("loss", (Curve("a", [0, 1, 2], values),), logarithmic=True))
    (line,) = svg.iter("polyline")
    assert read_off(svg, points(line)[:, 1], logarithmic=True) == pytest.approx(values, rel=0.01)


def test_long_curve_becomes_means_within_their_range() -> None:
    steps = np.arange(BINS * 10)
    values = np.where(steps % 2 == 0, 1.0, 3.0)
    svg = drawn(Chart("noise", (Curve("a", steps.tolist(), values.tolist()),)))
    (line,), (band,) = svg.iter("polyline"), svg.iter("polygon")
    assert len(points(line)) == BINS
    assert read_off(svg, points(line)[:, 1]) == pytest.approx(2.0, abs=0.01)
    heights = read_off(svg, points(band)[:, 1])
    assert heights[:BINS] == pytest.approx(3.0, abs=0.01)
    assert heights[BINS:] == pytest.approx(1.0, abs=0.01)


def test_curves_share_axes_and_differ_in_class() -> None:
    svg = drawn(Chart("two", (Curve("a", [0, 1], [0.0, 1.0]), Curve("b", [1, 2], [1.0, 2.0]))))
    first, second = svg.iter("polyline")
    assert (first.attrib["class"], second.attrib["class"]) == ("c0", "c1")
    assert points(first)[-1].tolist() == points(second)[0].tolist()


def test_what_is_not_finite_is_left_out() -> None:
    svg = drawn(Chart("gaps", (Curve("a", [0, 1, 2, 3], [1.0, math.nan, math.inf, 2.0]),)))
    (line,) = svg.iter("polyline")
    assert len(points(line)) == 2
    (line,) = drawn(Chart("log", (Curve("a", [0, 1, 2], [1.0, 0.0, -1.0]),), logarithmic=True)).iter("polyline")
    assert len(points(line)) == 1


@pytest.mark.parametrize(("steps", "values"), [([5], [2.0]), ([0, 1, 2], [7.0, 7.0, 7.0]), ([3, 3], [1.0, 2.0])])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_single_points_and_flat_curves_stay_inside(steps: list[int], values: list[float], logarithmic: bool) -> None:
    svg = drawn(Chart("flat", (Curve("a", steps, values),), logarithmic=logarithmic))
    (line,) = svg.iter("polyline")
    inside = (points(line) >= 0) & (points(line) <= [WIDTH, HEIGHT])
    assert inside.all()
    assert height_scale(svg)


def test_nothing_recorded_is_said() -> None:
    assert "Nothing was recorded" in chart_svg(Chart("empty", (Curve("a", [], []),)))
    assert "Nothing was recorded" in chart_svg(Chart("empty", ()))


def test_labels_keep_inside_the_drawing() -> None:
    svg = drawn(Chart("loss", (Curve("a", [0, 100_000], [0.0012, 123_456.0]),)))
    for text in svg.iter("text"):
        x, reach = float(text.attrib["x"]), 7 * len(text.text or "")  # a digit of 13 units' height is some 7 wide
        right = x + {"middle": reach / 2, "end": 0}[text.attrib["text-anchor"]]
        left = right - reach
        assert left >= 0
        assert right <= WIDTH


def test_text_cannot_break_out_of_the_drawing() -> None:
    svg = drawn(Chart('"><script>', (Curve("a", [0, 1], [0.0, 1.0]),), x_label="<b>"))
    assert svg.attrib["aria-label"] == '"><script>'
    assert not list(svg.iter("b"))


@given(st.floats(-1e5, 1e5), st.floats(1e-4, 1e6))
def test_ticks_are_round_even_and_inside(low: float, width: float) -> None:
    high = low + width
    ticks = axis_ticks(low, high)
    values = [v for v, _ in ticks]
    assert 1 <= len(ticks) <= 8
    assert all(low - 1e-9 * width <= v <= high + 1e-9 * width for v in values)
    assert [as_number(label) for _, label in ticks] == pytest.approx(values, rel=1e-6)
    gaps = np.diff(values)
    assert np.allclose(gaps, gaps[:1])
    for gap in gaps[:1]:
        mantissa = gap / 10 ** math.floor(math.log10(gap) + 1e-6)
        assert min(abs(mantissa - round_one) for round_one in (1, 2, 2.5, 5)) < 1e-4


@given(st.floats(-8, 5), st.floats(0.05, 8))
def test_logarithmic_ticks_say_what_they_stand_for(low: float, width: float) -> None:
    ticks = axis_ticks(low, low + width, logarithmic=True)
    assert ticks
    for position, label in ticks:
        assert low - 1e-9 <= position <= low + width + 1e-9
        assert as_number(label) == pytest.approx(10**position, rel=6e-3)
