"""Depth frames of made-up rooms: tables with legs and floor, desks, shelves, bins, overhead views; ray cast.

Each frame has its intrinsics, the camera's pose and the truth about the surface that things stand on. Knows no network
and no service; everything random derives from the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.solids import Array, Block, Cylinder, Placed, Trough, cast, standing
from tesnet.geometry import CameraIntrinsics, Pose

DEPTH_SCALE = 0.001
"""Metres per count."""
FARTHEST = 4.0
"""Metres that the camera sees."""
VGA = (640, 480)
SIZES = (VGA, (848, 480), (1280, 720), (1920, 1080))
"""Pixels of usual depth cameras, VGA to full HD."""
NOISES = (0.0015, 0.003, 0.0)
"""Standard deviations of a depth at one metre: of a usual camera, of a poor one, none."""
FOCAL_SHARES = (0.95, 0.65)
"""Focal lengths over the image's width, of usual and of wide lenses."""


@dataclass(frozen=True, eq=False, slots=True)
class Truth:
    """The surface that things stand on, in the camera's frame.

    Args:
        up: (3,) unit, against gravity.
        height: of the surface along it, metres.
        outline: (K, 3) corners of its convex outline, metres.
    """

    up: Array
    height: float
    outline: Array


@dataclass(frozen=True, eq=False, slots=True)
class Room:
    """What stands where, in a frame whose z points up, and where it is seen from.

    Args:
        solids: everything.
        eye, gaze: (3,) where the camera is and what it looks at.
        height: of the surface that things stand on.
        outline: (K, 2) corners of that surface.
    """

    solids: tuple[Placed, ...]
    eye: Array
    gaze: Array
    height: float
    outline: Array


@dataclass(frozen=True, eq=False, slots=True)
class RoomFrame:
    """A depth image (height, width) in counts of `DEPTH_SCALE`, 0 where there is none, its camera and the truth."""

    counts: NDArray[np.uint16]
    intrinsics: CameraIntrinsics
    T_world_camera: Pose
    truth: Truth


def frames(count: int, seed: int, sizes: tuple[tuple[int, int], ...] = SIZES) -> Iterator[tuple[str, RoomFrame]]:
    """Named frames: kinds by turns and, with each turn, another size, lens and noise."""
    kinds = list(KINDS.items())
    for number in range(count):
        name, kind = kinds[number % len(kinds)]
        rng = np.random.default_rng([seed, number])
        turn = number // len(kinds)
        size, focal_share = sizes[turn % len(sizes)], FOCAL_SHARES[turn % len(FOCAL_SHARES)]
        noise = NOISES[(number + turn) % len(NOISES)]
        yield f"{number:03d}_{name}", photograph(kind(rng), size, noise, rng, focal_share)


def photograph(
    room: Room,
    size: tuple[int, int],
    noise: float,
    rng: np.random.Generator,
    focal_share: float = FOCAL_SHARES[0],
) -> RoomFrame:
    """A frame of a room.

    Args:
        room: what to see.
        size: width and height of the image, pixels.
        noise: standard deviation of a depth at one metre; it grows with the square of the distance.
        rng: of the noise, of the camera's roll and of lost pixels, one in fifty where there is noise.
        focal_share: focal length over the image's width.
    """
    width, height = size
    focal = focal_share * width
    intrinsics = CameraIntrinsics(width, height, fx=focal, fy=focal, cx=width / 2 - 0.5, cy=height / 2 - 0.5)
    T_world_camera = _rolled(_looking(room), np.deg2rad(rng.uniform(-5, 5)))
    rays_world = T_world_camera.rotate(intrinsics.back_project(np.ones((height, width))))
    depth = cast(room.solids, T_world_camera.translation, rays_world)
    depth = np.where(depth < FARTHEST, depth, 0.0)
    depth = np.maximum(depth + noise * depth**2 * rng.standard_normal(depth.shape), 0.0)
    if noise:
        depth[rng.random(depth.shape) < 0.02] = 0.0
    counts = np.rint(depth / DEPTH_SCALE).astype(np.uint16).reshape(height, width)
    return RoomFrame(counts, intrinsics, T_world_camera, _truth(room, T_world_camera))


def _looking(room: Room) -> Pose:
    forward = room.gaze - room.eye
    steep = np.linalg.norm(forward[:2]) < 0.1 * abs(forward[2])
    return Pose.look_at(room.eye, room.gaze, [0, 1, 0] if steep else [0, 0, 1])


