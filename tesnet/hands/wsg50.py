"""Weiss Robotics (Schunk) WSG 50-110 with its stock fingers. No claims from simulation.

Measured on the meshes and boxes of `schunk_wsg_50_with_tip.sdf` in RobotLocomotion/models (commit 4723170), drawn
after the maker's catalogue; the opening is the stroke of the maker's page. The guides of the jaws are 18 mm thick
and as broad as the fingers' roots: the palm begins before them. At 45 to 57 mm behind the tips the fingers are 2.5
mm broader to either side than the parts.
The base link closes along its x. Forces (5 to 80 N): the maker's page. The payload is a guess.
"""

from __future__ import annotations

import math

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="wsg50",
        max_width=0.11,
        finger_depth=0.061,
        finger_thickness=0.023,
        finger_tip_thickness=0.015,
        finger_taper=0.057,
        finger_breadth=0.024,
        finger_tip_breadth=0.016,
        tip_offset=0.01,
        palm_depth=0.0975,
        palm_length=0.157,
        palm_breadth=0.05,
        palm_front_breadth=0.03,
        palm_taper=0.0245,
        hand_to_tcp=0.1444,
        hand_yaw=math.pi / 2,
    ),
    min_force=5.0,
    max_force=80.0,
    max_payload=0.8,
    simulated=False,
)
