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


def depth_in_hand(points: Array, T: Array, hand: Gripper, width: float) -> Array:
    """(P,) how deep, in metres, points (P, 3) lie in the hand at rest at a pose (4, 4); negative outside."""
    local = (points - T[:3, 3]) @ T[:3, :3]
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
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
    """(C,) of the deepest point at any step, a millimetre apart, of the straight way to each pose, open by `widths`."""
    deepest = np.full(len(Ts), -np.inf)
    for row, (T, width) in enumerate(zip(Ts, widths, strict=True)):
        for back in np.linspace(0, sweep, 1 + round(1000 * sweep)):
            behind = T.copy()
            behind[:3, 3] -= back * T[:3, 2]
            deepest[row] = max(deepest[row], depth_in_hand(points, behind, hand, width).max())
    return deepest