def _rolled(pose: Pose, angle: float) -> Pose:
    """The pose, turned about its own z."""
    return pose @ standing(0, 0, 0, angle)


def _truth(room: Room, T_world_camera: Pose) -> Truth:
    T_camera_world = T_world_camera.inverse()
    up = T_camera_world.rotate(np.array([[0.0, 0.0, 1.0]]))[0]
    corners = np.column_stack([room.outline, np.full(len(room.outline), room.height)])
    outline = T_camera_world.apply(corners)
    return Truth(up, float(outline[0] @ up), outline)


# --------------------------------------------------------------------------------------------------------------- rooms


def table(rng: np.random.Generator) -> Room:
    """A table with legs, chairs beside it, the floor, a wall behind; from obliquely above."""
    length, depth, height = rng.uniform([0.7, 0.5, 0.65], [1.4, 0.8, 0.78])
    solids = [_floor(), *_desk(length, depth, height), _wall(depth / 2 + rng.uniform(0.3, 1.2))]
    solids += _chair(-length / 2 - rng.uniform(0.25, 0.5), rng.uniform(-0.3, 0.3), rng.uniform(0, 2 * np.pi))
    solids += _chair(length / 2 + rng.uniform(0.25, 0.5), rng.uniform(0.0, 0.5), rng.uniform(0, 2 * np.pi))
    middle = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.1, 0.1)])
    solids += _things(rng, middle, 0.18, height)
    eye = np.array([*middle, height]) + _sight(rng, 0.55, 1.0, 30, 55)
    return Room(tuple(solids), eye, np.array([*middle, height]), height, _corners(length, depth))


def desk(rng: np.random.Generator) -> Room:
    """A desk at a wall with a screen on it."""
    length, depth, height = rng.uniform([1.2, 0.6, 0.7], [1.6, 0.8, 0.76])
    solids = [_floor(), *_desk(length, depth, height), _wall(depth / 2 + 0.02)]
    solids.append((Block(np.array([0.3, 0.02, 0.2])), standing(0, depth / 2 - 0.1, height + 0.32)))
    solids.append((Block(np.array([0.1, 0.08, 0.06])), standing(0, depth / 2 - 0.1, height + 0.06)))
    middle = np.array([rng.uniform(-0.3, 0.3), -0.1])
    solids += _things(rng, middle, 0.15, height)
    eye = np.array([*middle, height]) + _sight(rng, 0.5, 0.8, 30, 50)
    return Room(tuple(solids), eye, np.array([*middle, height]), height, _corners(length, depth))


def shelf(rng: np.random.Generator) -> Room:
    """Boards one above the other between two sides; things stand on the middle one, a few on the lowest."""
    length, depth, gap = rng.uniform([0.6, 0.28, 0.4], [1.0, 0.4, 0.5])
    board = Block(np.array([length / 2, depth / 2, 0.009]))
    height = 0.2 + gap
    solids = [_floor(), _wall(depth / 2 + 0.01)]
    solids += [(board, standing(0, 0, 0.2 + number * gap - 0.009)) for number in range(3)]
    side = Block(np.array([0.009, depth / 2, 0.2 / 2 + gap]))
    solids += [(side, standing(sign * length / 2, 0, 0.1 + gap)) for sign in (-1, 1)]
    solids += _things(rng, np.array([rng.uniform(-0.1, 0.1), -0.02]), 0.11, height, tallest=0.16)
    solids += _things(rng, np.zeros(2), 0.1, 0.2, count=2)
    eye = np.array([rng.uniform(-0.2, 0.2), -rng.uniform(0.6, 0.8), height + rng.uniform(0.2, 0.3)])
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(length, depth))


def curved_bin(rng: np.random.Generator) -> Room:
    """A bin with a curved floor on a table, things lying in it and beside it."""
    length, depth, height = rng.uniform([0.8, 0.6, 0.65], [1.2, 0.8, 0.78])
    half_width, half_length, wall = 0.14, 0.19, rng.uniform(0.06, 0.1)
    solids = [_floor(), *_desk(length, depth, height)]
    solids.append((Trough(rng.uniform(0.2, 0.4), half_width, half_length), standing(-0.2, 0, height + 0.004)))
    for sign in (-1, 1):
        solids.append(
            (Block(np.array([0.004, half_length, wall / 2])), standing(-0.2 + sign * half_width, 0, height + wall / 2))
        )
        solids.append(
            (Block(np.array([half_width, 0.004, wall / 2])), standing(-0.2, sign * half_length, height + wall / 2))
        )
    solids += _things(rng, np.array([-0.2, 0.0]), 0.06, height + 0.015, count=4)
    solids += _things(rng, np.array([0.15, 0.0]), 0.12, height, count=4)
    eye = np.array([0, 0, height]) + _sight(rng, 0.6, 0.9, 45, 65)
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(length, depth))


