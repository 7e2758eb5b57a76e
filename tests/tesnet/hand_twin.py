"""A hand's volume written a second time, from its sizes alone: float64, loops, nothing of `tesnet.swept`."""

from __future__ import annotations

import numpy as np

from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from tests.tesnet.scenes import Array

PALM_OVERLAP = 0.004
"""Metres by which the palm reaches into the usable finger depth."""

HANDS_TO_TRY: dict[str, Gripper] = {
    "panda": PANDA,
    "narrow": PANDA.with_sizes({"max_width": 0.04}),
    "broad palm": PANDA.with_sizes({"palm_length": 0.3, "palm_breadth": 0.16, "palm_depth": 0.05}),
    "long thick fingers": PANDA.with_sizes({"finger_depth": 0.07, "finger_thickness": 0.04, "finger_breadth": 0.05}),
    "listed": HANDS["wsg50"].gripper,
}
"""Hands that sweep other volumes than the Panda's, by sizes and by name; their tips slide straight."""


def depth_in_hand(places: Array, hand: Gripper, width: float) -> Array:
    """(...) how deep, in metres, places (..., 3) of the grasp frame lie in the hand at rest; negative outside."""
    x, y, z = np.abs(places[..., 0]), np.abs(places[..., 1]), places[..., 2]
    front, palm = hand.tip_offset, hand.tip_offset - (hand.finger_depth - PALM_OVERLAP)
    taper, end = max(hand.finger_taper, 1e-9), hand.finger_tip_thickness
    thickness = np.interp(front - z, [0, taper], [end, hand.finger_thickness])
    finger = [y - width / 2, width / 2 + thickness - y, hand.finger_breadth / 2 - x, front - z, z - palm]
    taper, end = max(hand.palm_taper, 1e-9), hand.palm_front_breadth
    breadth = np.interp(palm - z, [0, taper], [end, hand.palm_breadth])
    body = [breadth / 2 - x, hand.palm_length / 2 - y, palm - z, z - (palm - hand.palm_depth)]
    deepest: Array = np.maximum(np.min(finger, axis=0), np.min(body, axis=0))
    return deepest


def deepest_on_way(points: Array, Ts: Array, hand: Gripper, widths: Array, sweep: float) -> Array:
    """(C,) of the deepest of the points (P, 3) at any step, a millimetre apart, of the straight way to each pose.

    The hand at pose (4, 4) is open by its entry of `widths` (C,) all the way, which is `sweep` metres long.
    """
    steps = np.linspace(0, sweep, 1 + round(1000 * sweep))[:, None, None] * np.array([0.0, 0.0, 1.0])
    places = ((points - T[:3, 3]) @ T[:3, :3] + steps for T in Ts)
    return np.array([depth_in_hand(*of_hand).max() for of_hand in zip(places, [hand] * len(Ts), widths, strict=True)])
