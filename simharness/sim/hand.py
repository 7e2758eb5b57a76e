"""The simulated Panda hand: a free body that a constraint carries, two fingers, one motor command.

It knows where its TCP is and how wide it is open; what a grasp attempt does with it is `execute.py`'s.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from simharness.sim.world import BASE_LINK, World, data_path
from tesnet.geometry import PANDA, Pose, quaternions_xyzw

MAX_WIDTH = PANDA.max_width
FINGER_BASE = 0.0584
"""Metres from the hand's base to where the fingers begin, along z."""

CLOSING_FORCE = 20.0
CLOSING_SPEED = 0.2
"""Effort (N) and speed (m/s) limit of one finger, from the Panda's URDF."""

GEAR_FORCE = 30.0
CARRY_FORCE = 300.0
PAD_FRICTION = 0.75
PAD_SPINNING_FRICTION = 0.05

HandPart = Literal["palm", "left finger", "right finger"]

PARKED = Pose(np.eye(3), np.array([0.15, 0.15, 10.0]))
"""Where the hand waits: far from everything and behind every camera."""


def hand_urdf(meshes: Path) -> str:
    """URDF text of the Panda hand: base `panda_hand`, prismatic fingers along +y and -y.

    The collision shapes are the convex hulls of the meshes. Inertias are far larger than the real ones, which keeps the
    carried hand steady and changes nothing for an object: what it feels is limited by the fingers' force.

    Args:
        meshes: folder with `visual/` and `collision/` meshes of hand and finger.
    """

    def link(name: str, mesh: str, mass: float, yaw: float) -> str:
        shapes = "".join(
            f"""
    <{shape}>
      <origin rpy="0 0 {yaw}" xyz="0 0 0"/>
      <geometry><mesh filename="{meshes / shape / mesh}.obj"/></geometry>
    </{shape}>"""
            for shape in ("visual", "collision")
        )
        return f"""
  <link name="{name}">
    <inertial>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <mass value="{mass}"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial>{shapes}
  </link>"""

    def joint(name: str, child: str, axis: str) -> str:
        return f"""
  <joint name="{name}" type="prismatic">
    <parent link="panda_hand"/>
    <child link="{child}"/>
    <origin rpy="0 0 0" xyz="0 0 {FINGER_BASE}"/>
    <axis xyz="{axis}"/>
    <limit effort="{CLOSING_FORCE}" lower="0.0" upper="{MAX_WIDTH / 2}" velocity="{CLOSING_SPEED}"/>
  </joint>"""

    return (
        '<?xml version="1.0"?>\n<robot name="panda_hand">'
        + link("panda_hand", "hand", 0.81, 0.0)
        + link("panda_leftfinger", "finger", 0.1, 0.0)
        + link("panda_rightfinger", "finger", 0.1, np.pi)
        + joint("panda_finger_joint1", "panda_leftfinger", "0 1 0")
        + joint("panda_finger_joint2", "panda_rightfinger", "0 -1 0")
        + "\n</robot>\n"
    )


@dataclass(frozen=True, slots=True)
class Placement:
    """A grasp as the simulator wants it.

    Args:
        position: of `panda_hand` in the world, metres.
        quaternion_xyzw: its orientation.
        z: its z axis in the world.
        width: opening, metres.
    """

    position: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    z: tuple[float, float, float]
    width: float

    def behind(self, distance: float) -> tuple[float, float, float]:
        """The position this far (metres) back along z."""
        (px, py, pz), (zx, zy, zz) = self.position, self.z
        return px - distance * zx, py - distance * zy, pz - distance * zz


def placements(Ts_world_grasp: Float64[np.ndarray, "grasps 4 4"], widths: Sequence[float]) -> list[Placement]:
    """TCP poses and openings (metres) as placements of the hand."""
    rotations, tcps = Ts_world_grasp[:, :3, :3], Ts_world_grasp[:, :3, 3]
    z = rotations[:, :, 2]
    rows = zip(
        (tcps - PANDA.hand_to_tcp * z).tolist(), quaternions_xyzw(rotations).tolist(), z.tolist(), widths, strict=True
    )
    return [
        Placement(tuple(position), tuple(quaternion_xyzw), tuple(axis), float(width))
        for position, quaternion_xyzw, axis, width in rows
    ]


@dataclass(frozen=True, slots=True)
class HandContact:
    """Where the hand touches something.

    Args:
        part: of the hand.
        body: id of what it touches.
        position: on that body's surface, metres in the world.
        depth: metres by which the surfaces overlap.
    """

    part: HandPart
    body: int
    position: tuple[float, float, float]
    depth: float


