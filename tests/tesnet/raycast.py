"""Depth cameras about a table, by exact ray casts: points, outward normals and who saw each. Boxes, cans and bowls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tesnet.geometry import Pose
from tesnet.query import GraspQuery
from tests.tesnet.scenes import UP, Array, ask

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
"""Pixels. At 0.6 m one is 2.7 mm wide."""


class Shape(Protocol):
    def hit(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        """Distances (R,), infinite past it, and outward normals (R, 3) where rays (R, 3) from `origin` (3,) meet it."""


@dataclass(frozen=True)
class Slab:
    """An upright box, its base at `base`, turned about the vertical."""

    base: tuple[float, float, float]
    size: tuple[float, float, float]
    turn_deg: float = 0.0

    def hit(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        frame = _upright(self.base, self.turn_deg)
        start, ways = frame.inverse().apply(origin), frame.inverse().rotate(rays)
        low, high = np.array([-self.size[0] / 2, -self.size[1] / 2, 0.0]), np.array([*self.size]) * [0.5, 0.5, 1.0]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - start) / ways, (high - start) / ways])
        near, far = np.nanmin(ends, axis=0), np.nanmax(ends, axis=0)
        axis = near.argmax(axis=1)
        rows = np.arange(len(rays))
        distance = np.where((near.max(axis=1) <= far.min(axis=1)) & (near.max(axis=1) > 0), near[rows, axis], np.inf)
        normals = np.zeros_like(rays)
        normals[rows, axis] = -np.sign(ways[rows, axis])
        return distance, frame.rotate(normals)


@dataclass(frozen=True)
class Can:
    """An upright cylinder with its top, standing at `base`."""

    base: tuple[float, float, float]
    radius: float
    height: float

    def hit(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        start = origin - np.array(self.base)
        a = (rays[:, :2] ** 2).sum(axis=1)
        b = rays[:, :2] @ start[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            side = (-b - np.sqrt(b * b - a * (start[:2] @ start[:2] - self.radius**2))) / a
            top = (self.height - start[2]) / rays[:, 2]
            height = start[2] + side * rays[:, 2]
            on_side = (side > 0) & (height >= 0) & (height <= self.height)
            on_top = (top > 0) & (np.linalg.norm(start[:2] + top[:, None] * rays[:, :2], axis=1) <= self.radius)
        side, top = np.where(on_side, side, np.inf), np.where(on_top, top, np.inf)
        around = start + np.where(on_side, side, 0.0)[:, None] * rays
        around[:, 2] = 0.0
        return np.minimum(side, top), np.where((top <= side)[:, None], UP, around / self.radius)


@dataclass(frozen=True)
class Bowl:
    """The lower half of a spherical shell, its rim at the height `radius` above `base`; the rim's flat is left open."""

    base: tuple[float, float, float]
    radius: float
    wall: float

    def hit(self, origin: Array, rays: Array) -> tuple[Array, Array]:
        centre = np.array(self.base) + self.radius * UP
        best, normals = np.full(len(rays), np.inf), np.zeros_like(rays)
        for radius, sign, root in ((self.radius, 1.0, -1.0), (self.radius - self.wall, -1.0, 1.0)):
            start = origin - centre
            b = rays @ start
            with np.errstate(invalid="ignore"):
                distance = -b + root * np.sqrt(b * b - (start @ start - radius**2))
                below = start[2] + distance * rays[:, 2] <= 0
            nearer = below & (distance > 0) & (distance < best)
            best[nearer] = distance[nearer]
            normals[nearer] = sign * (start + distance[nearer, None] * rays[nearer]) / radius
        return best, normals


@dataclass(frozen=True, eq=False)
class Views:
    """What cameras saw together.

    Args:
        points, normals: (N, 3), the latter outward and exact.
        view_index: (N,) which of the cameras saw each point.
        cameras: (V, 3).
    """

    points: Array
    normals: Array
    view_index: np.ndarray
    cameras: Array


THINGS: tuple[Shape, ...] = (
    Slab((0.0, 0.0, 0.0), (0.05, 0.035, 0.09), 20.0),
    Slab((-0.10, 0.07, 0.0), (0.06, 0.06, 0.03), 50.0),
    Slab((0.09, -0.09, 0.0), (0.08, 0.003, 0.07), 70.0),
    Can((0.10, 0.06, 0.0), 0.028, 0.10),
    Can((-0.09, -0.06, 0.0), 0.033, 0.05),
    Bowl((0.01, 0.12, 0.0), 0.05, 0.004),
)
"""Boxes, a board of 3 mm on its edge, cans and a bowl of 4 mm, on the plane z = 0."""


TABLE = Slab((0.0, 0.0, -0.02), (2.0, 2.0, 0.02))
OVERHEAD = np.array([[0.001, 0.0, 0.6]])
"""Straight above, all but: a camera that looks along the vertical has no upright image."""


def overhead_query(things: Sequence[Shape], camera: Array = OVERHEAD, **options: Any) -> GraspQuery:
    """What a camera sees of things on a table, and of the table."""
    views = cast((TABLE, *things), camera, np.random.default_rng(0), noise=0.0003)
    return ask(views.points, **{"viewpoints": views.cameras, "up": UP, "support_height": 0.0, **options})


def around(count: int, polar_deg: float = 60.0, radius: float = 0.6, start_deg: float = 10.0) -> Array:
    """Positions (count, 3) of cameras evenly about the table, which look at its middle."""
    azimuth = np.deg2rad(start_deg + 360 * np.arange(count) / count)
    polar = np.deg2rad(polar_deg)
    ring = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)], axis=1)
    return radius * np.concatenate([ring, np.full((count, 1), np.cos(polar))], axis=1)


def cast(things: Sequence[Shape], cameras: Array, rng: np.random.Generator, noise: float = 0.0008) -> Views:
    """What each camera sees of the things, the table left out, with noise along its lines of sight."""
    found = [_cast_one(things, camera) for camera in cameras]
    index = np.repeat(np.arange(len(cameras)), [len(points) for points, _ in found])
    points, normals = (np.concatenate(parts) for parts in zip(*found, strict=True))
    rays = points - cameras[index]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return Views(points + rays * rng.normal(0, noise, (len(points), 1)), normals, index, cameras)


def _cast_one(things: Sequence[Shape], camera: Array) -> tuple[Array, Array]:
    u, v = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    local = np.stack([u.ravel(), v.ravel(), np.full(u.size, FOCAL)], axis=1)
    rays = Pose.look_at(camera, np.zeros(3), UP).rotate(local / np.linalg.norm(local, axis=1, keepdims=True))
    hits = [thing.hit(camera, rays) for thing in things]
    distances = np.stack([distance for distance, _ in hits])
    first, rows = distances.argmin(axis=0), np.arange(len(rays))
    distance, normals = distances[first, rows], np.stack([normal for _, normal in hits])[first, rows]
    seen = np.isfinite(distance)
    return camera + distance[seen, None] * rays[seen], normals[seen]


def _upright(base: tuple[float, float, float], turn_deg: float) -> Pose:
    half = np.deg2rad(turn_deg) / 2
    return Pose.from_quaternion([0.0, 0.0, np.sin(half), np.cos(half)], base)
