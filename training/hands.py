"""Hands to train with: any of the known ones, or parallel hands of random sizes. Knows no simulator."""

from __future__ import annotations

import math

import numpy as np

from tesnet.geometry import NARROWEST, WIDEST, Gripper
from tesnet.hands import HANDS, KnownHand

RANDOM = "random"

LIKE = 1.15
"""Hands whose `COMPARED` sizes all differ by less than this factor count as one."""

COMPARED = ("max_width", "finger_depth", "finger_thickness", "finger_breadth")

_FORCE = 20.0
_SWINGING = 0.7


def drawn_hand(name: str, rng: np.random.Generator) -> KnownHand:
    """The hand of a name of `HANDS`, for which nothing is drawn, or for `random` a new one."""
    return random_hand(rng) if name == RANDOM else HANDS[name]


def random_hand(rng: np.random.Generator) -> KnownHand:
    """A parallel hand that opens 30 to 160 mm and is like none of those that networks are measured on.

    Sizes follow those of the nine hands of `tesnet.hands`: fingers grow with the opening, but less; a body is 20 to
    125 mm longer than the opening; in 0.7 of those that open 60 mm and more tips swing on cranks 0.53 to 0.78 times as
    long as the opening. The Franka hand, which networks are trained for, may be met.
    """
    while True:
        gripper = _draw(rng)
        if not any(alike(gripper, known.gripper) for name, known in HANDS.items() if name != "franka"):
            return KnownHand(gripper, min_force=_FORCE, max_force=_FORCE, max_payload=1.0, simulated=True)


def alike(one: Gripper, other: Gripper) -> bool:
    """Whether two hands differ little in every size that decides what they can grasp."""
    return all(abs(math.log(getattr(one, name) / getattr(other, name))) < math.log(LIKE) for name in COMPARED)


def _draw(rng: np.random.Generator) -> Gripper:
    width = rng.uniform(NARROWEST, WIDEST)
    finger_depth = float(np.clip((0.030 + 0.21 * width) * rng.lognormal(0.0, 0.2), 0.030, 0.085))
    thickness = float(np.clip((0.010 + 0.13 * width) * rng.lognormal(0.0, 0.3), 0.008, 0.040))
    breadth = float(np.clip(0.022 * rng.lognormal(0.0, 0.22), 0.012, 0.036))
    palm_depth = rng.uniform(0.09, 0.22)
    palm_breadth = rng.uniform(0.045, 0.085)
    tip_offset = finger_depth * rng.uniform(0.15, 0.45)
    linkage_length, linkage_offset = _cranks(width, rng)
    return Gripper(
        max_width=width,
        finger_depth=finger_depth,
        finger_thickness=thickness,
        finger_tip_thickness=max(0.005, thickness * rng.uniform(0.2, 0.9)),
        finger_taper=(finger_depth - 0.004) * rng.uniform(0.3, 0.95),
        finger_breadth=breadth,
        finger_tip_breadth=breadth * rng.uniform(0.5, 1.0),
        tip_offset=tip_offset,
        palm_depth=palm_depth,
        palm_length=width + rng.uniform(0.02, 0.125),
        palm_breadth=palm_breadth,
        palm_front_breadth=palm_breadth * rng.uniform(0.4, 1.0),
        palm_taper=palm_depth * rng.uniform(0.1, 0.7),
        hand_to_tcp=palm_depth + finger_depth - tip_offset,
        linkage_length=linkage_length,
        linkage_offset=linkage_offset,
    )


def _cranks(width: float, rng: np.random.Generator) -> tuple[float | None, float]:
    """L and B of `Gripper`; narrow hands slide."""
    if width < 0.06 or rng.uniform() >= _SWINGING:
        return None, 0.0
    return width * rng.uniform(0.53, 0.78), rng.uniform(-0.001, 0.009)
