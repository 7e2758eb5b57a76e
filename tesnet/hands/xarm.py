"""UFACTORY xArm gripper G1. No claims from simulation.

Measured on the meshes of `xarm_gripper.urdf.xacro` in xArm-Developer/xarm_ros2 (commit 3654ba7): within 1 mm, but
for a boss of 9 mm inside of the arm's flange. The meshes open to 88.9 mm; the maker's programs count to 85. The arc
follows from the joint origins, to 0.1 mm. The URDF's own `link_tcp` (0.172 m) lies beyond the open tips.
No data sheet was found: force and payload are guesses.
"""

from __future__ import annotations

from tesnet.geometry import Gripper
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=Gripper(
        name="xarm",
        max_width=0.085,
        finger_depth=0.054,
        finger_thickness=0.0295,
        finger_tip_thickness=0.0105,
        finger_taper=0.05,
        finger_breadth=0.032,
        finger_tip_breadth=0.031,
        tip_offset=0.0198,
        palm_depth=0.125,
        palm_length=0.173,
        palm_breadth=0.075,
        palm_front_breadth=0.03,
        palm_taper=0.0225,
        hand_to_tcp=0.14391,
        linkage_length=0.055,
        linkage_offset=0.00898,
    ),
    min_force=30.0,
    max_force=30.0,
    max_payload=5.0,
    simulated=False,
)
