from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from simharness.play.metrics import summarise
from simharness.play.photographer import VIEWS, attempts_to_show, picture_name
from simharness.play.pictures import (
    png,
)
from simharness.play.records import Run
from simharness.report.page import page
from simharness.report.report import report


class Page(HTMLParser):
    """Checks that tags are closed in order, and gathers what a browser would load."""

    VOID = frozenset({"meta", "img", "br", "link", "rect", "line", "circle"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read_page(run: Run, pictures: Path) -> Page:
    shown = attempts_to_show(run.rounds, run.settings.seeds[0])
    parsed = Page()
    parsed.feed(page(run, report(run, {}), shown, pictures))
    parsed.close()
    assert not parsed.open
    return parsed


def test_the_page_needs_no_other_file_and_no_network(run: Run, tmp_path: Path) -> None:
    for attempt in attempts_to_show(run.rounds, 0):
        for view in VIEWS:
            (tmp_path / picture_name(attempt, view)).write_bytes(png(np.zeros((48, 64, 3), np.uint8)))
    parsed = read_page(run, tmp_path)
    assert len(parsed.loaded) == 3 * len(attempts_to_show(run.rounds, 0))
    assert all(source.startswith("data:image/png;base64,") for source in parsed.loaded)
    assert not re.search(r"url\(|@import", "".join(parsed.text))


def test_the_page_shows_rates_and_outcomes(run: Run, tmp_path: Path) -> None:
    text = " ".join(read_page(run, tmp_path).text)
    for word in ("70.0 %", "35.0 %", "7 of 10", "approach", "By seed", "ab" * 32):
        assert word in text
    assert "Incomplete" not in text


def test_the_page_of_a_broken_run_says_so(run: Run, tmp_path: Path) -> None:
    broken = dataclasses.replace(run, rounds=run.rounds[:1], stopped_by="the service <died>")
    text = " ".join(read_page(broken, tmp_path).text)
    assert "Incomplete: 1 of 4 rounds" in text
    assert "the service <died>" in text


def test_names_are_escaped_on_the_page(run: Run, tmp_path: Path) -> None:
    odd = dataclasses.replace(run, settings=dataclasses.replace(run.settings, objects="<script>alert(1)</script>"))
    assert "<script>" not in page(odd, report(odd, {}), [], tmp_path)


def test_bars_of_rates_end_where_their_intervals_do(run: Run, tmp_path: Path) -> None:
    html = page(run, report(run, {}), [], tmp_path)
    drawn = [tuple(map(float, pair)) for pair in re.findall(r"left:([0-9.]+)%;width:([0-9.]+)%", html)]
    summary = summarise(run.rounds)
    for rate in (summary.gsr, summary.dr):
        low, high = (100 * limit for limit in rate.interval)
        assert any(abs(left - low) < 0.01 and abs(left + width - high) < 0.02 for left, width in drawn)
    assert all(left + width <= 100.01 for left, width in drawn)
