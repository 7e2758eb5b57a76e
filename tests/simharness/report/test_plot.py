from __future__ import annotations

import xml.etree.ElementTree as ET

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
