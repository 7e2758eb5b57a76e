from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simharness.errors import UsageError
from simharness.play.records import AttemptRecord, RoundRecord
from simharness.play.replay import RecordedPlanner, find_attempt, replay
from simharness.sim.objects import ObjectModel

pytestmark = pytest.mark.sim


def test_a_replayed_attempt_ends_as_recorded(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    last = len(played.attempts) - 1
    stored = RoundRecord.from_json(
        played.to_json(), tuple(AttemptRecord.from_json(attempt.to_json()) for attempt in played.attempts)
    )
    events = replay(make_settings(), objects, stored, last)
    assert len(events) == len(played.attempts)
    for event, attempt in zip(events, played.attempts, strict=True):
        assert {**event.record.to_json(), "latency_ms": None} == {**attempt.to_json(), "latency_ms": None}


def test_a_replay_that_goes_another_way_says_so(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    with pytest.raises(UsageError, match="ended as"):
        replay(make_settings(), objects[: len(objects) // 2], played, 0)


def test_an_attempt_that_was_not_made_is_refused(played: RoundRecord) -> None:
    assert find_attempt([played, played], len(played.attempts)) is played.attempts[0]
    with pytest.raises(UsageError, match=r"--attempt 99.*give 0 to"):
        find_attempt([played], 99)


def test_a_replay_among_other_objects_says_so(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    first, *others = played.attempts
    elsewhere = replace(played, attempts=(replace(first, objects=("set/other", *first.objects[1:])), *others))
    with pytest.raises(UsageError, match=r"recorded was .* with set/other"):
        replay(make_settings(), objects, elsewhere, 0)


def test_a_recorded_planner_proposes_what_was_recorded(make_round: Any) -> None:
    """Grasps, widths and scores of each observation in turn, and none where there was none."""
    made = make_round(0, 0, ["success", "slip"], ("no_candidates",))
    attempts = tuple(
        replace(attempt, width=0.03 + 0.01 * number, score=0.5 + 0.1 * number, T_world_grasp=np.eye(4) + number)
        for number, attempt in enumerate(made.attempts)
    )
    planner = RecordedPlanner(replace(made, attempts=attempts))
    nothing_seen: Any = None
    for attempt in attempts:
        plan = planner.plan(nothing_seen, 0)
        np.testing.assert_array_equal(plan.Ts_world_grasp, attempt.T_world_grasp[None])
        assert (plan.widths.tolist(), plan.scores.tolist()) == ([attempt.width], [attempt.score])
        assert plan.counts == attempt.counts
    empty = planner.plan(nothing_seen, 0)
    assert (len(empty), empty.reason) == (0, "no_candidates")
