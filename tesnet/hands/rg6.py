"""OnRobot RG6. No claims from simulation.

Measured on the collision meshes of `rg6_macro.xacro` in tonydle/OnRobot_ROS2_Description (commit 29180b3), at three
openings: no point of a link's convex hull lies more than 1 mm outside of the parts. The gap at the joint's limit is
151 mm; the URDF calls it 160. The arc follows from the joint origins, to 0.1 mm: the tips advance 55 mm from open to
closed. The body is 2.2 mm off the middle along x.
The greatest force stands in the URDF; the least force and the payload are unverified.
"""

from __future__ import annotations

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="rg6",
        max_width=0.151,
        finger_depth=0.043,
        finger_thickness=0.0235,
        finger_tip_thickness=0.012,
        finger_taper=0.039,
        finger_breadth=0.0255,
        finger_tip_breadth=0.0145,
        tip_offset=0.018,
        palm_depth=0.244,
        palm_length=0.2135,
        palm_breadth=0.08,
        palm_front_breadth=0.032,
        palm_taper=0.125,
        hand_to_tcp=0.21018,
        linkage_length=0.08,
        linkage_offset=-0.0005,
    ),
    min_force=25.0,
    max_force=120.0,
    max_payload=6.0,
    simulated=False,
)
