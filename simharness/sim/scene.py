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
_TRIES_PER_OBJECT = 2  # of crowded tables, which the protocol has not
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
        mass: kilograms.
        friction: coefficient of its surface; what touches it multiplies its own.
    """

    body_id: int
    name: str
    scale: float
    pose: Pose
    mass: float = OBJECT_MASS
    friction: float = OBJECT_FRICTION


@dataclass(frozen=True, slots=True)
class Variety:
    """What differs between the objects of a scene; without arguments nothing but what the protocol varies.

    Args:
        mass: limits in kilograms, uniform in their logarithm; None is the protocol's one.
        friction: limits of the uniform coefficient; None is the protocol's one.
    """

    mass: tuple[float, float] | None = None
    friction: tuple[float, float] | None = None

    def draw_mass(self, rng: np.random.Generator) -> float:
        """Kilograms of one object; nothing is drawn without limits."""
        return OBJECT_MASS if self.mass is None else float(np.exp(rng.uniform(*np.log(self.mass))))

    def draw_friction(self, rng: np.random.Generator) -> float:
        """Of one object; nothing is drawn without limits."""
        return OBJECT_FRICTION if self.friction is None else float(rng.uniform(*self.friction))


AS_PROTOCOL = Variety()


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


def scales_for(kind: SceneKind, hand: Gripper, for_panda: tuple[float, float] | None = None) -> tuple[float, float]:
    """Limits of the uniform scale for a hand: the Panda's, by default the protocol's, times how much wider it opens."""
    factor = min(hand.max_width / PANDA.max_width, LARGEST_FACTOR)
    low, high = SCALE_RANGES[kind] if for_panda is None else for_panda
    return factor * low, factor * high


def make_scene(
    world: World,
    kind: SceneKind,
    objects: Sequence[ObjectModel],
    rng: np.random.Generator,
    num_objects: int = 5,
    scale_range: tuple[float, float] | None = None,
    variety: Variety = AS_PROTOCOL,
) -> Scene:
    """Put a table and randomly chosen objects into an empty world and let them settle.

    Packed: at most 12 tries (on crowded tables two an object) to stand an object upright, one that touches another is
    taken out again. Pile: objects in any orientation are dropped one by one into an open box, which is then removed.
    Fewer objects than asked for may stand in the end, even none.

    Args:
        world: an empty world.
        kind: `packed` or `pile`.
        objects: what to draw from, with replacement.
        rng: source of every random choice.
        num_objects: how many to place.
        scale_range: limits of the uniform scale; the protocol's for this kind unless given.
        variety: what else differs between objects.
    """
    table = _add_table(world)
    draw = _Draw(rng, SCALE_RANGES[kind] if scale_range is None else scale_range, sum(SCALE_RANGES[kind]) / 2, variety)
    place = _stand_objects if kind == "packed" else _drop_objects
    loaded = place(world, table, objects, draw, num_objects)
    settle(world)
    placed = tuple(
        PlacedObject(body, thing.model.name, thing.scale, world.pose(body), thing.mass, thing.friction)
        for body, thing in loaded
        if body in world.objects
    )
    return Scene(kind, placed, tuple(thing.model.name for body, thing in loaded if body not in world.objects))


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
                **_unlike_protocol(item),
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
        mass, friction = item.get("mass", OBJECT_MASS), item.get("friction", OBJECT_FRICTION)
        body = _load(world, _Thing(objects_by_name[item["name"]], item["scale"], mass, friction), pose)
        world.set_pose(body, item["position"], item["quaternion_xyzw"])
        placed.append(PlacedObject(body, item["name"], item["scale"], pose, mass, friction))
    return Scene(description["kind"], tuple(placed))


def _unlike_protocol(item: PlacedObject) -> dict[str, float]:
    """What a description says of mass and friction: nothing where they are the protocol's."""
    if (item.mass, item.friction) == (OBJECT_MASS, OBJECT_FRICTION):
        return {}
    return {"mass": item.mass, "friction": item.friction}


@dataclass(frozen=True, slots=True)
class _Thing:
    """An object as a scene holds it; `scale` includes the model's hint."""

    model: ObjectModel
    scale: float
    mass: float
    friction: float


@dataclass(frozen=True, slots=True)
class _Draw:
    """The random choices of a scene; at scale `middle`, sized things have their size."""

    rng: np.random.Generator
    scale_range: tuple[float, float]
    middle: float
    variety: Variety

    def thing(self, model: ObjectModel) -> _Thing:
        scale = float(self.rng.uniform(*self.scale_range)) * model.scale_hint / (self.middle if model.sized else 1.0)
        return _Thing(model, scale, self.variety.draw_mass(self.rng), self.variety.draw_friction(self.rng))


_Loaded = list[tuple[int, _Thing]]


def _stand_objects(
    world: World,
    table: int,
    objects: Sequence[ObjectModel],
    draw: _Draw,
    num_objects: int,
) -> _Loaded:
    rng = draw.rng
    loaded: _Loaded = []
    for _ in range(max(_PACKED_TRIES, _TRIES_PER_OBJECT * num_objects)):
        if len(loaded) == num_objects:
            break
        model = objects[int(rng.integers(len(objects)))]
        yaw = rng.uniform(0.0, 2 * np.pi)
        x, y = rng.uniform(*_PACKED_RANGE, size=2)
        thing = draw.thing(model)
        upright = Pose.from_quaternion([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)], [x, y, TABLE_HEIGHT + 0.5])
        body = _load(world, thing, upright)
        _lower_onto(world, body, table)
        world.find_contacts()
        if world.contacts(body):
            world.remove(body)
            continue
        loaded.append((body, thing))
        _wait(world, SETTLING_LIMIT)
    return loaded


def _drop_objects(
    world: World,
    table: int,  # noqa: ARG001 - both ways of placing objects are called alike
    objects: Sequence[ObjectModel],
    draw: _Draw,
    num_objects: int,
) -> _Loaded:
    rng = draw.rng
    walls = _add_walls(world)
    loaded: _Loaded = []
    for _ in range(num_objects):
        model = objects[int(rng.integers(len(objects)))]
        turned = Pose.random(rng)
        x, y = rng.uniform(*_PILE_RANGE, size=2)
        thing = draw.thing(model)
        above = np.array([x, y, TABLE_HEIGHT + _PILE_DROP])
        body = _load(world, thing, Pose(turned.rotation, above))
        loaded.append((body, thing))
        _wait(world, _PILE_SETTLING_LIMIT)
    for wall in walls:
        world.remove(wall)
    return loaded


def _load(world: World, thing: _Thing, pose: Pose) -> int:
    return world.load_object(thing.model.urdf, pose, scale=thing.scale, mass=thing.mass, friction=thing.friction)


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
