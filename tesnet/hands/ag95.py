"""DH-Robotics AG-95. No claims from simulation.

Measured on the collision meshes of `dh_ag95_macro.xacro` in ian-chuang/dh_ag95_gripper_ros2 (commit fc4f80f): inner
knuckles lie 4.6 mm outside of the parts, 32 to 39 mm behind the tips. The arc follows from the joint origins, to 0.1
mm. The URDF's own `grasp_link` (0.19 m) lies 22 mm beyond the TCP of the open hand.
The base link closes along its x. Opening, forces (45 to 160 N) and payload: the maker's sheet, as
TrossenRobotics/dobot_cr_cobots_docs quotes it.
"""

from __future__ import annotations

import math

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="ag95",
        max_width=0.095,
        finger_depth=0.043,
        finger_thickness=0.03,
        finger_tip_thickness=0.008,
        finger_taper=0.039,
        finger_breadth=0.021,
        finger_tip_breadth=0.021,
        tip_offset=0.017,
        palm_depth=0.165,
        palm_length=0.163,
        palm_breadth=0.067,
        palm_front_breadth=0.035,
        palm_taper=0.027,
        hand_to_tcp=0.16754,
        linkage_length=0.055,
        linkage_offset=0.0085,
        hand_yaw=math.pi / 2,
    ),
    min_force=45.0,
    max_force=160.0,
    max_payload=3.0,
    simulated=False,
)
