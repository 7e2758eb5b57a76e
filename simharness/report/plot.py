"""Rates with their intervals as one SVG drawing: panels in rows, a line of dots for each series."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from simharness.play.metrics import Rate

_COLOURS = ("#2563eb", "#d97706", "#16a34a", "#7c3aed")
_INK, _SOFT, _LINE = "#0f172a", "#64748b", "#e2e8f0"
_PANEL_WIDTH, _PLOT_HEIGHT = 330, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 14, 76, 66
_LEVEL_WIDTH = 72
"""Pixels that a level and its label need at least."""

_DRAWING_WIDTH = 5 * _PANEL_WIDTH
"""Pixels at which a row is full."""

_ROW_HEIGHT = _PLOT_HEIGHT + _BOTTOM + 34
_APART = 9
"""Pixels between the dots of two series at one level."""

_CAP = 4
_GRID_LINES = 6


@dataclass(frozen=True, slots=True)
class Panel:
    """One drawing of several.

    Args:
        title: over it.
        levels: under it, from left to right; a line break splits a label.
        joined: so many levels, from the first, lie on one scale and are joined by a line.
        series: rates by name, one for each level; None where there is none.
    """

    title: str
    levels: Sequence[str]
    joined: int
    series: Mapping[str, Sequence[Rate | None]]


def plot(title: str, panels: Sequence[Panel]) -> str:
    """The text of an SVG file; every panel has the same vertical scale, up to 100 %.

    Args:
        title: over everything.
        panels: with the same names of series.
    """
    floor, step = _scale(panels)
    places = _places(panels)
    width = max((x + _width(panel) for panel, (x, _) in zip(panels, places, strict=True)), default=_PANEL_WIDTH)
    height = _TOP + _PLOT_HEIGHT + _BOTTOM + max((y for _, y in places), default=0)
    size = f'width="{width}" height="{height}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="system-ui, sans-serif">',
        f'<rect {size} fill="#ffffff"/>',
        _text(_LEFT, 22, title, size=14, colour=_INK, anchor="start"),
        *_legend(list(panels[0].series) if panels else []),
    ]
    for panel, (across, down) in zip(panels, places, strict=True):
        parts.append(f'<g transform="translate({across} {down})">')
        parts += _axes(panel, floor, step)
        for index, (name, rates) in enumerate(panel.series.items()):
            shift = _APART * (index - (len(panel.series) - 1) / 2)
            parts += _series(panel, name, rates, shift, _COLOURS[index % len(_COLOURS)], floor)
        parts.append("</g>")
    return "\n".join([*parts, "</svg>"]) + "\n"


def _width(panel: Panel) -> int:
    return max(_PANEL_WIDTH, _LEVEL_WIDTH * len(panel.levels))


def _places(panels: Sequence[Panel]) -> list[tuple[int, int]]:
    """Where each panel's upper left corner lies: from left to right, in a new row where the last one is full."""
    places = []
    x = y = 0
    for panel in panels:
        if x and x + _width(panel) > _DRAWING_WIDTH:
            x, y = 0, y + _ROW_HEIGHT
        places.append((x, y))
        x += _width(panel)
    return places


def _scale(panels: Sequence[Panel]) -> tuple[int, int]:
    """Percent at the lower end of the vertical scale, and between two of its lines."""
    lows = [100 * rate.interval[0] for panel in panels for rates in panel.series.values() for rate in rates if rate]
    lowest = min(lows, default=0.0)
    step = next(step for step in (2, 5, 10, 20) if step * (_GRID_LINES - 1) >= 100 - lowest)
    return max(0, step * math.floor(lowest / step)), step


def _axes(panel: Panel, floor: int, step: int) -> list[str]:
    right = _width(panel) - _RIGHT
    parts = [_text((_LEFT + right) / 2, _TOP - 12, panel.title, size=12, colour=_INK)]
    for percent in range(floor, 101, step):
        y = _y(percent, floor)
        parts.append(f'<line x1="{_LEFT}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" stroke="{_LINE}"/>')
        parts.append(_text(_LEFT - 6, y + 4, f"{percent} %", anchor="end"))
    for index, label in enumerate(panel.levels):
        for row, line in enumerate(label.split("\n")):
            parts.append(_text(_x(panel, index), _TOP + _PLOT_HEIGHT + 18 + 14 * row, line))
    return parts


def _series(panel: Panel, name: str, rates: Sequence[Rate | None], shift: float, colour: str, floor: int) -> list[str]:
    parts = []
    joined = []
    for index, rate in enumerate(rates):
        if rate is None or rate.value is None:
            continue
        x, y = _x(panel, index) + shift, _y(100 * rate.value, floor)
        low, high = (_y(100 * limit, floor) for limit in rate.interval)
        caps = "".join(f"M{x - _CAP:.1f} {end:.1f}h{2 * _CAP}" for end in (low, high))
        label = escape(f"{name} {100 * rate.value:.1f} %, {rate.count} of {rate.total}")
        parts.append(f'<path d="M{x:.1f} {low:.1f}V{high:.1f}{caps}" stroke="{colour}" fill="none"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"><title>{label}</title></circle>')
        if index < panel.joined:
            joined.append(f"{x:.1f},{y:.1f}")
    line = f'<polyline points="{" ".join(joined)}" stroke="{colour}" stroke-opacity="0.45" fill="none"/>'
    return [line, *parts]


def _legend(names: Sequence[str]) -> list[str]:
    parts = []
    for index, name in enumerate(names):
        x = _LEFT + 70 * index
        colour = _COLOURS[index % len(_COLOURS)]
        parts.append(f'<circle cx="{x + 4}" cy="38" r="3.5" fill="{colour}"/>')
        parts.append(_text(x + 14, 42, name, anchor="start"))
    parts.append(_text(_LEFT + 70 * len(names), 42, "bars: 95 % Wilson intervals", anchor="start"))
    return parts


def _x(panel: Panel, index: int) -> float:
    room = _width(panel) - _LEFT - _RIGHT
    return _LEFT + room * (index + 0.5) / len(panel.levels)


def _y(percent: float, floor: int) -> float:
    return _TOP + _PLOT_HEIGHT * (100 - percent) / (100 - floor)


def _text(x: float, y: float, text: str, *, size: int = 11, colour: str = _SOFT, anchor: str = "middle") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}">{escape(text)}</text>'
    )
