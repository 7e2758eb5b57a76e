"""Robotiq 2F-85.

Measured on the collision meshes of `robotiq_2f_85_macro.urdf.xacro` in PickNikRobotics/ros2_robotiq_gripper (commit
3b6cf8f), at three openings: no point of a link's convex hull lies more than 1 mm outside of the parts. The arc
follows from the joint origins, to 0.1 mm. The pads (22 x 37.5 mm) are those of ros-industrial's
`robotiq_arg2f_85_model_macro.xacro`. The palm's front is where the inner knuckles begin.
The base link closes along its x, and lies on the coupling, which adds 11 mm to the flange of a UR arm. Force (20 to
235 N) and payload: Robotiq's product sheet of May 2025.
"""

from __future__ import annotations

import math

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="robotiq_2f85",
        max_width=0.085,
        finger_depth=0.048,
        finger_thickness=0.029,
        finger_tip_thickness=0.0065,
        finger_taper=0.044,
        finger_breadth=0.027,
        finger_tip_breadth=0.0215,
        tip_offset=0.0187,
        palm_depth=0.1225,
        palm_length=0.1525,
        palm_breadth=0.075,
        palm_front_breadth=0.03,
        palm_taper=0.074,
        hand_to_tcp=0.13065,
        linkage_length=0.05715,
        linkage_offset=0.00534,
        hand_yaw=math.pi / 2,
    ),
    min_force=20.0,
    max_force=235.0,
    max_payload=5.0,
    simulated=True,
)
