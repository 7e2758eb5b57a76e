from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from simharness.errors import UsageError
from simharness.play.records import AttemptRecord, RoundRecord
from simharness.play.replay import find_attempt, replay
from simharness.play.round import (
    Attempted,
    Observed,
    Plan,
    camera_noise,
    camera_rng,
    play_round,
    request_seed,
    scene_rng,
)
from simharness.sim.camera import Observation
from simharness.sim.objects import ObjectModel, load_object_set

pytestmark = pytest.mark.sim


class TopDown:
    """Grasps the highest thing from above, across its shorter side."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def plan(self, observation: Observation, seed: int) -> Plan:
        self.seeds.append(seed)
        points = observation.points_world.astype(np.float64)
        top = points[points[:, 2].argmax()]
        near = points[np.linalg.norm(points[:, :2] - top[:2], axis=1) < 0.03]
        _, axes = np.linalg.eigh(np.cov((near - near.mean(axis=0))[:, :2].T))
        y, z = np.array([*axes[:, 0], 0.0]), np.array([0.0, 0.0, -1.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        pose[:3, 3] = [*near.mean(axis=0)[:2], max(top[2] - 0.03, 0.064)]
        response = {"counts": {"points": len(points)}, "timings_ms": {"total": 1.0}}
        return Plan(pose[None], np.array([0.5]), np.array([0.08]), 2.0, response)


class Scripted:
    """Says in turn what it was given: a reason for no grasp, or None for a grasp in empty air."""

    def __init__(self, script: Iterable[str | None]) -> None:
        self._script = iter(script)

    def plan(self, observation: Observation, seed: int) -> Plan:
        reason = next(self._script)
        if reason is not None:
            return Plan.nothing(reason)
        air = np.diag([1.0, -1.0, -1.0, 1.0])
        air[:3, 3] = [0.15, 0.15, 0.6]
        return Plan(air[None], np.array([0.5]), np.array([0.08]), 2.0)


@pytest.fixture(scope="module")
def objects() -> tuple[ObjectModel, ...]:
    return load_object_set("procedural", "packed")


def plain(record: RoundRecord) -> Any:
    return record.to_json(), [attempt.to_json() for attempt in record.attempts]


@pytest.fixture(scope="module")
def played(objects: tuple[ObjectModel, ...], make_settings: Any) -> RoundRecord:
    return play_round(make_settings(), objects, TopDown(), 0, 1)


def test_a_good_planner_clears_tables(played: RoundRecord) -> None:
    assert sum(attempt.success for attempt in played.attempts) >= 2
    assert len(played.objects) <= 5


def test_objects_that_are_there_dwindle_by_what_was_lifted(played: RoundRecord) -> None:
    assert played.attempts[0].objects == played.objects
    for before, after in zip(played.attempts, played.attempts[1:], strict=False):
        left = list(before.objects)
        for name in before.grasped:
            left.remove(name)
        assert set(after.objects) <= set(left)
        assert before.success == bool(before.grasped)


def test_the_same_seed_gives_the_same_round_bit_for_bit_whatever_was_played_before(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    play_round(make_settings(), objects, Scripted([None, None]), 5, 0)
    assert plain(play_round(make_settings(), objects, TopDown(), 0, 1)) == plain(played)


def test_another_seed_gives_another_round(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    other = play_round(make_settings(), objects, Scripted(["no_candidates"] * 3), 1, 1)
    assert other.objects != played.objects


def test_listening_changes_nothing(played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any) -> None:
    events: list[Any] = []
    again = play_round(make_settings(), objects, TopDown(), 0, 1, events.append, segmentation=True)
    assert plain(again) == plain(played)
    assert [type(event) for event in events] == [Observed, Attempted] * len(played.attempts)
    first = events[0]
    assert set(first.objects) <= set(np.unique(first.view.images[0].segmentation).tolist()) | set(first.objects)
    assert len(set(first.objects) & set(np.unique(first.view.images[0].segmentation).tolist())) >= 1


def test_scene_and_camera_are_the_same_for_every_planner_and_executor(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    other = play_round(make_settings(executor="strict"), objects, Scripted([None, None]), 0, 1)
    assert other.objects == played.objects
    assert other.attempts[0].viewpoints == played.attempts[0].viewpoints
    assert other.attempts[0].request_seed == played.attempts[0].request_seed


def test_two_failures_in_a_row_end_a_round(objects: tuple[ObjectModel, ...], make_settings: Any) -> None:
    record = play_round(make_settings(), objects, Scripted([None, "no_candidates", None]), 0, 2)
    assert record.ended == "two_failures"
    assert [attempt.outcome for attempt in record.attempts] == ["slip", "slip"]
    assert [attempt.observation for attempt in record.attempts] == [0, 2]
    assert [entry.observation for entry in record.no_grasps] == [1]


def test_three_observations_in_a_row_without_a_grasp_end_a_round(
    objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    script = ["too_few_points", "no_candidates", None, "all_in_collision", "no_candidates", "no_candidates"]
    record = play_round(make_settings(), objects, Scripted(script), 0, 2)
    assert record.ended == "no_grasps"
    assert [entry.reason for entry in record.no_grasps] == [reason for reason in script if reason is not None]
    assert len(record.attempts) == 1


def test_every_observation_has_its_own_camera_and_request_seed(
    objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    planner = TopDown()
    record = play_round(make_settings(), objects, planner, 0, 1)
    assert len(set(planner.seeds)) == len(planner.seeds)
    assert planner.seeds == [request_seed(0, 1, observation) for observation in range(len(planner.seeds))]
    assert len({attempt.viewpoints for attempt in record.attempts}) == len(record.attempts)


def test_random_numbers_depend_on_seed_round_and_observation_alone() -> None:
    draws = {
        tuple(rng.integers(0, 2**62, 2).tolist())
        for rng in (
            scene_rng(0, 0),
            scene_rng(0, 1),
            scene_rng(1, 0),
            camera_rng(0, 0, 0),
            camera_rng(0, 0, 1),
            camera_rng(0, 1, 0),
            camera_rng(1, 0, 0),
        )
    }
    assert len(draws) == 7
    assert scene_rng(3, 4).integers(0, 2**62) == scene_rng(3, 4).integers(0, 2**62)
    assert 0 <= request_seed(0, 0, 0) < 2**31


def test_the_cameras_noise_can_be_replaced(make_settings: Any) -> None:
    assert camera_noise(make_settings()).point_sigma == 0.0008
    assert camera_noise(make_settings(noise_std=0.002)).point_sigma == 0.002
    assert camera_noise(make_settings(camera="giga", noise_std=0.0)).dex
    assert camera_noise(make_settings(depth_noise_std=0.001)).depth_sigma == 0.001


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
