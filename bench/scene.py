"""A five-object tabletop cloud without a simulator: boxes and cylinders, ray cast from one camera, the same every time.

Knows the geometry values alone, so the benchmark measures the library and not a physics engine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry import CameraIntrinsics, Pose

INTRINSICS = CameraIntrinsics(width=640, height=480, fx=540.0, fy=540.0, cx=320.0, cy=240.0)
UP = (0.0, 0.0, 1.0)
SUPPORT_HEIGHT = 0.05
"""Metres: the table's top along `UP`."""
WORKSPACE_MINIMUM = (0.02, 0.02, 0.055)
WORKSPACE_MAXIMUM = (0.28, 0.28, 0.30)
NOISE_STANDARD_DEVIATION = 0.0008
"""Metres, per coordinate."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """One camera's view of the table.

    Args:
        points_world: (N, 3) float32, metres, cropped to the workspace.
        viewpoint_world: (3,) position of the camera.
    """

    points_world: NDArray[np.float32]
    viewpoint_world: Array


@dataclass(frozen=True, eq=False, slots=True)
class _Box:
    half_extents: Array

    def distances(self, origins: Array, directions: Array) -> Array:
        """(R,) distances along rays (origins and directions (R, 3), box frame) to the first hit, inf for a miss."""
        inverse = 1.0 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        crossings = np.stack([-self.half_extents - origins, self.half_extents - origins]) * inverse
        entry, leave = crossings.min(axis=0).max(axis=1), crossings.max(axis=0).min(axis=1)
        return np.where((entry <= leave) & (entry > 0), entry, np.inf)


@dataclass(frozen=True, eq=False, slots=True)
class _Cylinder:
    radius: float
    half_height: float

    def distances(self, origins: Array, directions: Array) -> Array:
        """(R,) distances along rays to the first hit of the closed cylinder about z, inf for a miss."""
        a = np.maximum((directions[:, :2] ** 2).sum(axis=1), 1e-12)
        b = (origins[:, :2] * directions[:, :2]).sum(axis=1)
        c = (origins[:, :2] ** 2).sum(axis=1) - self.radius**2
        discriminant = b**2 - a * c
        side = (-b - np.sqrt(np.maximum(discriminant, 0.0))) / a
        hits_side = (discriminant >= 0) & (np.abs(origins[:, 2] + side * directions[:, 2]) <= self.half_height)
        slope = np.where(np.abs(directions[:, 2]) < 1e-12, 1e-12, directions[:, 2])
        cap = (self.half_height - origins[:, 2]) / slope
        radii = np.linalg.norm(origins[:, :2] + cap[:, None] * directions[:, :2], axis=1)
        hits_cap = (radii <= self.radius) & (cap > 0)
        return np.minimum(np.where(hits_side & (side > 0), side, np.inf), np.where(hits_cap, cap, np.inf))


def _standing(x: float, y: float, height: float, yaw: float) -> Pose:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Pose(rotation, np.array([x, y, SUPPORT_HEIGHT + height / 2]))


def _objects() -> tuple[tuple[_Box | _Cylinder, Pose], ...]:
    return (
        (_Box(np.array([0.032, 0.020, 0.072])), _standing(0.145, 0.145, 0.144, 0.5)),
        (_Box(np.array([0.036, 0.026, 0.028])), _standing(0.075, 0.080, 0.056, -0.3)),
        (_Cylinder(0.026, 0.060), _standing(0.225, 0.110, 0.120, 0.0)),
        (_Cylinder(0.033, 0.036), _standing(0.075, 0.215, 0.072, 0.0)),
        (_Box(np.array([0.022, 0.022, 0.045])), _standing(0.205, 0.225, 0.090, 0.9)),
    )


def five_objects(num_points: int = 20_000, seed: int = 0) -> Scene:
    """A view of five objects that stand on a table, with the table cropped away as the harness does.

    Args:
        num_points: how many of the camera's points to keep, drawn without replacement.
        seed: of the noise and of the draw.

    Raises:
        ValueError: the camera sees fewer points than `num_points`.
    """
    rng = np.random.default_rng(seed)
    centre = np.array([0.15, 0.15, 0.09])
    polar, azimuth, radius = np.deg2rad(50.0), np.deg2rad(60.0), 0.60
    eye = centre + radius * np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)],
    )
    T_world_camera = Pose.look_at(eye, centre, np.array(UP))
    # A depth image of ones back-projects to the ray of every pixel.
    rays_world = T_world_camera.rotate(INTRINSICS.back_project(np.ones((INTRINSICS.height, INTRINSICS.width))))

    depth = np.full(len(rays_world), np.inf)
    for solid, T_world_object in _objects():
        T_object_world = T_world_object.inverse()
        origins = np.broadcast_to(T_object_world.apply(eye), rays_world.shape)
        depth = np.minimum(depth, solid.distances(origins, T_object_world.rotate(rays_world)))

    seen = np.isfinite(depth)
    points_world = eye + depth[seen, None] * rays_world[seen]
    points_world += rng.normal(0.0, NOISE_STANDARD_DEVIATION, points_world.shape)
    inside = ((points_world >= WORKSPACE_MINIMUM) & (points_world <= WORKSPACE_MAXIMUM)).all(axis=1)
    points_world = points_world[inside]
    if len(points_world) < num_points:
        raise ValueError(f"the camera sees {len(points_world)} points; ask for at most that many, not {num_points}")
    kept = np.sort(rng.choice(len(points_world), num_points, replace=False))
    return Scene(points_world[kept].astype(np.float32), eye)
