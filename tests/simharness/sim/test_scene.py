"""Scenes: what stands on the table, and that it can be put back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from simharness.sim.objects import ObjectModel
from simharness.sim.scene import (
    RESTING_SPEED,
    TABLE_HEIGHT,
    WORKSPACE,
    Scene,
    describe,
    make_scene,
    restore_scene,
    settle,
)
from simharness.sim.world import World, data_path

pytestmark = pytest.mark.sim

CUBE = ObjectModel("cube", data_path() / "cube_small.urdf")
"""5 cm at scale 1."""


def poses(world: World, scene: Scene) -> list[bytes]:
    return [world.pose(item.body_id).matrix.tobytes() for item in scene.placed]


def test_packed_objects_stand_upright_on_the_table_within_the_protocols_limits() -> None:
    with World() as world:
        scene = make_scene(world, "packed", [CUBE], np.random.default_rng(3))
        assert 2 <= len(scene.placed) <= 5
        for item in scene.placed:
            assert 0.7 <= item.scale <= 0.8
            assert item.pose.rotation[2, 2] > 0.999
            assert item.pose.translation[2] == pytest.approx(TABLE_HEIGHT + 0.025 * item.scale, abs=0.001)
            assert (item.pose.translation[:2] > 0.075).all()
            assert (item.pose.translation[:2] < 0.225).all()


def test_a_pile_is_at_rest_inside_the_workspace_and_its_box_is_gone() -> None:
    with World() as world:
        scene = make_scene(world, "pile", [CUBE], np.random.default_rng(0), num_objects=3)
        assert len(scene.placed) + len(scene.lost) == 3
        for item in scene.placed:
            assert world.speed(item.body_id) < RESTING_SPEED
            assert (WORKSPACE.minimum <= item.pose.translation).all()
            assert (item.pose.translation <= WORKSPACE.maximum).all()
        # A cube that slides where the walls were meets nothing.
        world.set_pose(scene.placed[0].body_id, (0.28, 0.15, 0.12), (0.0, 0.0, 0.0, 1.0))
        world.find_contacts()
        assert world.contacts(scene.placed[0].body_id) == []


@pytest.mark.parametrize("kind", ["packed", "pile"])
def test_the_same_seed_makes_the_same_scene_to_the_bit(kind: str) -> None:
    assert kind in ("packed", "pile")
    runs = []
    for _ in range(2):
        with World() as world:
            scene = make_scene(world, "packed" if kind == "packed" else "pile", [CUBE], np.random.default_rng(5))
            runs.append(poses(world, scene))
    assert runs[0] == runs[1]


def test_a_described_scene_is_put_back_and_stays() -> None:
    with World() as world:
        made = make_scene(world, "packed", [CUBE], np.random.default_rng(1))
        description = json.loads(json.dumps(describe(made)))
    with World() as world:
        restored = restore_scene(world, description, {"cube": CUBE})
        assert settle(world) == ()
        assert restored.kind == "packed"
        for before, after in zip(made.placed, restored.placed, strict=True):
            assert (before.name, before.scale) == (after.name, after.scale)
            np.testing.assert_allclose(world.position(after.body_id), before.pose.translation, atol=5e-4)


def test_an_object_that_leaves_the_workspace_is_taken_out_and_reported() -> None:
    with World() as world:
        scene = make_scene(world, "packed", [CUBE], np.random.default_rng(1))
        runaway = scene.placed[0].body_id
        world.set_pose(runaway, (0.4, 0.15, TABLE_HEIGHT + 0.02), (0.0, 0.0, 0.0, 1.0))
        assert settle(world) == (runaway,)
        assert runaway not in world.objects
        assert len(world.objects) == len(scene.placed) - 1
