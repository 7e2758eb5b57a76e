"""Robotiq Hand-E.

Measured on the finger's collision mesh in AGH-CEAI/robotiq_hande_description (commit 4f66b05), whose
`robotiq_hande_gripper.xacro` also gives the body (a cylinder, 75 mm across and 99 mm high) and the frame at the
tips, 0.1455 m from the base. The feet of the fingers reach 6.6 mm inwards of the pads over 8 mm of height: the palm
begins before them.
The base link closes along its x; a coupler adds 11 mm to the flange. Opening, forces (20 to 185 N) and payload by
friction: Robotiq's product sheet of May 2025 and its manual's example.
"""

from __future__ import annotations

import math

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="hand_e",
        max_width=0.05,
        finger_depth=0.0405,
        finger_thickness=0.011,
        finger_tip_thickness=0.006,
        finger_taper=0.0265,
        finger_breadth=0.021,
        finger_tip_breadth=0.021,
        tip_offset=0.0105,
        palm_depth=0.109,
        palm_length=0.075,
        palm_breadth=0.075,
        palm_front_breadth=0.037,
        palm_taper=0.01,
        hand_to_tcp=0.135,
        hand_yaw=math.pi / 2,
    ),
    min_force=20.0,
    max_force=185.0,
    max_payload=3.3,
    simulated=True,
)
