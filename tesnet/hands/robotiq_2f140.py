"""Robotiq 2F-140, with the thick pads of its URDF.

Measured on the collision meshes of `robotiq_2f_140.xacro` in PickNikRobotics/ros2_robotiq_gripper (commit 3b6cf8f),
at three openings: the corner of a knuckle lies 2.3 mm outside of the parts. These pads (27 x 65 x 7.5 mm) leave
128.5 mm between them; the data sheet says 140, which the bare fingers nearly have. The arc follows from the joint
origins, to 0.1 mm.
Forces (10 to 125 N) and payload: Robotiq's product sheet of May 2025.
"""

from __future__ import annotations

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="robotiq_2f140",
        max_width=0.128,
        finger_depth=0.072,
        finger_thickness=0.0345,
        finger_tip_thickness=0.0075,
        finger_taper=0.068,
        finger_breadth=0.027,
        finger_tip_breadth=0.027,
        tip_offset=0.0325,
        palm_depth=0.168,
        palm_length=0.2025,
        palm_breadth=0.075,
        palm_front_breadth=0.039,
        palm_taper=0.1,
        hand_to_tcp=0.17717,
        linkage_length=0.1,
        linkage_offset=-0.00039,
    ),
    min_force=10.0,
    max_force=125.0,
    max_payload=2.5,
    simulated=True,
)
