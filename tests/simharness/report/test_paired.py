"""Differences paired by scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.__main__ import main
from simharness.errors import UsageError
from simharness.play.folder import RunFolder
from simharness.play.records import RoundRecord
from simharness.report import paired as module
from simharness.report.paired import Paired, paired, points
from tests.simharness.recorded import MODEL, SERVING


@pytest.fixture
def played(make_round: Any) -> Any:
    """Rounds of seed 0 in which so many of so many attempts succeeded."""

    def make(counts: Sequence[tuple[int, int]]) -> list[RoundRecord]:
        return [
            make_round(0, number, ["success"] * good + ["slip"] * (all_of_them - good))
            for number, (good, all_of_them) in enumerate(counts)
        ]

    return make


def compare(first: Sequence[RoundRecord], second: Sequence[RoundRecord]) -> Paired:
    return paired(first, second, np.random.default_rng(0))


def random_counts(rng: np.random.Generator, rounds: int, rate: float) -> list[tuple[int, int]]:
    return [(int(rng.binomial(total, rate)), int(total)) for total in rng.integers(1, 6, rounds)]


def test_a_run_differs_from_itself_by_nothing(played: Any) -> None:
    result = compare(played([(3, 4), (5, 5), (0, 2)]), played([(3, 4), (5, 5), (0, 2)]))
    assert (result.gsr.value, result.gsr.interval) == (0.0, (0.0, 0.0))
    assert (result.dr.value, result.dr.interval) == (0.0, (0.0, 0.0))


def test_the_difference_is_that_of_the_pooled_rates_and_turns_its_sign_with_the_runs(played: Any) -> None:
    first, second = played([(3, 4), (5, 5), (0, 2)]), played([(1, 3), (5, 6 - 1), (2, 2)])
    result, turned = compare(first, second), compare(second, first)
    assert result.gsr.value == pytest.approx(8 / 11 - 8 / 10)
    assert result.dr.value == pytest.approx(0.0)
    assert (result.first.gsr.count, result.first.gsr.total, result.second.gsr.total) == (8, 11, 10)
    assert turned.gsr.value == pytest.approx(8 / 10 - 8 / 11)
    assert result.gsr.interval is not None
    assert turned.gsr.interval is not None
    assert turned.gsr.interval == pytest.approx([-result.gsr.interval[1], -result.gsr.interval[0]])


def test_the_interval_is_that_of_rounds_drawn_one_by_one(played: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    counts = [random_counts(rng, 60, rate) for rate in (0.8, 0.7)]
    result = compare(played(counts[0]), played(counts[1]))
    table = np.hstack([np.array(counts[0]), np.array(counts[1])])
    slow = []
    for _ in range(4000):
        goods_a, all_a, goods_b, all_b = sum(table[rng.integers(0, 60)] for _ in range(60))
        slow.append(goods_a / all_a - goods_b / all_b)
    assert result.gsr.interval == pytest.approx(np.quantile(slow, [0.025, 0.975]), abs=0.012)


def test_the_interval_is_as_wide_as_the_linearised_difference_has_it(played: Any) -> None:
    rng = np.random.default_rng(4)
    counts = [np.array(random_counts(rng, 300, rate)) for rate in (0.9, 0.8)]
    result = compare(played(counts[0]), played(counts[1]))
    # A ratio of sums moves by (s - R n) / N for a round with s of n, Cochran 1977, section 2.11.
    moves = sum(
        sign * (of[:, 0] - of[:, 0].sum() / of[:, 1].sum() * of[:, 1]) / of[:, 1].sum()
        for sign, of in ((1, counts[0]), (-1, counts[1]))
    )
    deviation = math.sqrt((np.asarray(moves) ** 2).sum())
    assert result.gsr.interval is not None
    assert result.gsr.interval[1] - result.gsr.interval[0] == pytest.approx(2 * 1.96 * deviation, rel=0.05)


def test_intervals_hold_the_true_difference_as_often_as_they_say(played: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RESAMPLES", 1000)
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        hard = rng.random(80) < 0.3  # scenes that are hard for both: what pairing is for
        counts = [[(int(rng.binomial(5, 0.4 if scene else rate)), 5) for scene in hard] for rate in (0.95, 0.85)]
        result = compare(played(counts[0]), played(counts[1]))
        assert result.gsr.interval is not None
        held += result.gsr.interval[0] <= 0.7 * (0.95 - 0.85) <= result.gsr.interval[1]
    assert 0.9 * 200 <= held <= 0.99 * 200


def test_scenes_that_are_hard_for_both_do_not_widen_the_interval(played: Any) -> None:
    counts = [(5, 5)] * 50 + [(1, 5)] * 50
    better = [(5, 5)] * 50 + [(2, 5)] * 50
    result = compare(played(better), played(counts))
    alone = result.first.gsr.interval
    assert result.gsr.interval is not None
    assert result.gsr.interval[1] - result.gsr.interval[0] < 0.5 * (alone[1] - alone[0])
    assert result.gsr.interval[0] > 0


def test_rounds_of_one_run_alone_are_left_out_and_counted(played: Any) -> None:
    result = compare(played([(3, 4), (5, 5), (0, 2)]), played([(3, 4), (4, 5)]))
    assert (result.first.rounds, result.second.rounds, result.left_out) == (2, 2, 1)
    assert result.gsr.value == pytest.approx(1 / 9)
    turned = compare(played([(3, 4), (4, 5)]), played([(3, 4), (5, 5), (0, 2)]))
    assert (turned.first.rounds, turned.left_out) == (2, 1)


def test_nothing_to_count_is_no_difference_of_zero(played: Any) -> None:
    result = compare(played([(0, 0)]), played([(4, 5)]))
    assert (result.gsr.value, result.gsr.interval, points(result.gsr)) == (None, None, "-")
    assert result.dr.value == pytest.approx(-0.8)
    assert result.to_json()["gsr_difference_interval"] is None


def test_other_scenes_are_refused(played: Any) -> None:
    first, second = played([(3, 4)]), played([(3, 4)])
    with pytest.raises(UsageError, match="no round in common"):
        compare(first, [replace(second[0], seed=1)])
    with pytest.raises(UsageError, match="round 0 of seed 0 began with"):
        compare(first, [replace(second[0], objects=("set/other",) * 5)])


def test_the_command_tells_rates_difference_and_what_else_differs(
    played: Any, make_settings: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, executor, counts in (("a", "strict", [(3, 4), (5, 5)]), ("b", "edge", [(2, 4)])):
        folder = RunFolder(tmp_path / name)
        settings = make_settings(executor=executor)
        folder.prepare(settings, resume=False)
        folder.start(settings, MODEL, SERVING)
        for record in played(counts):
            folder.append(record)
    assert main(["paired", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    said = capsys.readouterr().out
    assert "75.0 % (3 of 4)" in said
    assert "+25.0" in said
    assert "left out  1 that only one run has" in said
    assert "settings  executor strict and edge" in said
    assert main(["paired", str(tmp_path / "a"), str(tmp_path / "nowhere")]) == 2
