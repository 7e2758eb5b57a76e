from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from PIL import Image

from simharness.drawing import COLOURS, Drawing
from training.curves import Panel, _scale, draw

NAMES = ["gpd", "tesnet <paper>"]


def drawing() -> Drawing:
    loss = Panel("loss", {NAMES[0]: [0.6, 0.5, 0.45], NAMES[1]: [0.5, 0.3]})
    accuracy = Panel("accuracy, %", {NAMES[0]: [70, 75, 76], NAMES[1]: [80, 88]})
    return draw("Training", [loss, accuracy])


def curves(svg: str) -> list[list[tuple[float, float]]]:
    """The points of every line of a series' colour, legend excluded, in order."""
    lines = re.findall(r'<polyline points="([^"]*)" stroke="(#\w+)" stroke-width="2"', svg)
    points = [[tuple(map(float, pair.split(","))) for pair in text.split()] for text, _ in lines]
    return [line for line in points if len(line) > 1 and line[0][1] != line[1][1]]  # type: ignore[misc]


def test_a_lower_loss_is_drawn_lower_and_every_series_has_its_colour_in_both_panels() -> None:
    svg = drawing().svg()
    ET.fromstring(svg)
    lines = curves(svg)
    assert [len(line) for line in lines] == [3, 2, 3, 2]
    falling, steeper, rising, _ = lines
    assert [y for _, y in falling] == sorted(y for _, y in falling)  # y points down
    assert [y for _, y in rising] == sorted((y for _, y in rising), reverse=True)
    assert steeper[1][1] > falling[2][1]
    assert steeper[0][0] == falling[0][0]
    for colour in COLOURS[:2]:
        assert svg.count(f'stroke="{colour}"') == 3  # two panels and the legend
    assert "tesnet &lt;paper&gt;" in svg


def test_the_picture_has_the_size_and_colours_of_the_drawing(tmp_path: Path) -> None:
    made = drawing()
    made.save_png(tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        assert image.size == (2 * made.width, 2 * made.height)
        colours = {colour for _, colour in image.getcolors(1 << 24) or []}
    for colour in COLOURS[:2]:
        assert tuple(bytes.fromhex(colour[1:])) in colours


@pytest.mark.parametrize(
    ("values", "expected"),
    [([0.262, 0.6], (0.2, 0.6, 0.1)), ([78.6, 89.5], (75, 90, 5)), ([0.3], (0.3, 0.3, 0)), ([], (0, 1, 0.2))],
)
def test_a_scale_holds_its_values_and_has_round_steps(
    values: list[float], expected: tuple[float, float, float]
) -> None:
    low, high, step = _scale(values)
    assert low <= min(values, default=0)
    assert high >= max(values, default=1)
    assert high > low
    assert (high - low) / step == pytest.approx(round((high - low) / step))
    if len(values) != 1:
        assert (low, high, step) == pytest.approx(expected)
