from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from simharness.play.metrics import Percentiles, Rate, summarise, wilson_interval
from simharness.play.records import Latency

Counts = st.integers(1, 2000).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total)))


@given(Counts)
def test_the_interval_is_scipys_wilson_interval(counts: tuple[int, int]) -> None:
    expected = binomtest(*counts).proportion_ci(0.95, method="wilson")
    assert wilson_interval(*counts) == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(Counts)
def test_the_interval_holds_the_rate_and_stays_between_0_and_1(counts: tuple[int, int]) -> None:
    low, high = wilson_interval(*counts)
    assert 0 <= low <= counts[0] / counts[1] <= high <= 1


@given(Counts)
def test_successes_and_failures_have_mirrored_intervals(counts: tuple[int, int]) -> None:
    count, total = counts
    low, high = wilson_interval(count, total)
    assert wilson_interval(total - count, total) == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_nothing_observed_leaves_everything_possible() -> None:
    assert Rate(0, 0).value is None
    assert Rate(0, 0).interval == (0.0, 1.0)


@pytest.mark.parametrize(("count", "total"), [(3, 2), (-1, 2), (1, 0)])
def test_impossible_counts_are_refused(count: int, total: int) -> None:
    with pytest.raises(ValueError, match="no rate"):
        wilson_interval(count, total)


def test_gsr_counts_attempts_and_dr_counts_objects(make_round: Any) -> None:
    summary = summarise(
        [make_round(0, 0, ["success", "slip", "success"]), make_round(0, 1, ["drop", "approach"], ended="two_failures")]
    )
    assert (summary.gsr.count, summary.gsr.total) == (2, 5)
    assert (summary.dr.count, summary.dr.total) == (2, 10)
    assert summary.failures == {"pregrasp": 0, "approach": 1, "slip": 1, "drop": 1}
    assert summary.ended == {"empty": 1, "two_failures": 1, "no_grasps": 0}
    assert summary.rounds == 2


def test_two_objects_lifted_at_once_count_once(make_round: Any) -> None:
    record = make_round(0, 0, ["success"])
    both = dataclasses.replace(record.attempts[0], grasped=record.objects[:2])
    summary = summarise([dataclasses.replace(record, attempts=(both,))])
    assert summary.dr.count == summary.gsr.count == 1


def test_observations_without_a_grasp_are_counted_by_reason(make_round: Any) -> None:
    summary = summarise(
        [
            make_round(0, 0, [], ("no_candidates", "all_in_collision", "no_candidates"), "no_grasps"),
            make_round(0, 1, ["success"], ("no_candidates",)),
        ]
    )
    assert summary.no_grasps == {"all_in_collision": 1, "no_candidates": 3}
    assert summary.gsr.total == 1


def test_latencies_are_of_the_requests_that_were_made(make_round: Any) -> None:
    summary = summarise([make_round(0, 0, ["success", "slip", "slip"], ("no_points_in_workspace",))])
    assert (summary.service_ms.median, summary.service_ms.p95) == pytest.approx((11.0, 11.9))
    assert (summary.round_trip_ms.median, summary.round_trip_ms.p95) == pytest.approx((13.0, 13.9))
    assert summarise([]).service_ms == Percentiles(None, None)


def test_requests_that_found_nothing_took_their_time_too(make_round: Any) -> None:
    record = make_round(0, 0, ["success"], ("no_candidates", "no_candidates"))
    slow = tuple(
        dataclasses.replace(entry, latency=Latency(service=90.0, round_trip=95.0)) for entry in record.no_grasps
    )
    summary = summarise([dataclasses.replace(record, no_grasps=slow)])
    assert (summary.service_ms.median, summary.round_trip_ms.median) == (90.0, 95.0)
