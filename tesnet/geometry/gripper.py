"""The parallel gripper as the collision check and the candidate generator see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HAND_TO_TCP = 0.1034
"""Metres from the origin of `panda_hand` to the TCP, along z."""


@dataclass(frozen=True, slots=True)
class Gripper:
    """A two-finger parallel hand, metres, in its grasp frame.

    The frame's origin is the TCP, midway between the finger pads; +z is the direction of travel, +y the closing
    direction. Defaults are the Franka hand's.

    Args:
        max_width: largest opening between the pads.
        finger_depth: usable length of the fingers, measured back from the tips.
        finger_thickness: extent of one finger along y.
        finger_breadth: extent of one finger along x.
        tip_offset: distance of the fingertips beyond the TCP along z.
        palm_depth, palm_breadth, palm_length: extents of the hand's body along z, x and y.

    Raises:
        ValueError: a length that is not positive.
    """

    max_width: float = 0.08
    finger_depth: float = 0.05
    finger_thickness: float = 0.0265
    finger_breadth: float = 0.021
    tip_offset: float = 0.0086
    palm_depth: float = 0.092
    palm_breadth: float = 0.063
    palm_length: float = 0.204

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a gripper's lengths are positive, in metres")

    def boxes(self, width: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres (3, 3) and half extents (3, 3) of palm, +y finger and -y finger in the grasp frame.

        Args:
            width: the opening between the pads, metres.
        """
        finger_top = self.tip_offset - self.finger_length
        finger_z = (self.tip_offset + finger_top) / 2
        finger_y = width / 2 + self.finger_thickness / 2
        centres = np.array(
            [[0, 0, finger_top - self.palm_depth / 2], [0, finger_y, finger_z], [0, -finger_y, finger_z]]
        )
        finger = [self.finger_breadth / 2, self.finger_thickness / 2, self.finger_length / 2]
        palm = [self.palm_breadth / 2, self.palm_length / 2, self.palm_depth / 2]
        return centres, np.array([palm, finger, finger])

    @property
    def finger_length(self) -> float:
        """Metres from the hand's body to the fingertips; the body reaches 4 mm into the usable finger depth."""
        return self.finger_depth - 0.004


PANDA = Gripper()
