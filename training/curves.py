"""Curves of several networks over the epochs of their training.

Knows nothing of networks and logs: it is given names and numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from simharness.drawing import COLOURS, GRID, INK, Drawing, Line, Words

_PANEL_WIDTH, _PLOT_HEIGHT = 470, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 64, 46
_LEGEND_WIDTH = 170


@dataclass(frozen=True, slots=True)
class Panel:
    """One drawing of several: a value for each epoch, from the first, of every series."""

    title: str
    series: Mapping[str, Sequence[float]]


def draw(title: str, panels: Sequence[Panel]) -> Drawing:
    """Panels side by side over a common axis of epochs, each with its own scale, and one legend for all.

    Args:
        title: over everything.
        panels: with the same names of series, which keep their colours.
    """
    names = list(panels[0].series)
    colours = {name: COLOURS[index % len(COLOURS)] for index, name in enumerate(names)}
    shapes: list[Line | Words] = [Words(_LEFT, 24, title, size=14, colour=INK, anchor="start")]
    for number, panel in enumerate(panels):
        shapes += _panel(panel, colours, left=number * _PANEL_WIDTH)
    x = len(panels) * _PANEL_WIDTH
    for index, name in enumerate(names):
        y = _TOP + 10 + 22 * index
        shapes += [Line([(x, y - 4), (x + 22, y - 4)], colours[name], 2), Words(x + 30, y, name, anchor="start")]
    return Drawing(x + _LEGEND_WIDTH, _TOP + _PLOT_HEIGHT + _BOTTOM, shapes)


def _panel(panel: Panel, colours: Mapping[str, str], left: float) -> Iterator[Line | Words]:
    epochs = max((len(values) for values in panel.series.values()), default=1)
    low, high, step = _scale([value for values in panel.series.values() for value in values])
    begin, end = left + _LEFT, left + _PANEL_WIDTH - _RIGHT

    def place(epoch: int, value: float) -> tuple[float, float]:
        x = begin + (end - begin) * (epoch - 0.5) / epochs
        return x, _TOP + _PLOT_HEIGHT * (high - value) / (high - low)

    yield Words((begin + end) / 2, _TOP - 12, panel.title, size=12, colour=INK)
    for number in range(round((high - low) / step) + 1):
        value = low + number * step
        y = place(1, value)[1]
        yield Line([(begin, y), (end, y)], GRID)
        yield Words(begin - 6, y + 4, f"{value:g}", anchor="end")
    for epoch in range(1, epochs + 1):
        yield Words(place(epoch, low)[0], _TOP + _PLOT_HEIGHT + 18, str(epoch))
    yield Words((begin + end) / 2, _TOP + _PLOT_HEIGHT + 36, "epoch")
    for name, values in panel.series.items():
        yield Line([place(epoch, value) for epoch, value in enumerate(values, start=1)], colours[name], 2)


def _scale(values: Sequence[float]) -> tuple[float, float, float]:
    """Ends of a scale that holds the values, and the step of its lines: 1, 2 or 5 times a power of ten."""
    lowest, highest = min(values, default=0.0), max(values, default=1.0)
    rough = max(highest - lowest, 1e-6) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))
    low = step * math.floor(lowest / step + 1e-9)
    high = max(step * math.ceil(highest / step - 1e-9), low + step)
    return round(low, 9), round(high, 9), step
