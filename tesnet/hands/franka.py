"""The Franka Hand; every default of `Gripper` is its size.

Measured on the convex hulls of the collision meshes in franka_description (commit b299b39), which are those that
pybullet carries as `franka_panda`. The TCP and the opening are written in `franka_hand.xacro`. The body is 1.8 mm
off the middle along y, so that 2.0 mm of one end of it lie outside of the palm. Base link: `panda_hand`.
Force: 20 N is the finger joints' effort in the older files, with which the simulated fingers close; the hand's
manual allows 30 to 70 N of continuous force. The payload is the arm's.
"""

from __future__ import annotations

from tesnet.geometry import PANDA
from tesnet.hands.entry import KnownHand

HAND = KnownHand(
    gripper=PANDA,
    min_force=20.0,
    max_force=70.0,
    max_payload=3.0,
    simulated=True,
)