def overhead(rng: np.random.Generator) -> Room:
    """A table straight from above, the floor beside it."""
    length, depth, height = rng.uniform([0.5, 0.4, 0.65], [0.8, 0.6, 0.78])
    solids = [_floor(), *_desk(length, depth, height), *_things(rng, np.zeros(2), 0.15, height, tallest=0.12)]
    eye = np.array([*rng.uniform(-0.04, 0.04, 2), height + rng.uniform(0.6, 0.9)])
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(length, depth))


def small_table(rng: np.random.Generator) -> Room:
    """A small table with one to three small things, much floor in view."""
    length, depth, height = rng.uniform([0.45, 0.4, 0.4], [0.65, 0.5, 0.75])
    count = int(rng.integers(1, 4))
    solids = [_floor(), *_desk(length, depth, height), *_things(rng, np.zeros(2), 0.1, height, count, tallest=0.1)]
    eye = np.array([0, 0, height]) + _sight(rng, 0.7, 1.0, 40, 55)
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(length, depth))


def cabinet(rng: np.random.Generator) -> Room:
    """A low cabinet with closed sides on the floor, things on it."""
    length, depth, height = rng.uniform([0.45, 0.4, 0.3], [0.6, 0.5, 0.6])
    body = (Block(np.array([length, depth, height]) / 2), standing(0, 0, height / 2))
    solids = [_floor(), body, *_things(rng, np.zeros(2), 0.1, height, 4, tallest=0.14)]
    eye = np.array([0, 0, height]) + _sight(rng, 0.7, 1.0, 40, 55)
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(length, depth))


def stairs(rng: np.random.Generator) -> Room:
    """Four steps, things on the second one."""
    tread, rise, width = rng.uniform([0.28, 0.15, 1.0], [0.34, 0.19, 1.4])
    step = Block(np.array([width, tread, rise]) / 2)
    solids = [_floor()]
    solids += [(step, standing(0, tread * row, rise * (up + 0.5))) for row in range(-1, 3) for up in range(row + 2)]
    height = 2 * rise
    solids += _things(rng, np.array([rng.uniform(-0.2, 0.2), -0.02]), 0.06, height, 3, tallest=0.14)
    eye = np.array([rng.uniform(-0.1, 0.1), -0.75, height + rng.uniform(0.65, 0.8)])
    return Room(tuple(solids), eye, np.array([0, 0, height]), height, _corners(width, tread))


def empty(rng: np.random.Generator) -> Room:
    """A large table, empty, from a metre away: nothing is to be grasped."""
    solids = (_floor(), (Block(np.array([2.0, 2.0, 0.02])), standing(0, 0, 0.7)))
    eye = np.array([0, 0, 0.72]) + _sight(rng, 0.8, 1.1, 40, 55)
    return Room(solids, eye, np.array([0, 0, 0.72]), 0.72, _corners(4.0, 4.0))


def worktop(rng: np.random.Generator) -> Room:
    """A worktop with a sink in it, at a wall, things beside the sink and a few in it."""
    length, depth, height = rng.uniform([1.2, 0.58, 0.85], [1.8, 0.65, 0.92])
    half_length, half_depth, deep = rng.uniform([0.17, 0.15, 0.14], [0.24, 0.2, 0.2])
    left = half_length + rng.uniform(0.08, 0.25) - length / 2  # the middle of the sink
    rim, beside = depth / 2 - half_depth, (left - half_length + length / 2, length / 2 - left - half_length)
    parts = [
        ((beside[0], depth, 0.04), (-length / 2 + beside[0] / 2, 0.0, -0.02)),
        ((beside[1], depth, 0.04), (length / 2 - beside[1] / 2, 0.0, -0.02)),
        *(((2 * half_length, rim, 0.04), (left, sign * (half_depth + rim / 2), -0.02)) for sign in (-1, 1)),
        ((2 * half_length, 2 * half_depth, 0.01), (left, 0.0, -deep)),
        *(((0.01, 2 * half_depth, deep), (left + sign * half_length, 0.0, -deep / 2)) for sign in (-1, 1)),
        *(((2 * half_length, 0.01, deep), (left, sign * half_depth, -deep / 2)) for sign in (-1, 1)),
        ((length, 0.02, height - 0.04), (0.0, -depth / 2 + 0.03, -height / 2 - 0.02)),
    ]
    solids = [_floor(), _wall(depth / 2 + 0.01)]
    solids += [(Block(np.array(size) / 2), standing(x, y, height + z)) for size, (x, y, z) in parts]
    middle = np.array([left + half_length + 0.2, -0.03])
    solids += _things(rng, middle, 0.13, height, 5, tallest=0.16)
    solids += _things(rng, np.array([left, 0.0]), 0.08, height + 0.005 - deep, 2, tallest=0.1)
    seen = np.array([left + half_length, 0.0, height])
    return Room(tuple(solids), seen + _sight(rng, 0.7, 1.0, 40, 60), seen, height, _corners(length, depth))


