"""Causes of failed attempts, found by playing them again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.__main__ import main
from simharness.play.folder import RunFolder
from simharness.play.records import ModelRecord, RoundRecord, Serving
from simharness.play.round import Attempted, Observed, Plan, play_round
from simharness.report.causes import (
    _hiding_body,
    examine,
    failures,
    failures_report,
    failures_table,
    place_of,
)
from simharness.sim.camera import INTRINSICS, Images, Observation, observe_from
from simharness.sim.execute import Grip, Outcome
from simharness.sim.hand import HandContact
from simharness.sim.objects import ObjectModel, load_object_set
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT, restore_scene
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.world import World
from tesnet.geometry import Pose

pytestmark = pytest.mark.sim

FRONT, BACK = 0.10, 0.20


@pytest.fixture(scope="module")
def seen() -> Iterator[tuple[Observation, int, int]]:
    """Two boxes of 40 x 20 x 80 mm, one behind the other, seen from the side of the first; their ids."""
    with World() as world:
        restore_scene(world, {"kind": "packed", "objects": []}, {})
        front, back = (
            world.add_static_box((0.02, 0.01, 0.04), (0.15, y, TABLE_HEIGHT + 0.04), colour=(1.0, 0.0, 0.0, 1.0))
            for y in (FRONT, BACK)
        )
        camera = Pose.look_at([0.15, -0.5, 0.2], [0.15, 0.15, 0.1], [0.0, 0.0, 1.0])
        yield observe_from(world, [camera], np.random.default_rng(0), Sensor(), segmentation=True), front, back


def test_a_position_is_told_by_what_the_camera_saw_of_it(seen: tuple[Observation, int, int]) -> None:
    view, front, back = seen

    def place(x: float, y: float, z: float, body: int) -> str:
        return place_of(np.array([x, y, z]), body, view)

    assert place(0.15, FRONT - 0.01, 0.10, front) == "on a seen surface"
    assert place(0.15, FRONT + 0.01, 0.08, front) == "behind its own front"
    assert place(0.15, BACK - 0.01, 0.07, back) == "behind something else"
    assert place(0.15, FRONT + 0.01, 0.0505, front) == "lower than the crop"
    assert place(0.15, 0.29, 0.10, back) == "outside the perception box"
    assert place(0.25, FRONT, 0.10, front) == "beside everything seen"


def attempted(view: Observation, objects: dict[int, str], record: Any, outcome: Outcome) -> Attempted:
    return Attempted(record, Observed(0, 0, 0, view, Plan.nothing("none"), objects), outcome)


def test_the_evidence_of_an_attempt_becomes_its_cause(seen: tuple[Observation, int, int], make_round: Any) -> None:
    view, front, _ = seen
    approach, slip = make_round(0, 0, ["approach", "slip"]).attempts
    contact = HandContact("left finger", front, (0.15, FRONT - 0.01, 0.10), 0.0001)
    on_object = Outcome("approach", (), contact_at_start=False, contact_on_way=True, first_contact=contact)
    found = examine(attempted(view, {front: "set/box"}, approach, on_object), 7)
    assert found.cause == ("approach", "finger, an object on a seen surface", "never closed")
    assert found.first_contact is not None
    assert (found.line, found.first_contact.touched, found.first_contact.part) == (7, "set/box", "left finger")
    assert examine(attempted(view, {}, approach, on_object), 0).cause[1] == "finger, the table"
    for grip, closing in (
        (Grip(frozenset(), frozenset(), empty=True), "nothing between the fingers"),
        (Grip(frozenset({front}), frozenset(), empty=False), "touched on one side"),
        (Grip(frozenset({front, 7}), frozenset(), empty=False), "several things, none touched by both fingers"),
        (Grip(frozenset({front, 7}), frozenset({front}), empty=False), "touched by both fingers"),
        (Grip(frozenset({front}), frozenset({front}), empty=False), "touched by both fingers"),
    ):
        outcome = Outcome("slip", (), contact_at_start=False, contact_on_way=False, closed=grip)
        assert examine(attempted(view, {}, slip, outcome), 0).cause == ("slip", "none", closing)


class Misses:
    """First closes beside everything, then drives the hand into the table."""

    def __init__(self) -> None:
        self._heights = iter((0.45, TABLE_HEIGHT))

    def plan(self, observation: Observation, seed: int) -> Plan:
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = [0.02, 0.02, next(self._heights)]
        return Plan(pose[None], np.array([0.5]), np.array([0.08]), None, {"counts": {}})


def test_recorded_failures_are_played_again_and_sorted(
    make_settings: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = make_settings(rounds=1, executor="strict")
    objects = load_object_set("procedural", "packed")
    played = play_round(settings, objects, Misses(), 0, 0)
    folder = RunFolder(tmp_path)
    folder.prepare(settings, resume=False)
    folder.start(settings, ModelRecord("tesnet", "1", "0" * 64), Serving(None, 1, "cpu"))
    folder.append(played)
    assert main(["failures", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "failures.json").read_text())
    assert (content["attempts"], content["failed"], content["sorted"]) == (2, 2, 2)
    causes = {cause["outcome"]: (cause["first_contact"], cause["closing"]) for cause in content["causes"]}
    assert causes == {
        "slip": ("none", "nothing between the fingers"),
        "approach": ("finger, the table", "never closed"),
    }
    assert failures_table(content) in capsys.readouterr().out
    (first,) = failures(settings, objects, folder.read_rounds(), 1)
    assert (first.line, first.outcome, first.approach_deg) == (0, "slip", 0.0)
    assert failures_report([first, first], 4, 3)["causes"][0]["count"] == 2


def test_the_earliest_failures_are_told_with_their_lines_whatever_succeeded_between(
    played: RoundRecord, objects: tuple[ObjectModel, ...], make_settings: Any
) -> None:
    settings = make_settings(executor="edge")
    missed = [play_round(settings, objects, Misses(), 0, number) for number in (2, 3)]
    rounds = [played, *missed]
    attempts = [attempt for record in rounds for attempt in record.attempts]
    lines = [line for line, attempt in enumerate(attempts) if not attempt.success]
    assert 4 <= len(lines) < len(attempts)
    few, all_of_them = (list(failures(settings, objects, rounds, limit)) for limit in (3, 99))
    assert [failure.line for failure in few] == lines[:3]
    assert [failure.line for failure in all_of_them] == lines
    for failure in all_of_them:
        recorded = attempts[failure.line]
        told = (failure.seed, failure.round, failure.attempt, failure.outcome, failure.score)
        assert told == (recorded.seed, recorded.round, recorded.attempt, recorded.outcome, recorded.score)
        assert failure.height == pytest.approx(recorded.T_world_grasp[2, 3] - TABLE_HEIGHT)


def test_what_hides_a_position_is_the_body_in_front_of_its_pixel() -> None:
    """Looked up pixel by pixel; 4 mm behind what is seen there, a position may still be in sight."""
    rng = np.random.default_rng(0)
    shape = (INTRINSICS.height, INTRINSICS.width)
    depth = rng.choice([0.0, 0.5, 0.9], shape).astype(np.float32)
    bodies = rng.integers(0, 1000, shape)
    images = Images(depth, np.zeros((*shape, 3), np.uint8), bodies)
    pose = Pose.random(rng, reach=0.3)
    hidden = 0
    for _ in range(400):
        row, column = int(rng.integers(-20, shape[0] + 20)), int(rng.integers(-20, shape[1] + 20))
        z = float(rng.choice([-0.6, 0.4, 0.496, 0.503, 0.505, 0.7, 0.903, 0.905, 1.2]))
        off = rng.uniform(-0.4, 0.4, 2)
        ray = [(column + off[0] - INTRINSICS.cx) / INTRINSICS.fx, (row + off[1] - INTRINSICS.cy) / INTRINSICS.fy, 1.0]
        found = _hiding_body(pose.apply(z * np.array(ray)), images, pose)
        inside = z > 0 and 0 <= row < shape[0] and 0 <= column < shape[1]
        expected = int(bodies[row, column]) if inside and 0 < depth[row, column] < z - 0.004 else None
        assert found == expected
        hidden += expected is not None
    assert 50 < hidden < 300


@pytest.mark.parametrize(("offset", "place"), [(0.0039, "on a seen surface"), (0.0041, "beside everything seen")])
def test_a_surface_is_seen_within_4_mm_of_an_observed_point(offset: float, place: str) -> None:
    empty = np.zeros((INTRINSICS.height, INTRINSICS.width))
    images = Images(empty, np.zeros((*empty.shape, 3)), empty)
    view = Observation(np.array([[0.1, 0.1, 0.1]]), np.zeros((1, 3)), np.eye(4)[None], (images,))
    assert place_of(np.array([0.1, 0.1, 0.1 + offset]), 7, view) == place


@pytest.mark.parametrize("axis", range(3))
def test_where_a_planner_was_shown_nothing_is_told_by_the_side_of_the_box(axis: int) -> None:
    empty = np.zeros((INTRINSICS.height, INTRINSICS.width))
    images = Images(empty, np.zeros((*empty.shape, 3)), empty)
    view = Observation(np.zeros((0, 3)), np.zeros((1, 3)), np.eye(4)[None], (images,))
    for edge, outward in ((PERCEPTION_BOX.minimum, -1), (PERCEPTION_BOX.maximum, 1)):
        position = np.array([0.15, 0.15, 0.15])
        position[axis] = edge[axis] + 1e-4 * outward
        low = axis == 2 and outward < 0
        assert place_of(position, 7, view) == ("lower than the crop" if low else "outside the perception box")
        position[axis] = edge[axis] - 1e-4 * outward
        assert place_of(position, 7, view) == "beside everything seen"
