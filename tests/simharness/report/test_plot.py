from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import pytest

from simharness.play.metrics import Rate
from simharness.report.plot import Panel, plot


def test_higher_rates_are_drawn_higher_and_nothing_where_nothing_was_counted() -> None:
    drawing = ET.fromstring(
        plot("<a & b>", [Panel("p", ["x", "y", "z"], 2, {"GSR": [Rate(9, 10), Rate(5, 10), None]})])
    )
    high, low = (
        float(circle.attrib["cy"]) for circle in drawing.findall(".//{*}circle") if circle.find("{*}title") is not None
    )
    assert high < low
    assert "<a & b>" in [text.text for text in drawing.findall(".//{*}text")]


def test_panels_that_do_not_fit_into_a_row_begin_another_and_none_overlap() -> None:
    panels = [Panel(str(count), ["x"] * count, 0, {"GSR": [Rate(5, 10)] * count}) for count in (5, 13, 7, 5, 4, 9)]
    drawing = ET.fromstring(plot("t", panels))
    boxes = []
    for group in drawing.findall("{*}g"):
        x, y = (float(number) for number in group.attrib["transform"][10:-1].split())
        boxes.append((x, x + max(float(line.attrib["x2"]) for line in group.findall("{*}line")), y))
    assert len({y for *_, y in boxes}) > 1
    assert max(right for _, right, _ in boxes) <= float(drawing.attrib["width"])
    for number, (left, right, y) in enumerate(boxes):
        assert all(right <= other[0] or other[1] <= left or other[2] != y for other in boxes[number + 1 :])


def test_dots_bars_and_lines_lie_where_their_rates_are() -> None:
    """On a scale from its lowest line to 100 %; each level in its own part of the panel, series side by side."""
    series: dict[str, list[Rate | None]] = {
        "GSR": [Rate(9, 10), Rate(19, 20), Rate(40, 40)],
        "DR": [Rate(30, 40), None, Rate(39, 40)],
    }
    drawing = ET.fromstring(plot("t", [Panel("p", ["x", "y", "z"], 2, series)]))
    (panel,) = drawing.findall("{*}g")
    grid = {float(line.attrib["y1"]) for line in panel.findall("{*}line")}
    labels = {
        float(text.attrib["y"]) - 4: int(str(text.text)[:-2])
        for text in panel.findall("{*}text")
        if str(text.text).endswith(" %")
    }
    assert set(labels) == grid
    (top, bottom), (most, least) = (min(grid), max(grid)), (max(labels.values()), min(labels.values()))
    assert (most, labels[top], labels[bottom]) == (100, 100, least)
    rates = [rate for some in series.values() for rate in some if rate is not None]
    assert least <= 100 * min(rate.interval[0] for rate in rates)

    def height(share: float) -> float:
        return bottom + (top - bottom) * (100 * share - least) / (100 - least)

    circles, paths = panel.findall("{*}circle"), panel.findall("{*}path")
    places = {str(text.text): float(text.attrib["x"]) for text in panel.findall("{*}text")}
    assert len(circles) == len(paths) == 5
    levels = ["x", "y", "z", "x", "z"]
    for rate, circle, path, level in zip(rates, circles, paths, levels, strict=True):
        assert float(circle.attrib["cy"]) == pytest.approx(height(rate.value or 0.0), abs=0.06)
        assert abs(float(circle.attrib["cx"]) - places[level]) == pytest.approx(4.5, abs=0.06)
        x, low, high = map(float, re.findall(r"^M([\d.]+) ([\d.]+)V([\d.]+)", path.attrib["d"])[0])
        assert x == float(circle.attrib["cx"])
        assert (low, high) == pytest.approx(tuple(height(limit) for limit in rate.interval), abs=0.06)
    joined = [line.attrib["points"].split() for line in panel.findall("{*}polyline")]
    spots = [f"{circle.attrib['cx']},{circle.attrib['cy']}" for circle in circles]
    assert joined == [spots[:2], spots[3:4]]
    assert {circle.attrib["fill"] for circle in circles[:3]}.isdisjoint(circle.attrib["fill"] for circle in circles[3:])


@pytest.mark.parametrize(
    ("lowest", "floor", "step"),
    [(92, 92, 2), (91, 90, 2), (76, 75, 5), (51, 50, 10), (2, 0, 20), (90, 90, 2), (89, 85, 5)],
)
def test_the_scale_has_at_most_six_lines_and_begins_at_one(lowest: int, floor: int, step: int) -> None:
    class Known(Rate):  # with an interval that is told
        @property
        def interval(self) -> tuple[float, float]:
            return lowest / 100, 1.0

    drawn = ET.fromstring(plot("t", [Panel("p", ["x"], 1, {"GSR": [Known(1, 1)]})]))
    words = [str(text.text) for text in drawn.findall("{*}g/{*}text")]
    assert [word for word in words if word.endswith(" %")] == [f"{percent} %" for percent in range(floor, 101, step)]
