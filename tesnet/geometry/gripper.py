"""A two-finger hand: its sizes, and the parts that follow from them. Knows no hand by name but the Panda's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry.part import Extent, Part
from tesnet.geometry.pose import Pose

WIDEST = 0.16
"""Metres: the largest opening of any hand that is served, or trained with."""

NARROWEST = 0.03
"""Metres: the largest opening of the smallest hand that is trained with."""

PALM_OVERLAP = 0.004
"""Metres of the usable finger depth that the hand's body covers."""

FAR_SWING = 0.03
"""Metres: tips that advance as far or farther from open to closed hold otherwise than others (training/NOTES.md)."""

_TAPERED = {
    "finger_thickness": "finger_tip_thickness",
    "finger_breadth": "finger_tip_breadth",
    "palm_breadth": "palm_front_breadth",
}
"""Each size of a part, and the size of its narrower end."""

_OF_EITHER_SIGN = ("hand_yaw", "linkage_offset")


@dataclass(frozen=True, slots=True)
class Gripper:
    """A two-finger hand with parallel pads, metres, in its grasp frame.

    The frame's origin is the TCP, midway between the finger pads; +z is the direction of travel, +y the closing
    direction. Fingers are prisms whose outer face tapers towards the tip; the palm is a box whose sides taper towards
    the fingers. Defaults are the Franka hand's, measured on the convex hulls of its published collision meshes.

    Fingers slide along y, or swing on parallel cranks: then their tips also move along z as they close. From the base
    link they are at A + sqrt(L^2 - (w / 2 - B)^2) with the opening w, the cranks' length L and B, how far their pivots
    stand outside of where the pads are on the middle line. The grasp frame moves with the tips, so in it the palm
    moves; `palm_depth` is such that the part covers the palm at every opening.

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
        hand_to_tcp: distance along z from the origin of the hand's base link to the TCP of the open hand.
        hand_yaw: angle about z from the grasp frame's axes to the base link's, radians.
        linkage_length: L; None where the fingers slide.
        linkage_offset: B.
        name: of a known hand, or None; it makes no difference to equality.

    Raises:
        ValueError: a length that is not positive, an end broader than its part, fingers too short for the TCP, cranks
            that do not reach the opening.
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
    hand_to_tcp: float = 0.1034
    hand_yaw: float = 0.0
    linkage_length: float | None = None
    linkage_offset: float = 0.0
    name: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name, value in self.sizes().items():
            if value is not None and name not in _OF_EITHER_SIGN and not value > 0:
                raise ValueError(f"{name} is {value}; a gripper's lengths are positive, in metres")
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
        self._check_linkage()

    def _check_linkage(self) -> None:
        length, offset = self.linkage_length, self.linkage_offset
        if length is None:
            if offset:
                raise ValueError(
                    f"linkage_offset is {offset}; it needs linkage_length, the length of the cranks in metres"
                )
            return
        if not abs(offset) < length:
            raise ValueError(f"linkage_offset is {offset}; it must be nearer to 0 than linkage_length, {length} m")
        if not self.max_width < self.reach_of_cranks:
            raise ValueError(
                f"max_width is {self.max_width}; cranks with linkage_length {length} and linkage_offset {offset} open "
                f"less than {self.reach_of_cranks:g} m; give a smaller opening or longer cranks"
            )

    # Factories

    def with_sizes(self, sizes: Mapping[str, float | None]) -> Gripper:
        """A hand that differs from this one in the sizes given, by their names; it has no name.

        A part whose size is given is straight, unless its tapered end is given as well; a taper that would be longer
        than its part is cut. Where cranks open less, the base link stays where it is as they close to the same width:
        `hand_to_tcp` follows, unless it is given.

        Raises:
            ValueError: as for any `Gripper`.
        """
        given: dict[str, Any] = dict(sizes)
        for whole, end in _TAPERED.items():
            if whole in given:
                given.setdefault(end, given[whole])
        hand = replace(self, **given, name=None)
        both_swing = self.linkage_length is not None and hand.linkage_length is not None
        opens_less = hand.max_width <= self.max_width < hand.reach_of_cranks
        if both_swing and opens_less and "hand_to_tcp" not in given:
            hand = replace(
                hand, hand_to_tcp=hand.hand_to_tcp + _rise(hand, hand.max_width) - _rise(hand, self.max_width)
            )
        return replace(
            hand,
            finger_taper=min(hand.finger_taper, hand.finger_length),
            palm_taper=min(hand.palm_taper, hand.palm_depth),
        )

    # Accessors

    def sizes(self) -> dict[str, float | None]:
        """The hand's sizes by their names."""
        return {item.name: getattr(self, item.name) for item in fields(self) if item.name != "name"}

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

    @property
    def reach_of_cranks(self) -> float:
        """Metres that the hand's cranks open less than; infinite where the fingers slide."""
        return math.inf if self.linkage_length is None else 2 * (self.linkage_length + self.linkage_offset)

    @property
    def travel(self) -> float:
        """Metres by which the tips advance along z at most as the open hand closes."""
        return float(self.tcp_at(self.farthest_width) - self.hand_to_tcp)

    @property
    def swings_far(self) -> bool:
        """Whether the tips advance so far as the hand closes that it holds otherwise than other hands."""
        return self.travel >= FAR_SWING

    @property
    def farthest_width(self) -> float:
        """The opening at which tips that swing are farthest along z, metres."""
        return min(max(2 * self.linkage_offset, 0.0), self.max_width)

    # Operations

    def tcp_at(self, width: Any) -> Any:
        """Metres from the origin of the hand's base link to the TCP, along z, as the hand is open by `width`.

        Args:
            width: a number, or an array or tensor of them.
        """
        if self.linkage_length is None:
            return self.hand_to_tcp
        return self.hand_to_tcp + _rise(self, width) - _rise(self, self.max_width)

    def T_grasp_hand(self, width: float) -> Pose:
        """Pose of the hand's base link in the grasp frame of the hand open by `width`."""
        cosine, sine = math.cos(self.hand_yaw), math.sin(self.hand_yaw)
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return Pose(rotation, np.array([0.0, 0.0, -self.tcp_at(width)]))

    def corners(self, width: float) -> NDArray[np.float64]:
        """Extreme points (K, 3) of the hand in the grasp frame; their convex hull contains each finger and the palm.

        Args:
            width: the opening between the pads, metres.
        """
        return np.concatenate([part.corners(width) for part in self.parts])


def _rise(hand: Gripper, width: Any) -> Any:
    """Metres from the joints of the hand's cranks to their ends, along z, as the hand is open by `width`."""
    assert hand.linkage_length is not None
    return (hand.linkage_length**2 - (width / 2 - hand.linkage_offset) ** 2) ** 0.5


PANDA = Gripper(name="franka")