KINDS: Mapping[str, Callable[[np.random.Generator], Room]] = {
    "table": table,
    "desk": desk,
    "shelf": shelf,
    "bin": curved_bin,
    "overhead": overhead,
    "small": small_table,
    "cabinet": cabinet,
    "stairs": stairs,
    "empty": empty,
    "worktop": worktop,
}


# ------------------------------------------------------------------------------------------------- what is in the rooms


def _floor() -> Placed:
    return Block(np.array([6.0, 6.0, 0.05])), standing(0, 0, -0.05)


def _wall(y: float) -> Placed:
    return Block(np.array([6.0, 0.05, 1.5])), standing(0, y + 0.05, 1.5)


def _desk(length: float, depth: float, height: float) -> list[Placed]:
    """A top of 25 mm and four legs."""
    leg = Block(np.array([0.02, 0.02, height / 2 - 0.0125]))
    top = (Block(np.array([length / 2, depth / 2, 0.0125])), standing(0, 0, height - 0.0125))
    feet = [(x * (length / 2 - 0.05), y * (depth / 2 - 0.05)) for x in (-1, 1) for y in (-1, 1)]
    return [top, *((leg, standing(x, y, height / 2 - 0.0125)) for x, y in feet)]


def _chair(x: float, y: float, yaw: float) -> list[Placed]:
    """A seat 0.45 m high, its back, four legs."""
    T_world_chair = standing(x, y, 0, yaw)
    parts = [((0.2, 0.2, 0.015), (0.0, 0.0, 0.435)), ((0.2, 0.015, 0.2), (0.0, 0.19, 0.7))]
    parts += [((0.015, 0.015, 0.21), (sx * 0.18, sy * 0.18, 0.21)) for sx in (-1, 1) for sy in (-1, 1)]
    return [(Block(np.array(half)), T_world_chair @ standing(*place)) for half, place in parts]


def _things(
    rng: np.random.Generator, middle: Array, reach: float, height: float, count: int = 7, tallest: float = 0.22
) -> list[Placed]:
    """Cards, boxes and cylinders on a surface, within reach of a place, some of them in contact."""
    things: list[Placed] = []
    for number in range(count):
        x, y = middle + rng.uniform(-reach, reach, 2)
        yaw = rng.uniform(0, 2 * np.pi)
        solid: Block | Cylinder
        if number % 3 == 0:
            half = np.array([*rng.uniform(0.02, 0.04, 2), rng.uniform(0.02, tallest / 2)])
            solid, half_height = Block(half), half[2]
        elif number % 3 == 1:
            half_height = rng.uniform(0.02, tallest / 2)
            solid = Cylinder(rng.uniform(0.02, 0.036), half_height)
        else:
            half_height = rng.uniform(0.008, 0.015)
            solid = Block(np.array([*rng.uniform(0.025, 0.035, 2), half_height]))
        things.append((solid, standing(x, y, height + half_height, yaw)))
    return things


def _sight(rng: np.random.Generator, nearest: float, farthest: float, lowest: float, highest: float) -> Array:
    """From the place looked at to the camera: metres, and degrees above the horizon; from the room's front."""
    distance, pitch = rng.uniform(nearest, farthest), np.deg2rad(rng.uniform(lowest, highest))
    azimuth = np.deg2rad(rng.uniform(-120, -60))
    level = distance * np.cos(pitch)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(pitch)])


def _corners(length: float, depth: float) -> Array:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, depth / 2]
