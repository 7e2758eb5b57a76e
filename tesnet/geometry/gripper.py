"""The parallel gripper: its sizes, and the parts that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry.part import Extent, Part

HAND_TO_TCP = 0.1034
"""Metres from the origin of `panda_hand` to the TCP, along z."""

PALM_OVERLAP = 0.004
"""Metres of the usable finger depth that the hand's body covers."""

_TAPERED = {
    "finger_thickness": "finger_tip_thickness",
    "finger_breadth": "finger_tip_breadth",
    "palm_breadth": "palm_front_breadth",
}
"""Each size of a part, and the size of its narrower end."""


@dataclass(frozen=True, slots=True)
class Gripper:
    """A two-finger parallel hand, metres, in its grasp frame.

    The frame's origin is the TCP, midway between the finger pads; +z is the direction of travel, +y the closing
    direction. Fingers are prisms whose outer face tapers towards the tip; the palm is a box whose sides taper towards
    the fingers. Defaults are the Franka hand's, measured on the convex hulls of its published collision meshes.

    Args:
        max_width: largest opening between the pads.
        finger_depth: usable length of the fingers, measured back from the tips.
        finger_thickness, finger_tip_thickness: extent of one finger along y, at its root and at its tip.
        finger_taper: length of the taper, measured back from the tip.
        finger_breadth, finger_tip_breadth: extent of one finger along x, and at its very tip.
        tip_offset: distance of the fingertips beyond the TCP along z.
        palm_depth, palm_length: extents of the hand's body along z and y.
        palm_breadth, palm_front_breadth: its extent along x, largest and at the fingers.
        palm_taper: length of its taper, measured back from the fingers.

    Raises:
        ValueError: a length that is not positive, an end broader than its part, fingers too short for the TCP.
    """

    max_width: float = 0.08
    finger_depth: float = 0.05
    finger_thickness: float = 0.0264
    finger_tip_thickness: float = 0.0144
    finger_taper: float = 0.038
    finger_breadth: float = 0.021
    finger_tip_breadth: float = 0.0125
    tip_offset: float = 0.0086
    palm_depth: float = 0.092
    palm_length: float = 0.204
    palm_breadth: float = 0.063
    palm_front_breadth: float = 0.0315
    palm_taper: float = 0.0625

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; a gripper's lengths are positive, in metres")
        for whole, end in _TAPERED.items():
            if getattr(self, end) > getattr(self, whole):
                raise ValueError(
                    f"{end} is {getattr(self, end)}, more than {whole} ({getattr(self, whole)}); give both, the end "
                    "not larger than the whole"
                )
        if not self.palm_front < 0:
            raise ValueError(
                f"finger_depth is {self.finger_depth}; it must exceed {self.tip_offset + PALM_OVERLAP:g} m, or the "
                "palm would lie between the pads"
            )

    # Factories

    @classmethod
    def like_panda(cls, lengths: Mapping[str, float]) -> Gripper:
        """A hand that differs from the Panda's in the lengths given, by their names.

        A part whose size is given is straight, unless its tapered end is given as well; a taper that would be longer
        than its part is cut.

        Raises:
            ValueError: as for any `Gripper`.
        """
        given = dict(lengths)
        for whole, end in _TAPERED.items():
            if whole in given:
                given.setdefault(end, given[whole])
        hand = cls(**given)
        given["finger_taper"] = min(hand.finger_taper, hand.finger_length)
        given["palm_taper"] = min(hand.palm_taper, hand.palm_depth)
        return cls(**given)

    # Accessors

    @property
    def finger_length(self) -> float:
        """Metres from the hand's body to the fingertips; the body reaches 4 mm into the usable finger depth."""
        return self.finger_depth - PALM_OVERLAP

    @property
    def palm_front(self) -> float:
        """Where, along z, the palm's face between the fingers lies."""
        return self.tip_offset - self.finger_length

    @property
    def parts(self) -> tuple[Part, Part, Part]:
        """The solids that the hand is made of: left finger (+y), right finger and palm."""
        thickness = Extent(self.finger_thickness, self.finger_tip_thickness, self.finger_taper)
        breadth, tip_breadth = Extent.constant(self.finger_breadth), self.finger_tip_breadth
        front, back = self.tip_offset, self.palm_front
        return (
            Part("left finger", 1, front, back, breadth, thickness, tip_breadth),
            Part("right finger", -1, front, back, breadth, thickness, tip_breadth),
            Part(
                "palm",
                0,
                back,
                back - self.palm_depth,
                Extent(self.palm_breadth, self.palm_front_breadth, self.palm_taper),
                Extent.constant(self.palm_length),
            ),
        )

    # Operations

    def corners(self, width: float) -> NDArray[np.float64]:
        """Extreme points (K, 3) of the hand in the grasp frame; their convex hull contains each finger and the palm.

        Args:
            width: the opening between the pads, metres.
        """
        return np.concatenate([part.corners(width) for part in self.parts])


PANDA = Gripper()
