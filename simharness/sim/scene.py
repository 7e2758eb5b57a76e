"""Packed and pile scenes: objects on a table inside the workspace, settled.

Knows how scenes are made and put back, not how they are seen or grasped. The protocol is that of Breyer et al.,
"Volumetric Grasping Network" (CoRL 2020), as Huang et al., "Edge Grasp Network" (ICRA 2023) run it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simharness.sim.objects import ObjectModel, SceneKind
from simharness.sim.world import TIMESTEP, World
from tesnet.geometry import PANDA, Box, Gripper, Pose

TABLE_HEIGHT = 0.05
WORKSPACE = Box(np.array([0.0, 0.0, 0.0]), np.array([0.3, 0.3, 0.3]))
PERCEPTION_BOX = Box(np.array([0.02, 0.02, 0.055]), np.array([0.28, 0.28, 0.30]))
"""What a planner is shown; metres in the world, like every length here."""

OBJECT_MASS = 0.5
OBJECT_FRICTION = 1.0

RESTING_SPEED = 0.01
SETTLING_LIMIT = 2.0
_STEPS_BETWEEN_CHECKS = 60

SCALE_RANGES: Mapping[SceneKind, tuple[float, float]] = {"packed": (0.7, 0.8), "pile": (0.8, 1.0)}

LARGEST_FACTOR = 1.25
"""Objects are scaled by a hand's opening in terms of the Panda's, up to this."""

_PACKED_TRIES = 12
_PACKED_RANGE = (0.08, 0.22)
_PACKED_CLEARANCE = 0.002
_PILE_RANGE = (0.1, 0.2)
_PILE_DROP = 0.2
_PILE_SETTLING_LIMIT = 1.0
_WALL_RANGE = (0.02, 0.28)
_WALL_HEIGHT = 0.13
_WALL_THICKNESS = 0.01

_TABLE_HALF_EXTENT = 0.6
_TABLE_COLOUR = (0.62, 0.60, 0.57, 1.0)


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """One object of a scene, settled.

    Args:
        body_id: its id in the world.
        name: the object model's.
        scale: scale it was loaded with, the model's `scale_hint` included.
        pose: T_world_body.
    """

    body_id: int
    name: str
    scale: float
    pose: Pose


@dataclass(frozen=True, slots=True)
class Scene:
    """A settled scene as it was made; which objects still stand later is the world's to say.

    Args:
        kind: `packed` or `pile`.
        placed: the objects, in the order they were placed.
        lost: names of those that left the workspace while the scene was made.
    """

    kind: SceneKind
    placed: tuple[PlacedObject, ...]
    lost: tuple[str, ...] = ()


def scales_for(kind: SceneKind, hand: Gripper) -> tuple[float, float]:
    """Limits of the uniform scale for a hand: the protocol's, which are the Panda's, times how much wider it opens."""
    factor = min(hand.max_width / PANDA.max_width, LARGEST_FACTOR)
    low, high = SCALE_RANGES[kind]
    return factor * low, factor * high


def make_scene(
    world: World,
    kind: SceneKind,
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    num_objects: int = 5,
    scale_range: tuple[float, float] | None = None,
) -> Scene:
    """Put a table and randomly chosen objects into an empty world and let them settle.

    Packed: at most 12 tries to stand an object upright, one that touches another is taken out again. Pile: objects in
    any orientation are dropped one by one into an open box, which is then removed. Fewer objects than asked for may
    stand in the end, even none.

    Args:
        world: an empty world.
        kind: `packed` or `pile`.
        objects: what to draw from, with replacement.
        rng: source of every random choice.
        num_objects: how many to place.
        scale_range: limits of the uniform scale; the protocol's for this kind unless given.
    """
    low, high = SCALE_RANGES[kind] if scale_range is None else scale_range
    table = _add_table(world)
    place = _stand_objects if kind == "packed" else _drop_objects
    loaded = place(world, table, objects, rng, num_objects, (low, high))
    settle(world)
    placed = tuple(
        PlacedObject(body, model.name, scale, world.pose(body))
        for body, model, scale in loaded
        if body in world.objects
    )
    return Scene(kind, placed, tuple(model.name for body, model, _ in loaded if body not in world.objects))


def settle(world: World, limit: float = SETTLING_LIMIT) -> tuple[int, ...]:
    """Wait until every object is slower than 0.01 m/s or `limit` seconds have passed; take out what left the workspace.

    Repeats while objects are taken out, since others may have leaned on them.

    Returns:
        Ids of the objects that are lost, sorted.
    """
    lost: list[int] = []
    while True:
        _wait(world, limit)
        outside = [body for body in world.objects if not _in_workspace(world.position(body))]
        if not outside:
            return tuple(sorted(lost))
        for body in outside:
            world.remove(body)
        lost += outside


def describe(scene: Scene) -> dict[str, Any]:
    """Everything `restore_scene` needs, as plain JSON values."""
    return {
        "kind": scene.kind,
        "objects": [
            {
                "name": item.name,
                "scale": item.scale,
                "position": item.pose.translation.tolist(),
                "quaternion_xyzw": item.pose.quaternion_xyzw.tolist(),
            }
            for item in scene.placed
        ],
    }


def restore_scene(world: World, description: Mapping[str, Any], objects_by_name: Mapping[str, ObjectModel]) -> Scene:
    """Put a described scene into an empty world, at rest where it stood.

    Raises:
        KeyError: an object that `objects_by_name` does not hold.
    """
    _add_table(world)
    placed = []
    for item in description["objects"]:
        pose = Pose.from_quaternion(item["quaternion_xyzw"], item["position"])
        body = _load(world, objects_by_name[item["name"]], pose, item["scale"])
        world.set_pose(body, item["position"], item["quaternion_xyzw"])
        placed.append(PlacedObject(body, item["name"], item["scale"], pose))
    return Scene(description["kind"], tuple(placed))


_Loaded = list[tuple[int, ObjectModel, float]]


def _stand_objects(
    world: World,
    table: int,
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    num_objects: int,
    scale_range: tuple[float, float],
) -> _Loaded:
    loaded: _Loaded = []
    for _ in range(_PACKED_TRIES):
        if len(loaded) == num_objects:
            break
        model = objects[int(rng.integers(len(objects)))]
        yaw = rng.uniform(0.0, 2 * np.pi)
        x, y = rng.uniform(*_PACKED_RANGE, size=2)
        scale = float(rng.uniform(*scale_range)) * model.scale_hint
        upright = Pose.from_quaternion([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)], [x, y, TABLE_HEIGHT + 0.5])
        body = _load(world, model, upright, scale)
        _lower_onto(world, body, table)
        world.find_contacts()
        if world.contacts(body):
            world.remove(body)
            continue
        loaded.append((body, model, scale))
        _wait(world, SETTLING_LIMIT)
    return loaded


def _drop_objects(
    world: World,
    table: int,  # noqa: ARG001 - both ways of placing objects are called alike
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    num_objects: int,
    scale_range: tuple[float, float],
) -> _Loaded:
    walls = _add_walls(world)
    loaded: _Loaded = []
    for _ in range(num_objects):
        model = objects[int(rng.integers(len(objects)))]
        turned = Pose.random(rng)
        x, y = rng.uniform(*_PILE_RANGE, size=2)
        scale = float(rng.uniform(*scale_range)) * model.scale_hint
        above = np.array([x, y, TABLE_HEIGHT + _PILE_DROP])
        body = _load(world, model, Pose(turned.rotation, above), scale)
        loaded.append((body, model, scale))
        _wait(world, _PILE_SETTLING_LIMIT)
    for wall in walls:
        world.remove(wall)
    return loaded


def _load(world: World, model: ObjectModel, pose: Pose, scale: float) -> int:
    return world.load_object(model.urdf, pose, scale=scale, mass=OBJECT_MASS, friction=OBJECT_FRICTION)


def _lower_onto(world: World, body: int, table: int) -> None:
    """Lower a body until it hangs 2 mm over the table."""
    gap = world.distance(body, table, limit=1.0)
    assert gap is not None, "the body was loaded within a metre above the table"
    pose = world.pose(body)
    drop = np.array([0.0, 0.0, gap - _PACKED_CLEARANCE])
    world.set_pose(body, (pose.translation - drop).tolist(), pose.quaternion_xyzw.tolist())


def _wait(world: World, limit: float) -> None:
    for _ in range(max(1, round(limit / (_STEPS_BETWEEN_CHECKS * TIMESTEP)))):
        world.step(_STEPS_BETWEEN_CHECKS)
        if all(world.speed(body) < RESTING_SPEED for body in world.objects):
            return


def _in_workspace(position: tuple[float, float, float]) -> bool:
    return bool((WORKSPACE.minimum <= position).all() and (position <= WORKSPACE.maximum).all())


def _add_table(world: World) -> int:
    half = (_TABLE_HALF_EXTENT, _TABLE_HALF_EXTENT, TABLE_HEIGHT / 2)
    return world.add_static_box(half, (0.15, 0.15, TABLE_HEIGHT / 2), colour=_TABLE_COLOUR)


def _add_walls(world: World) -> list[int]:
    low, high = _WALL_RANGE
    middle, half_length = (low + high) / 2, (high - low) / 2 + _WALL_THICKNESS
    half, z, half_height = _WALL_THICKNESS / 2, TABLE_HEIGHT + _WALL_HEIGHT / 2, _WALL_HEIGHT / 2
    walls = []
    for edge in (low - half, high + half):
        for extents, position in (
            ((half, half_length, half_height), (edge, middle, z)),
            ((half_length, half, half_height), (middle, edge, z)),
        ):
            walls.append(world.add_static_box(extents, position, colour=_TABLE_COLOUR))
    return walls
