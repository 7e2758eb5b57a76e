"""Curves of several networks over the epochs of their training, as one SVG and one PNG drawing.

Knows nothing of networks and logs: it is given names and numbers. A drawing is a list of lines and words, so that both
files show the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

COLOURS = ("#2563eb", "#16a34a", "#ca8a04", "#7c3aed", "#dc2626", "#0891b2", "#be185d", "#475569", "#65a30d")
_INK, _SOFT, _GRID = "#0f172a", "#64748b", "#e2e8f0"
_PANEL_WIDTH, _PLOT_HEIGHT = 470, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 64, 46
_LEGEND_WIDTH = 170
_PIXELS = 2
"""Of the PNG, for each of the drawing's units."""

_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


@dataclass(frozen=True, slots=True)
class Panel:
    """One drawing of several: a value for each epoch, from the first, of every series."""

    title: str
    series: Mapping[str, Sequence[float]]


@dataclass(frozen=True, slots=True)
class _Line:
    points: Sequence[tuple[float, float]]
    colour: str
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class _Words:
    x: float
    y: float
    text: str
    size: int = 11
    colour: str = _SOFT
    anchor: str = "middle"


@dataclass(frozen=True, slots=True)
class Drawing:
    """Lines and words on white."""

    width: int
    height: int
    shapes: Sequence[_Line | _Words]

    def svg(self) -> str:
        """The text of an SVG file."""
        size = f'width="{self.width}" height="{self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="system-ui, sans-serif">'
        return "\n".join([head, f'<rect {size} fill="#ffffff"/>', *map(_svg, self.shapes), "</svg>"]) + "\n"

    def save_png(self, path: Path) -> None:
        """Writes a PNG file."""
        image = Image.new("RGB", (self.width * _PIXELS, self.height * _PIXELS), "#ffffff")
        canvas = ImageDraw.Draw(image)
        for shape in self.shapes:
            _paint(canvas, shape)
        image.save(path)


def draw(title: str, panels: Sequence[Panel]) -> Drawing:
    """Panels side by side over a common axis of epochs, each with its own scale, and one legend for all.

    Args:
        title: over everything.
        panels: with the same names of series, which keep their colours.
    """
    names = list(panels[0].series)
    colours = {name: COLOURS[index % len(COLOURS)] for index, name in enumerate(names)}
    shapes: list[_Line | _Words] = [_Words(_LEFT, 24, title, size=14, colour=_INK, anchor="start")]
    for number, panel in enumerate(panels):
        shapes += _panel(panel, colours, left=number * _PANEL_WIDTH)
    x = len(panels) * _PANEL_WIDTH
    for index, name in enumerate(names):
        y = _TOP + 10 + 22 * index
        shapes += [_Line([(x, y - 4), (x + 22, y - 4)], colours[name], 2), _Words(x + 30, y, name, anchor="start")]
    return Drawing(x + _LEGEND_WIDTH, _TOP + _PLOT_HEIGHT + _BOTTOM, shapes)


def _panel(panel: Panel, colours: Mapping[str, str], left: float) -> Iterator[_Line | _Words]:
    epochs = max((len(values) for values in panel.series.values()), default=1)
    low, high, step = _scale([value for values in panel.series.values() for value in values])
    begin, end = left + _LEFT, left + _PANEL_WIDTH - _RIGHT

    def place(epoch: int, value: float) -> tuple[float, float]:
        x = begin + (end - begin) * (epoch - 0.5) / epochs
        return x, _TOP + _PLOT_HEIGHT * (high - value) / (high - low)

    yield _Words((begin + end) / 2, _TOP - 12, panel.title, size=12, colour=_INK)
    for number in range(round((high - low) / step) + 1):
        value = low + number * step
        y = place(1, value)[1]
        yield _Line([(begin, y), (end, y)], _GRID)
        yield _Words(begin - 6, y + 4, f"{value:g}", anchor="end")
    for epoch in range(1, epochs + 1):
        yield _Words(place(epoch, low)[0], _TOP + _PLOT_HEIGHT + 18, str(epoch))
    yield _Words((begin + end) / 2, _TOP + _PLOT_HEIGHT + 36, "epoch")
    for name, values in panel.series.items():
        yield _Line([place(epoch, value) for epoch, value in enumerate(values, start=1)], colours[name], 2)


def _scale(values: Sequence[float]) -> tuple[float, float, float]:
    """Ends of a scale that holds the values, and the step of its lines: 1, 2 or 5 times a power of ten."""
    lowest, highest = min(values, default=0.0), max(values, default=1.0)
    rough = max(highest - lowest, 1e-6) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))
    low = step * math.floor(lowest / step + 1e-9)
    high = max(step * math.ceil(highest / step - 1e-9), low + step)
    return round(low, 9), round(high, 9), step


def _svg(shape: _Line | _Words) -> str:
    if isinstance(shape, _Line):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
        return f'<polyline points="{points}" stroke="{shape.colour}" stroke-width="{shape.width:g}" fill="none"/>'
    place = f'x="{shape.x:.1f}" y="{shape.y:.1f}" font-size="{shape.size}" text-anchor="{shape.anchor}"'
    return f'<text {place} fill="{shape.colour}">{escape(shape.text)}</text>'


def _paint(canvas: ImageDraw.ImageDraw, shape: _Line | _Words) -> None:
    if isinstance(shape, _Line):
        points = [(x * _PIXELS, y * _PIXELS) for x, y in shape.points]
        canvas.line(points, fill=shape.colour, width=round(shape.width * _PIXELS), joint="curve")
    else:
        font = ImageFont.load_default(shape.size * _PIXELS)
        place = (shape.x * _PIXELS, shape.y * _PIXELS)
        canvas.text(place, shape.text, fill=shape.colour, font=font, anchor=_ANCHORS[shape.anchor])
