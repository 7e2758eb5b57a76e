"""Wrong calibration: a camera that is not quite where it is believed to be, a depth scale, a table's height.

Knows nothing of images. Sizes that others train or specify with: 5 mm and 1 degree of pose (Xie et al., "Unseen Object
Instance Segmentation for Robotic Environments", T-RO 2021), 2 % of depth (Intel's data sheet of the D400 family, the
largest error of depth that it allows at 80 % of the image).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tesnet.geometry import Pose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Sizes of the errors, drawn anew for each observation; directions and signs are random.

    Nothing is drawn for a size of 0.

    Args:
        translation: distance between the believed and the true camera position, metres.
        rotation_deg: angle between the believed and the true orientation.
        depth_scale: part by which all depth is too large or too small.
        table_height: metres by which the table is believed too high or too low.
        exact: errors have these very sizes; otherwise any size up to them, uniformly.
    """

    translation: float = 0.0
    rotation_deg: float = 0.0
    depth_scale: float = 0.0
    table_height: float = 0.0
    exact: bool = False

    def believed_pose(self, T_world_camera: Pose, rng: np.random.Generator) -> Pose:
        """Where a camera is believed to be, T_world_camera."""
        if not self.translation and not self.rotation_deg:
            return T_world_camera
        shift = self._size(self.translation, rng) * _direction(rng)
        turn = _turn(_direction(rng), np.deg2rad(self._size(self.rotation_deg, rng)))
        return T_world_camera @ Pose(turn, shift)

    def scale_error(self, rng: np.random.Generator) -> float:
        """What measured depth is multiplied with."""
        return 1.0 + self._signed(self.depth_scale, rng) if self.depth_scale else 1.0

    def height_error(self, rng: np.random.Generator) -> float:
        """What is added to the table's height, metres."""
        return self._signed(self.table_height, rng) if self.table_height else 0.0

    def _size(self, limit: float, rng: np.random.Generator) -> float:
        return limit if self.exact else float(rng.uniform(0.0, limit))

    def _signed(self, limit: float, rng: np.random.Generator) -> float:
        return self._size(limit, rng) * float(rng.choice([-1.0, 1.0]))


def _direction(rng: np.random.Generator) -> Array:
    """A unit vector (3,), uniform on the sphere."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _turn(axis: Array, angle: float) -> Array:
    """Rotation matrix (3, 3) about a unit axis by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
