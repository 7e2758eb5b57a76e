from __future__ import annotations

from typing import Any

import pytest

from simharness.play.metrics import Summary
from simharness.report.progress import Progress


def test_the_bar_counts_rounds_and_shows_the_rates(
    make_settings: Any, make_round: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[Summary] = []
    progress = Progress(make_settings(rounds=2, seeds=(0, 1)))
    progress.also(heard.append)
    progress.start([make_round(0, 0, ["success"] * 5)])
    progress.add(make_round(0, 1, ["slip", "drop"], ended="two_failures"))
    progress.close()
    bar = capsys.readouterr().err
    assert "2/4" in bar
    assert "GSR 71.4 %, DR 50.0 %" in bar
    assert [(summary.rounds, summary.gsr.count, summary.gsr.total) for summary in heard] == [(1, 5, 5), (2, 5, 7)]


def test_a_run_that_never_began_has_no_bar(make_settings: Any, capsys: pytest.CaptureFixture[str]) -> None:
    Progress(make_settings()).close()
    assert capsys.readouterr().err == ""
