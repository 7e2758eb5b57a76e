"""A five-object tabletop cloud without a simulator: boxes and cylinders, ray cast from one camera, the same every time.

Knows the geometry values alone, so the benchmark measures the library and not a physics engine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.solids import Block, Cylinder, Placed, cast, standing
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


def _objects() -> tuple[Placed, ...]:
    return (
        (Block(np.array([0.032, 0.020, 0.072])), standing(0.145, 0.145, SUPPORT_HEIGHT + 0.072, 0.5)),
        (Block(np.array([0.036, 0.026, 0.028])), standing(0.075, 0.080, SUPPORT_HEIGHT + 0.028, -0.3)),
        (Cylinder(0.026, 0.060), standing(0.225, 0.110, SUPPORT_HEIGHT + 0.06, 0.0)),
        (Cylinder(0.033, 0.036), standing(0.075, 0.215, SUPPORT_HEIGHT + 0.036, 0.0)),
        (Block(np.array([0.022, 0.022, 0.045])), standing(0.205, 0.225, SUPPORT_HEIGHT + 0.045, 0.9)),
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

    depth = cast(_objects(), eye, rays_world)
    seen = np.isfinite(depth)
    points_world = eye + depth[seen, None] * rays_world[seen]
    points_world += rng.normal(0.0, NOISE_STANDARD_DEVIATION, points_world.shape)
    inside = ((points_world >= WORKSPACE_MINIMUM) & (points_world <= WORKSPACE_MAXIMUM)).all(axis=1)
    points_world = points_world[inside]
    if len(points_world) < num_points:
        raise ValueError(f"the camera sees {len(points_world)} points; ask for at most that many, not {num_points}")
    kept = np.sort(rng.choice(len(points_world), num_points, replace=False))
    return Scene(points_world[kept].astype(np.float32), eye)
