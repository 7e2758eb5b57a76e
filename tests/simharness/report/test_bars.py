"""Rates as bars."""

from __future__ import annotations

import re
from xml.etree import ElementTree as ET

import pytest

from simharness.drawing import COLOURS
from simharness.play.metrics import Rate
from simharness.report.bars import bars
from simharness.report.plot import Panel

NAMES = ["gpd", "tesnet"]
GSR = [Rate(10, 20), Rate(40, 40)]
DR = [Rate(0, 0), Rate(30, 40)]


def lines(svg: str, colour: str) -> list[tuple[float, float]]:
    """From and to where lines of a colour run, legend first."""
    found = re.findall(rf'points="([\d.]+),[\d.]+ ([\d.]+),[\d.]+" stroke="{colour}" stroke-width="(?!1")', svg)
    return [(float(start), float(end)) for start, end in found]


def test_a_bar_is_as_long_as_its_rate_and_begins_at_zero() -> None:
    svg = bars("Title", [Panel("packed", NAMES, 0, {"GSR": GSR, "DR": DR})]).svg()
    (_, half, full), (_, three_quarters) = (lines(svg, colour) for colour in COLOURS[:2])
    assert half[0] == full[0] == three_quarters[0]
    whole = full[1] - full[0]
    assert half[1] - half[0] == pytest.approx(whole / 2, abs=0.1)
    assert three_quarters[1] - three_quarters[0] == pytest.approx(0.75 * whole, abs=0.1)
    texts = [text.text for text in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]
    assert {"gpd", "tesnet", "50.0", "100.0", "75.0", "-", "packed", "Title"} <= set(texts)


def test_whiskers_end_at_the_interval_s_limits() -> None:
    svg = bars("Title", [Panel("packed", ["gpd"], 0, {"GSR": GSR[:1]})]).svg()
    ((start, end),) = lines(svg, COLOURS[0])[1:]
    whiskers = re.findall(r'points="([\d.]+),([\d.]+) ([\d.]+),([\d.]+)" stroke="#64748b" stroke-width="1"', svg)
    level = [(float(a), float(c)) for a, b, c, d in whiskers if b == d]
    low, high = (start + 2 * (end - start) * limit for limit in GSR[0].interval)
    assert level == [pytest.approx((low, high), abs=0.11)]


def test_panels_stand_side_by_side_and_hold_as_many_levels_as_they_have() -> None:
    short = Panel("packed", NAMES[:1], 0, {"GSR": GSR[:1]})
    long = Panel("pile", NAMES, 0, {"GSR": GSR})
    together, alone = bars("Title", [short, long]), bars("Title", [short])
    assert together.width == 2 * alone.width
    assert together.height > alone.height
