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