class Hand:
    """A resident Panda hand in a world; parked far away between uses."""

    def __init__(self, world: World) -> None:
        self._world = world
        with tempfile.TemporaryDirectory() as folder:
            urdf = Path(folder) / "panda_hand.urdf"
            urdf.write_text(hand_urdf(data_path() / "franka_panda" / "meshes"))
            self.body = world.load_urdf(urdf, PARKED)
        self.fingers = (world.joint(self.body, "panda_finger_joint1"), world.joint(self.body, "panda_finger_joint2"))
        for finger in self.fingers:
            world.set_dynamics(self.body, finger, lateralFriction=PAD_FRICTION, spinningFriction=PAD_SPINNING_FRICTION)
            world.set_dynamics(self.body, finger, jointDamping=0.0)
        for link in (BASE_LINK, *self.fingers):
            world.set_dynamics(self.body, link, linearDamping=0.0, angularDamping=0.0)
        self._hold = world.hold(self.body, force=CARRY_FORCE)
        world.mirror_joints(self.body, *self.fingers, axis=(0.0, 1.0, 0.0), force=GEAR_FORCE)
        self.park()

    def park(self) -> None:
        """Put the hand, open, where it touches nothing and no camera sees it."""
        self.place(PARKED.matrix, MAX_WIDTH)
        self.hold_open(MAX_WIDTH)

    def place(self, T_world_grasp: ArrayLike, width: float) -> None:
        """Put the hand at a grasp without physics: TCP pose (4, 4), opening in metres, everything at rest."""
        self.place_behind(placements(np.asarray(T_world_grasp)[None], [width])[0], 0.0)

    def place_behind(self, grasp: Placement, distance: float) -> None:
        """`place` the hand this far (metres) behind a grasp along its z."""
        position = grasp.behind(distance)
        self._world.set_pose(self.body, position, grasp.quaternion_xyzw)
        for finger in self.fingers:
            self._world.reset_joint(self.body, finger, grasp.width / 2)
        self._world.move_hold(self._hold, position, grasp.quaternion_xyzw)

    def carry_to(self, grasp: Placement, *, behind: float = 0.0, above: float = 0.0) -> None:
        """Ask the constraint to bring the hand to a place relative to a grasp (metres along its -z, and upwards)."""
        x, y, z = grasp.behind(behind)
        self._world.move_hold(self._hold, (x, y, z + above), grasp.quaternion_xyzw)

    def hold_open(self, width: float) -> None:
        """Let the motors keep an opening (metres)."""
        for finger in self.fingers:
            self._world.drive_joint_to(self.body, finger, width / 2, force=CLOSING_FORCE, speed=CLOSING_SPEED)

    def close(self) -> None:
        """Let the motors close the fingers and press."""
        for finger in self.fingers:
            self._world.drive_joint_at(self.body, finger, -CLOSING_SPEED, force=CLOSING_FORCE)

    @property
    def T_world_grasp(self) -> Pose:
        """Where the TCP is."""
        return self._world.pose(self.body) @ Pose(np.eye(3), np.array([0.0, 0.0, PANDA.hand_to_tcp]))

    @property
    def width(self) -> float:
        """Opening between the pads, metres."""
        return sum(self._world.joint_position(self.body, finger) for finger in self.fingers)

    @property
    def finger_speed(self) -> float:
        """Speed of the faster finger, m/s."""
        return max(abs(self._world.joint_speed(self.body, finger)) for finger in self.fingers)

    def touches_anything(self) -> bool:
        """Whether any part of the hand touches any other body, by the contacts found last."""
        return any(contact.other != self.body for contact in self._world.contacts(self.body))

    def deepest_contact(self) -> HandContact | None:
        """Where the hand overlaps another body most, by the contacts found last; None when it touches nothing."""
        contacts = [contact for contact in self._world.contacts(self.body) if contact.other != self.body]
        if not contacts:
            return None
        deepest = min(contacts, key=lambda contact: contact.distance)
        left, right = self.fingers
        parts: dict[int, HandPart] = {BASE_LINK: "palm", left: "left finger", right: "right finger"}
        return HandContact(parts[deepest.link], deepest.other, deepest.position, -deepest.distance)

    def touched(self, *, within: float) -> tuple[set[int], set[int]]:
        """Bodies touched by any part of the hand, and bodies touched by both fingers, by the contacts found last.

        Args:
            within: metres up to which two surfaces count as touching.
        """
        by_link: dict[int, set[int]] = {BASE_LINK: set(), self.fingers[0]: set(), self.fingers[1]: set()}
        for contact in self._world.contacts(self.body, within=within):
            if contact.other != self.body:
                by_link[contact.link].add(contact.other)
        left, right = by_link[self.fingers[0]], by_link[self.fingers[1]]
        return left | right | by_link[BASE_LINK], left & right
