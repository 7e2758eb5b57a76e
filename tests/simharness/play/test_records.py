from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simharness.play.records import AttemptRecord, NoGraspRecord, RoundRecord, Run


def through_json(values: Any) -> Any:
    return json.loads(json.dumps(values, allow_nan=False))


def test_records_come_back_from_json_as_they_were(make_round: Any) -> None:
    record = make_round(3, 7, ["success", "drop"], ("no_candidates", "camera saw nothing"), "two_failures")
    attempts = tuple(AttemptRecord.from_json(through_json(attempt.to_json())) for attempt in record.attempts)
    again = RoundRecord.from_json(through_json(record.to_json()), attempts)
    assert again.to_json() == record.to_json()
    assert again.no_grasps == record.no_grasps
    assert [attempt.to_json() for attempt in again.attempts] == [attempt.to_json() for attempt in record.attempts]


def test_a_pose_keeps_every_bit(make_round: Any) -> None:
    attempt = make_round(0, 0, ["slip"]).attempts[0]
    matrix = np.random.default_rng(0).normal(size=(4, 4))
    again = AttemptRecord.from_json(through_json(replace(attempt, T_world_grasp=matrix).to_json()))
    assert again.T_world_grasp.tobytes() == matrix.tobytes()
    assert again.to_json()["position"] == matrix[:3, 3].tolist()
    with pytest.raises(ValueError, match="read-only"):
        again.T_world_grasp[0, 0] = 1.0


def test_a_pose_of_another_shape_is_refused(make_round: Any) -> None:
    attempt = make_round(0, 0, ["slip"]).attempts[0]
    with pytest.raises(ValueError, match=r"\(3, 3\).*\(4, 4\)"):
        replace(attempt, T_world_grasp=np.eye(3))


def test_an_attempt_is_corrected_where_the_service_says_so(make_round: Any) -> None:
    attempt = make_round(0, 0, ["slip"]).attempts[0]
    corrected = "calibrate: depth is multiplied by 1.010"
    warnings = {(): False, ("depth is multiplied by 2",): False, ("x", corrected): True, ("calibrate: nothing",): False}
    for said, expected in warnings.items():
        assert replace(attempt, warnings=said).corrected is expected, said


def test_only_a_success_is_one(make_round: Any) -> None:
    kinds = ["success", "pregrasp", "approach", "slip", "drop"]
    assert [attempt.success for attempt in make_round(0, 0, kinds).attempts] == [True, False, False, False, False]


def test_a_round_needs_all_its_attempts_and_a_known_end(make_round: Any) -> None:
    record = make_round(0, 0, ["success", "slip"])
    with pytest.raises(ValueError, match="2 attempts; 1 were given"):
        RoundRecord.from_json(record.to_json(), record.attempts[:1])
    with pytest.raises(ValueError, match="'bored'"):
        RoundRecord.from_json({**record.to_json(), "ended": "bored"}, record.attempts)


def test_an_observation_without_a_request_has_no_times() -> None:
    entry = NoGraspRecord(2, "no_points_in_workspace", {}, None)
    assert NoGraspRecord.from_json(through_json(entry.to_json())) == entry


def test_a_run_is_complete_when_every_round_of_every_seed_was_played(run: Run) -> None:
    assert run.complete
    assert not replace(run, rounds=run.rounds[1:]).complete
