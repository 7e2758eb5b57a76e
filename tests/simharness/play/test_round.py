from __future__ import annotations

import inspect
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from simharness.play import round as playing
from simharness.play.records import RoundRecord
from simharness.play.replay import RecordedPlanner
from simharness.play.round import (
    Attempted,
    Observed,
    camera_rng,
    camera_sensor,
    play_round,
    request_seed,
    scene_rng,
)
from simharness.sim.camera import Stand
from simharness.sim.objects import ObjectModel
from simharness.sim.scene import scales_for
from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.sensors.gaussian import DepthGaussian
from tesnet.hands import HANDS
from tests.simharness.planners import Alternating, Scripted, TopDown

pytestmark = pytest.mark.sim


def plain(record: RoundRecord) -> Any:
    return record.to_json(), [attempt.to_json() for attempt in record.attempts]


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


def test_who_is_unsure_looks_again_and_asks_about_all_that_was_seen(
    objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    """A score as high as asked is enough; a third look is the last; after an attempt nothing of before counts."""
    planner = Scripted([0.3, "no_candidates", 0.4, 0.3, 0.7])
    record = play_round(make_settings(look_again_below=0.7), objects, planner, 0, 2)
    assert record.ended == "two_failures"
    assert [(attempt.observation, attempt.score) for attempt in record.attempts] == [(2, 0.4), (4, 0.7)]
    assert [(entry.observation, entry.reason) for entry in record.no_grasps] == [
        (0, "unsure"),
        (1, "no_candidates"),
        (3, "unsure"),
    ]
    views = [len(seen.viewpoints) for seen in planner.seen]
    assert views == [1, 2, 3, 1, 2]
    assert [len(attempt.viewpoints) for attempt in record.attempts] == [3, 2]
    first, third = planner.seen[0], planner.seen[2]
    np.testing.assert_array_equal(third.points_world[: len(first.points_world)], first.points_world)


def test_three_looks_at_last_without_a_grasp_end_a_round(objects: tuple[ObjectModel, ...], make_settings: Any) -> None:
    planner = Scripted([0.3, 0.3, "all_in_collision"])
    record = play_round(make_settings(look_again_below=0.7), objects, planner, 0, 2)
    assert (record.ended, record.attempts) == ("no_grasps", ())
    assert [entry.reason for entry in record.no_grasps] == ["unsure", "unsure", "all_in_collision"]


def test_a_round_with_looks_again_is_replayed(objects: tuple[ObjectModel, ...], make_settings: Any) -> None:
    settings = make_settings(look_again_below=0.7)
    record = play_round(settings, objects, Scripted([0.3, 0.3, 0.4, 0.8]), 0, 2)
    again = play_round(settings, objects, RecordedPlanner(record), 0, 2)
    assert [attempt.viewpoints for attempt in again.attempts] == [attempt.viewpoints for attempt in record.attempts]
    assert [entry.observation for entry in again.no_grasps] == [0, 1]


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
    assert camera_sensor(make_settings()).point_sigma == 0.0008
    assert camera_sensor(make_settings(noise_std=0.002)).point_sigma == 0.002
    assert camera_sensor(make_settings(camera="giga", noise_std=0.0)) == SENSORS["dex"]
    assert camera_sensor(make_settings(depth_noise_std=0.001)).depth == (DepthGaussian(0.001),)


def test_failures_end_a_round_only_in_a_row(objects: tuple[ObjectModel, ...], make_settings: Any) -> None:
    record = play_round(make_settings(), objects, Alternating(), 0, 1)
    outcomes = [attempt.success for attempt in record.attempts]
    assert outcomes[:3] == [False, True, False]
    in_a_row = [not (first or second) for first, second in pairwise(outcomes)]
    assert not any(in_a_row[:-1])
    assert in_a_row[-1] == (record.ended == "two_failures")


def test_what_replaces_the_cameras_noise_leaves_the_rest_of_its_sensor(make_settings: Any) -> None:
    """A zero is no noise, not a setting that was left out."""
    assert camera_sensor(make_settings(noise_std=0.0)).point_sigma == 0
    assert camera_sensor(make_settings(sensor="d435", depth_noise_std=0.0)).depth == SENSORS["d435"].depth
    assert (
        camera_sensor(make_settings(sensor="d435", dex_noise=True)).depth
        == SENSORS["dex"].depth + SENSORS["d435"].depth
    )
    assert camera_sensor(make_settings(sensor="dex", dex_noise=False)).depth == ()
    assert camera_sensor(make_settings(sensor="dex", dex_noise=True)) == SENSORS["dex"]
    both = camera_sensor(make_settings(sensor="d435", depth_noise_std=0.001, noise_std=0.002))
    assert (set(both.depth), both.point_sigma) == ({*SENSORS["d435"].depth, DepthGaussian(0.001)}, 0.002)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"camera": "top", "polar_deg": 40.0, "distance": 0.5, "voxel_size": 0.01},
        {"calibrate": True, "sensor": "d435", "executor": "strict"},
        {"calibrate": True, "table_in_view": False, "scene": "pile", "objects": "procedural"},
        {"table_in_view": True, "gripper": "rg2"},
    ],
)
def test_a_round_is_played_as_its_settings_say(
    changes: dict[str, Any], objects: tuple[ObjectModel, ...], make_settings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its scene, its camera and its hand; what is looked for is what the functions are told that do these."""
    told: dict[str, dict[str, Any]] = {}
    for name in ("make_scene", "observe", "attempt"):
        real = getattr(playing, name)

        def noted(*arguments: Any, real: Any = real, name: str = name, **options: Any) -> Any:
            bound = inspect.signature(real).bind(*arguments, **options)
            bound.apply_defaults()
            told[name] = dict(bound.arguments)
            return real(*arguments, **options)

        monkeypatch.setattr(playing, name, noted)
    settings = make_settings(**changes)
    record = play_round(settings, objects, Scripted([None, None]), 4, 6)
    hand = HANDS[changes.get("gripper", "franka")].gripper
    scene, view, tried = told["make_scene"], told["observe"], told["attempt"]
    assert (scene["kind"], scene["num_objects"]) == (settings.scene, 5)
    assert scene["scale_range"] == scales_for(settings.scene, hand)
    assert view["preset"] == settings.camera
    assert view["sensor"] == camera_sensor(settings)
    assert view["stand"] == Stand(changes.get("polar_deg"), changes.get("distance"))
    assert view["voxel_size"] == changes.get("voxel_size")
    assert view["table_in_view"] == changes.get("table_in_view", changes.get("calibrate", False))
    assert tried["executor"] == settings.executor
    assert tried["hand"].gripper == hand
    np.testing.assert_array_equal(tried["T_world_grasp"], record.attempts[-1].T_world_grasp)
    assert tried["width"] == record.attempts[-1].width


def test_seeds_of_requests_fill_their_range_and_differ() -> None:
    seeds = [request_seed(seed, number, look) for seed in range(5) for number in range(10) for look in range(10)]
    assert len(set(seeds)) == 500
    assert 2**31 * 0.98 < max(seeds) < 2**31
    assert -1 < min(seeds) < 2**31 * 0.02


def test_random_numbers_of_a_scene_of_a_camera_and_of_a_request_have_nothing_in_common() -> None:
    first = [scene_rng(0, 0).random(), *(camera_rng(0, 0, look).random() for look in range(3))]
    others = [
        scene_rng(0, 1).random(),
        scene_rng(1, 0).random(),
        camera_rng(0, 1, 0).random(),
        camera_rng(1, 0, 0).random(),
    ]
    assert len({*first, *others}) == 8
    assert scene_rng(3, 4).random() == scene_rng(3, 4).random()
    assert camera_rng(3, 4, 5).random() == camera_rng(3, 4, 5).random()
