"""Scenes: what stands on the table, and that it can be put back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.sim import scene as scene_module
from simharness.sim.objects import ObjectModel, SceneKind
from simharness.sim.scene import (
    OBJECT_FRICTION,
    OBJECT_MASS,
    RESTING_SPEED,
    SCALE_RANGES,
    TABLE_HEIGHT,
    WORKSPACE,
    Scene,
    Variety,
    describe,
    make_scene,
    restore_scene,
    scales_for,
    settle,
)
from simharness.sim.world import TIMESTEP, World, data_path
from tesnet.hands import HANDS

pytestmark = pytest.mark.sim

CUBE = ObjectModel("cube", data_path() / "cube_small.urdf")
"""5 cm at scale 1."""

LOPSIDED = """<robot name="lopsided"><link name="base">
<inertial><origin xyz="0.01 0.005 -0.01" rpy="0 0 0"/><mass value="0.1"/>
<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>
<collision><geometry><box size="0.06 0.04 0.05"/></geometry></collision>
<visual><geometry><box size="0.06 0.04 0.05"/></geometry></visual>
</link></robot>"""
"""A box whose centre of mass lies 15 mm beside its origin."""


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


@pytest.mark.parametrize("kind", ["packed", "pile"])
def test_a_models_own_scale_is_part_of_the_drawn_one(kind: SceneKind) -> None:
    half_size = ObjectModel("cube", CUBE.urdf, scale_hint=0.5)
    with World() as world:
        whole = make_scene(world, kind, [CUBE], np.random.default_rng(2))
    with World() as world:
        half = make_scene(world, kind, [half_size], np.random.default_rng(2))
        low, high = SCALE_RANGES[kind]
        for item in half.placed:
            assert 0.5 * low <= item.scale <= 0.5 * high
            assert world.position(item.body_id)[2] < TABLE_HEIGHT + 0.03  # so small it is, too
    assert half.placed[0].scale == pytest.approx(0.5 * whole.placed[0].scale)


def test_a_body_whose_mass_is_beside_its_origin_is_put_back_where_it_was(tmp_path: Path) -> None:
    lopsided = ObjectModel("lopsided", tmp_path / "lopsided.urdf")
    lopsided.urdf.write_text(LOPSIDED)
    with World() as world:
        made = make_scene(world, "packed", [lopsided], np.random.default_rng(4), num_objects=3)
        before = {item.body_id: world.pose(item.body_id).matrix for item in made.placed}
        assert len(before) >= 2
        description = json.loads(json.dumps(describe(made)))
    with World() as world:
        restored = restore_scene(world, description, {"lopsided": lopsided})
        for old, new in zip(made.placed, restored.placed, strict=True):
            np.testing.assert_allclose(world.pose(new.body_id).matrix, before[old.body_id], atol=1e-6)
            np.testing.assert_allclose(new.pose.matrix, before[old.body_id], atol=1e-6)


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("height", [0.05, 0.4])
def test_settling_waits_for_the_last_object_that_moves(which: int, height: float) -> None:
    """Also for one that still falls when it is looked for the first time, a quarter of a second later."""
    with World() as world:
        scene = make_scene(world, "packed", [CUBE], np.random.default_rng(1), num_objects=2)
        falling = scene.placed[which]
        x, y, z = world.position(falling.body_id)
        world.set_pose(falling.body_id, (x, y, z + height), (0.0, 0.0, 0.0, 1.0))
        assert settle(world) == ()
        for item in scene.placed:
            assert world.speed(item.body_id) < RESTING_SPEED
            assert world.position(item.body_id)[2] == pytest.approx(TABLE_HEIGHT + 0.025 * item.scale, abs=0.001)


def test_what_leaned_on_a_lost_object_comes_to_rest_again() -> None:
    with World() as world:
        scene = make_scene(world, "packed", [CUBE], np.random.default_rng(1), num_objects=2)
        below, above = (item.body_id for item in scene.placed)
        half = [0.025 * item.scale for item in scene.placed]
        # The lower one has its middle just outside the workspace, the one on top of it just inside.
        edge = float(WORKSPACE.maximum[0])
        upright = (0.0, 0.0, 0.0, 1.0)
        world.set_pose(below, (edge + 0.003, 0.15, TABLE_HEIGHT + half[0]), upright)
        world.set_pose(above, (edge - 0.006, 0.15, TABLE_HEIGHT + 2 * half[0] + half[1] + 0.001), upright)
        assert settle(world) == (below,)
        assert world.position(above)[2] == pytest.approx(TABLE_HEIGHT + half[1], abs=0.001)
        assert world.speed(above) < RESTING_SPEED


def test_packed_objects_do_not_touch() -> None:
    for seed in range(3):
        with World() as world:
            scene = make_scene(world, "packed", [CUBE], np.random.default_rng(seed), scale_range=(1.3, 1.5))
            bodies = [item.body_id for item in scene.placed]
            assert len(bodies) >= 2
            for number, body in enumerate(bodies):
                for other in bodies[:number]:
                    assert (world.distance(body, other, limit=0.5) or 0.0) > 0


def test_what_never_rests_is_waited_for_as_long_as_the_limit_says(monkeypatch: pytest.MonkeyPatch) -> None:
    with World() as world:
        make_scene(world, "packed", [CUBE], np.random.default_rng(1), num_objects=1)
        steps: list[int] = []
        monkeypatch.setattr(World, "step", lambda _world, count=1: steps.append(count))
        monkeypatch.setattr(World, "speed", lambda _world, _body: 2 * RESTING_SPEED)
        settle(world, limit=1.0)
        assert sum(steps) * TIMESTEP == pytest.approx(1.0)
        steps.clear()
        monkeypatch.setattr(World, "speed", lambda _world, _body: 0.5 * RESTING_SPEED)
        settle(world, limit=1.0)
        assert sum(steps) * TIMESTEP < 0.5


@pytest.mark.parametrize(
    ("name", "factor"), [("franka", 1.0), ("hand_e", 0.625), ("robotiq_2f85", 1.0625), ("robotiq_2f140", 1.25)]
)
@pytest.mark.parametrize("kind", SCALE_RANGES)
def test_objects_are_scaled_by_a_hands_opening(kind: SceneKind, name: str, factor: float) -> None:
    found, protocol = scales_for(kind, HANDS[name].gripper), SCALE_RANGES[kind]
    assert found == pytest.approx(tuple(factor * limit for limit in protocol))
    if name == "franka":
        assert found == protocol


def test_mass_and_friction_vary_within_their_limits_and_are_put_back_with_the_scene() -> None:
    variety = Variety(mass=(0.05, 1.0), friction=(0.3, 1.0))
    with World() as world:
        scene = make_scene(world, "packed", [CUBE], np.random.default_rng(3), variety=variety)
        masses, frictions = ([getattr(item, name) for item in scene.placed] for name in ("mass", "friction"))
        assert len({*masses, *frictions}) == 2 * len(scene.placed)
        assert all(0.05 <= mass <= 1.0 for mass in masses)
        assert all(0.3 <= friction <= 1.0 for friction in frictions)
        description = json.loads(json.dumps(describe(scene)))
    with World() as world:
        restored = restore_scene(world, description, {"cube": CUBE})
        assert [(item.mass, item.friction) for item in restored.placed] == list(zip(masses, frictions, strict=True))
    rng = np.random.default_rng(0)
    drawn = [variety.draw_mass(rng) for _ in range(2000)]
    assert np.median(drawn) == pytest.approx(np.sqrt(0.05), rel=0.2)


def test_without_variety_nothing_more_is_drawn_or_said() -> None:
    rng, untouched = np.random.default_rng(0), np.random.default_rng(0)
    assert (Variety().draw_mass(rng), Variety().draw_friction(rng)) == (OBJECT_MASS, OBJECT_FRICTION)
    assert rng.uniform() == untouched.uniform()
    with World() as world:
        description = describe(make_scene(world, "packed", [CUBE], np.random.default_rng(1)))
    assert all("mass" not in item and "friction" not in item for item in description["objects"])


@pytest.mark.parametrize("kind", SCALE_RANGES)
def test_a_thing_of_its_own_size_keeps_it_around_the_middle_of_the_scales(kind: SceneKind) -> None:
    sized = replace(CUBE, sized=True)
    low, high = SCALE_RANGES[kind]
    with World() as world:
        for item in make_scene(world, kind, [sized], np.random.default_rng(2)).placed:
            assert 2 * low / (low + high) <= item.scale <= 2 * high / (low + high)


@pytest.mark.parametrize("kind", SCALE_RANGES)
def test_a_thing_of_its_own_size_follows_the_scales_that_are_asked_for(kind: SceneKind) -> None:
    sized, middle = replace(CUBE, sized=True), sum(SCALE_RANGES[kind]) / 2
    with World() as world:
        items = make_scene(world, kind, [sized], np.random.default_rng(2), 2, scale_range=(0.5, 0.55)).placed
    assert items
    for item in items:
        assert 0.5 <= item.scale * middle <= 0.55


def test_crowded_tables_hold_more_than_five() -> None:
    small = replace(CUBE, scale_hint=0.4)
    with World() as world:
        assert len(make_scene(world, "packed", [small], np.random.default_rng(0), num_objects=12).placed) > 8


@pytest.mark.parametrize(("wanted", "tries"), [(1, 12), (5, 12), (6, 12), (7, 14), (9, 18)])
def test_objects_that_find_no_place_are_tried_twelve_times_or_twice_an_object(
    wanted: int, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def loaded(world: World, thing: Any, pose: Any) -> int:
        tried.append(load(world, thing, pose))
        return tried[-1]

    load = scene_module._load
    monkeypatch.setattr(scene_module, "_load", loaded)
    monkeypatch.setattr(World, "contacts", lambda *_, **__: ["something"])
    with World() as world:
        assert make_scene(world, "packed", [CUBE], np.random.default_rng(0), num_objects=wanted).placed == ()
        assert world.objects == ()
    assert len(tried) == tries


def test_a_scene_that_is_put_back_weighs_and_grips_as_the_one_that_was_made(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[float, float, float]] = []
    load = World.load_object

    def noted(world: World, path: Any, pose: Any, *, scale: float, mass: float, friction: float) -> int:
        told.append((scale, mass, friction))
        return load(world, path, pose, scale=scale, mass=mass, friction=friction)

    monkeypatch.setattr(World, "load_object", noted)
    with World() as world:
        made = make_scene(
            world, "packed", [CUBE], np.random.default_rng(3), variety=Variety(mass=(0.05, 0.2), friction=(0.5, 1.0))
        )
        first = set(told)
        description = json.loads(json.dumps(describe(made)))
    told.clear()
    with World() as world:
        restore_scene(world, description, {"cube": CUBE})
    assert len(told) == len(made.placed) > 1
    assert [(mass, friction) for _, mass, friction in told] == [(item.mass, item.friction) for item in made.placed]
    assert set(told) <= first
