"""OnRobot RG2.

Measured on the collision meshes of `rg2_macro.xacro` in tonydle/OnRobot_ROS2_Description (commit 29180b3), at three
openings: no point of a link's convex hull lies more than 1 mm outside of the parts. The gap at the joint's limit is
104 mm, for which the data sheet says 110. The arc follows from the joint origins, to 0.1 mm: from open to closed the
tips advance 43 mm, so the whole opening is seldom wanted. The body is 1.8 mm off the middle along x.
Forces (3 to 40 N) and payload: OnRobot's data sheet 1.4 of 2015.
"""

from __future__ import annotations

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="rg2",
        max_width=0.104,
        finger_depth=0.036,
        finger_thickness=0.019,
        finger_tip_thickness=0.011,
        finger_taper=0.032,
        finger_breadth=0.0205,
        finger_tip_breadth=0.0155,
        tip_offset=0.0148,
        palm_depth=0.2015,
        palm_length=0.152,
        palm_breadth=0.079,
        palm_front_breadth=0.033,
        palm_taper=0.133,
        hand_to_tcp=0.1754,
        linkage_length=0.055,
        linkage_offset=-0.00176,
    ),
    min_force=3.0,
    max_force=40.0,
    max_payload=2.0,
    simulated=True,
)
