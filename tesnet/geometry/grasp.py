"""Grasps as values, and the axes that other programs expect them in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry.gripper import PANDA, Gripper
from tesnet.geometry.pose import Array, frozen

FrameConvention = Literal["panda", "graspnet", "contact_graspnet"]
FRAME_CONVENTIONS: tuple[FrameConvention, ...] = get_args(FrameConvention)


@dataclass(frozen=True, eq=False, slots=True)
class GraspSet:
    """M grasps, best first; every pose maps the grasp frame into the cloud's frame.

    Args:
        scores: (M,) probability of success.
        Ts_cloud_grasp: (M, 4, 4) poses of the TCP: +z the direction of travel, +y the closing direction.
        widths: (M,) opening to set before approaching, metres.
        approach_points, contact_points: (M, 3) the two cloud points that define each grasp, metres.
        gripper: the hand that they are for.

    Raises:
        ValueError: shapes that do not agree, values that are not finite.
    """

    scores: Array
    Ts_cloud_grasp: Array
    widths: Array
    approach_points: Array
    contact_points: Array
    gripper: Gripper = PANDA

    def __post_init__(self) -> None:
        count = len(self.scores)
        shapes = {
            "scores": (count,),
            "Ts_cloud_grasp": (count, 4, 4),
            "widths": (count,),
            "approach_points": (count, 3),
            "contact_points": (count, 3),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name))

    @classmethod
    def empty(cls, gripper: Gripper = PANDA) -> GraspSet:
        """No grasps."""
        return cls(np.empty(0), np.empty((0, 4, 4)), np.empty(0), np.empty((0, 3)), np.empty((0, 3)), gripper)

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def hand_poses(self) -> NDArray[np.float64]:
        """(M, 4, 4) poses of the hand's base link, in its own axes, with the hand open as wide as the grasp says."""
        Ts_grasp_hand = [self.gripper.T_grasp_hand(width).matrix for width in self.widths.tolist()]
        return np.asarray(self.Ts_cloud_grasp @ np.array(Ts_grasp_hand).reshape(-1, 4, 4))

    def pregrasps(self, distance: float) -> NDArray[np.float64]:
        """(M, 4, 4) TCP poses moved back by `distance` metres against the direction of travel."""
        poses = np.array(self.Ts_cloud_grasp)
        poses[:, :3, 3] -= distance * poses[:, :3, 2]
        return poses

    def in_convention(self, convention: FrameConvention) -> NDArray[np.float64]:
        """(M, 4, 4) poses with the axes and origin of another program.

        `panda` is ours. `graspnet` has columns (z, y, -x) of ours and its origin at the TCP; `contact_graspnet` has
        columns (y, -x, z) and its origin at the hand's base link.

        Raises:
            ValueError: an unknown convention; the message lists the valid ones.
        """
        if convention not in FRAME_CONVENTIONS:
            raise ValueError(f"unknown frame convention {convention!r}; valid: {', '.join(FRAME_CONVENTIONS)}")
        poses = np.array(self.Ts_cloud_grasp)
        if convention == "contact_graspnet":
            poses[:, :3, 3] = self.hand_poses[:, :3, 3]
        x, y, z = (poses[:, :3, axis] for axis in range(3))
        columns = {"panda": (x, y, z), "graspnet": (z, y, -x), "contact_graspnet": (y, -x, z)}[convention]
        poses[:, :3, :3] = np.stack(columns, axis=2)
        return poses
