"""Rates with their intervals as horizontal bars from 0 to 100 %: panels side by side, a row of bars for each level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from simharness.drawing import COLOURS, GRID, INK, SOFT, Drawing, Line, Words
from simharness.play.metrics import Rate
from simharness.report.plot import Panel

_BAR, _BETWEEN_LEVELS = 13, 12
_LABELS, _SCALE, _VALUES = 120, 260, 52
_PANEL_WIDTH = _LABELS + _SCALE + _VALUES
_TOP, _BOTTOM = 84, 34
_CAP = 3


def bars(title: str, panels: Sequence[Panel]) -> Drawing:
    """Every panel has the same scale.

    Args:
        title: over everything.
        panels: with the same names of series.
    """
    names = list(panels[0].series)
    shapes: list[Line | Words] = [Words(_LABELS, 24, title, size=14, colour=INK, anchor="start"), *_legend(names)]
    for number, panel in enumerate(panels):
        shapes += _panel(panel, left=number * _PANEL_WIDTH + _LABELS)
    height = max(_height(panel) for panel in panels)
    return Drawing(len(panels) * _PANEL_WIDTH, _TOP + height + _BOTTOM, shapes)


def _legend(names: Sequence[str]) -> Iterator[Line | Words]:
    for index, name in enumerate(names):
        x = _LABELS + 60 * index
        yield Line([(x, 42), (x + 12, 42)], COLOURS[index], 9)
        yield Words(x + 18, 46, name, anchor="start")
    yield Words(_LABELS + 60 * len(names), 46, "whiskers: 95 % Wilson intervals", anchor="start")


def _panel(panel: Panel, left: float) -> Iterator[Line | Words]:
    bottom = _TOP + _height(panel)
    yield Words(left + _SCALE / 2, _TOP - 14, panel.title, size=12, colour=INK)
    for percent in range(0, 101, 20):
        x = left + _SCALE * percent / 100
        yield Line([(x, _TOP), (x, bottom)], GRID)
        yield Words(x, bottom + 18, f"{percent} %")
    for row, level in enumerate(panel.levels):
        top = _TOP + row * _level_height(panel) + _BETWEEN_LEVELS / 2
        middle = top + _BAR * len(panel.series) / 2
        yield Words(left - 8, middle + 4, level, colour=INK, anchor="end")
        for index, rates in enumerate(panel.series.values()):
            yield from _bar(rates[row], left, top + _BAR * (index + 0.5), COLOURS[index])


def _bar(rate: Rate | None, left: float, y: float, colour: str) -> Iterator[Line | Words]:
    if rate is None or rate.value is None:
        yield Words(left + _SCALE + 8, y + 4, "-", anchor="start")
        return
    low, high = (left + _SCALE * limit for limit in rate.interval)
    yield Line([(left, y), (left + _SCALE * rate.value, y)], colour, _BAR - 3)
    yield Line([(low, y), (high, y)], SOFT)
    for end in (low, high):
        yield Line([(end, y - _CAP), (end, y + _CAP)], SOFT)
    yield Words(left + _SCALE + 8, y + 4, f"{100 * rate.value:.1f}", anchor="start")


def _level_height(panel: Panel) -> int:
    return _BAR * len(panel.series) + _BETWEEN_LEVELS


def _height(panel: Panel) -> int:
    return _level_height(panel) * len(panel.levels)
