"""A box on a table as a depth camera sees it: ray cast, without noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry import CameraIntrinsics, Pose

SIZE = np.array([0.04, 0.06, 0.12])
"""Of the box, which stands at the origin of a table at z = 0."""
FARTHEST = 0.62
"""Metres that the camera sees."""


@dataclass(frozen=True)
class DepthView:
    """Depth (height, width) in metres, 0 where there is none; which pixels show the box; and the camera."""

    depth: NDArray[np.float64]
    mask: NDArray[np.bool_]
    intrinsics: CameraIntrinsics
    T_cloud_camera: Pose

    @property
    def counts(self) -> NDArray[np.uint16]:
        """The depth in millimetres."""
        return np.rint(1000 * self.depth).astype(np.uint16)

    @property
    def camera(self) -> dict[str, Any]:
        """The camera as options of a form."""
        k = self.intrinsics
        return {
            "intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy},
            "T_cloud_camera": self.T_cloud_camera.matrix.tolist(),
        }


def box_on_table() -> DepthView:
    """The box from half a metre away, obliquely from above."""
    intrinsics = CameraIntrinsics(200, 160, fx=280.0, fy=290.0, cx=99.0, cy=80.5)
    T_cloud_camera = Pose.look_at([0.3, 0.15, 0.4], [0, 0, 0.05], [0, 0, 1])
    rays = T_cloud_camera.rotate(intrinsics.back_project(np.ones((160, 200))))
    eye = T_cloud_camera.translation
    low, high = np.array([-0.5, -0.5, 0]) * SIZE, np.array([0.5, 0.5, 1]) * SIZE
    with np.errstate(divide="ignore"):
        crossings = np.stack([low - eye, high - eye])[:, None] / rays
        to_table = -eye[2] / rays[:, 2]
    entry, leave = crossings.min(axis=0).max(axis=1), crossings.max(axis=0).min(axis=1)
    mask = entry <= leave
    depth = np.where(mask, entry, to_table)
    seen = np.where((depth > 0) & (depth < FARTHEST), depth, 0.0)
    return DepthView(seen.reshape(160, 200), mask.reshape(160, 200), intrinsics, T_cloud_camera)
