"""A simulated hand: a free body that a constraint carries, two fingers, one motor command.

It knows where its TCP is and how wide it is open; what a grasp attempt does with it is `execute.py`'s.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from simharness.sim.world import BASE_LINK, TIMESTEP, World, data_path
from tesnet.geometry import PANDA, Extent, Gripper, Part, PartName, Pose, quaternions_xyzw
from tesnet.hands import HANDS, KnownHand

FRANKA = HANDS["franka"]
FINGER_BASE = 0.0584
"""Metres from the Franka hand's base to where its fingers begin, along z."""

LEAST_CLOSING_FORCE = 20.0
CLOSING_SPEED = 0.2
"""Effort (N) that a finger closes with at least, and speed limit (m/s) of one finger, from the Panda's URDF."""

GEAR_SHARE = 1.5
"""Force that keeps the fingers centred, in terms of that with which they close."""

CARRY_FORCE = 300.0
LIFT_FORCE = 300.0
PAD_FRICTION = 0.75
PAD_SPINNING_FRICTION = 0.05

MARGIN = 0.001
"""Metres by which Bullet rounds the hull of a mesh."""

HandPart = PartName

PARKED = Pose(np.eye(3), np.array([0.15, 0.15, 10.0]))
"""Where the hand waits: far from everything and behind every camera."""

_SLIDES, _SWINGS = ("left_slide", "right_slide"), ("left_swing", "right_swing")
"""Joints of both fingers: along y, and along z where the tips swing."""

# Far larger than the real one, which keeps the carried hand steady and changes nothing for an object: what it feels is
# limited by the fingers' force.
_INERTIA = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'


def write_urdf(hand: Gripper, folder: Path) -> Path:
    """A URDF of the hand, in a folder of its own: base link and two fingers that slide along +y and -y.

    The base link has the axes of the grasp frame. Fingers whose tips swing also slide along z, as `Hand` tells them.
    Collision shapes are convex hulls: of the published meshes for the Franka hand, else of the hand's parts, smaller by
    the margin that Bullet adds.
    """
    shapes = _panda_shapes() if hand == PANDA else _shapes_of_parts(hand, folder)
    swings = hand.linkage_length is not None
    (left, right), palm = shapes[:2], shapes[2]
    links = [_link("base", palm, 0.81)]
    for shape, slide, swing, sign in zip((left, right), _SLIDES, _SWINGS, ("1", "-1"), strict=True):
        finger = slide.replace("slide", "finger")
        carrier = slide.replace("slide", "carrier") if swings else finger
        start = FINGER_BASE if hand == PANDA else 0.0
        links.append(_joint(slide, "base", carrier, f"0 {sign} 0", start, (0.0, hand.max_width / 2)))
        if swings:
            links.append(_link(carrier, "", 0.1))
            links.append(_joint(swing, carrier, finger, "0 0 1", 0.0, (-0.2, 0.2)))
        links.append(_link(finger, shape, 0.1))
    urdf = folder / "hand.urdf"
    urdf.write_text('<?xml version="1.0"?>\n<robot name="hand">' + "".join(links) + "\n</robot>\n")
    return urdf


def _link(name: str, shapes: str, mass: float) -> str:
    return f"""
  <link name="{name}">
    <inertial>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <mass value="{mass}"/>
      {_INERTIA}
    </inertial>{shapes}
  </link>"""


def _joint(name: str, parent: str, child: str, axis: str, z: float, limits: tuple[float, float]) -> str:
    return f"""
  <joint name="{name}" type="prismatic">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin rpy="0 0 0" xyz="0 0 {z}"/>
    <axis xyz="{axis}"/>
    <limit effort="{LEAST_CLOSING_FORCE}" lower="{limits[0]}" upper="{limits[1]}" velocity="{CLOSING_SPEED}"/>
  </joint>"""


def _mesh(kind: str, mesh: Path, yaw: float = 0.0) -> str:
    return f"""
    <{kind}>
      <origin rpy="0 0 {yaw}" xyz="0 0 0"/>
      <geometry><mesh filename="{mesh}"/></geometry>
    </{kind}>"""


def _panda_shapes() -> tuple[str, str, str]:
    """Of left finger, right finger and palm: the published meshes, on which the Franka hand was measured."""
    meshes = data_path() / "franka_panda" / "meshes"

    def shapes(mesh: str, yaw: float) -> str:
        return "".join(_mesh(kind, meshes / kind / f"{mesh}.obj", yaw) for kind in ("visual", "collision"))

    return shapes("finger", 0.0), shapes("finger", np.pi), shapes("hand", 0.0)


def _shapes_of_parts(hand: Gripper, folder: Path) -> tuple[str, str, str]:
    """Of left finger, right finger and palm, from the base link of the hand with the fingers closed but not swung."""
    left, right, palm = hand.parts
    # In the grasp frame the part covers the palm at every opening; seen from the base link it stands still.
    written = []
    for number, part in enumerate((left, right, replace(palm, back=palm.back + hand.travel))):
        mesh = folder / f"part{number}.obj"
        mesh.write_text(_obj(_smaller(part), hand.hand_to_tcp))
        written.append(_mesh("collision", mesh))
    return written[0], written[1], written[2]


def _smaller(part: Part) -> Part:
    """The part without the margin that Bullet adds around it."""

    def less(extent: Extent) -> Extent:
        return replace(extent, full=extent.full - 2 * MARGIN, front=extent.front - 2 * MARGIN)

    tip_breadth = None if part.tip_breadth is None else part.tip_breadth - 2 * MARGIN
    return replace(
        part,
        front=part.front - MARGIN,
        back=part.back + MARGIN,
        breadth=less(part.breadth),
        thickness=less(part.thickness),
        tip_breadth=tip_breadth,
    )


def _obj(part: Part, z: float) -> str:
    """A mesh whose convex hull is the part of the closed hand, moved by `z`; pads begin a margin from the middle."""
    corners = part.corners(2 * MARGIN) + np.array([0.0, 0.0, z])
    vertices = [f"v {x:.6f} {y:.6f} {height:.6f}" for x, y, height in corners]
    around = ((1, 2, 6, 5), (3, 4, 8, 7), (1, 3, 7, 5), (2, 4, 8, 6))
    faces = [(1, 2, 4, 3), tuple(len(corners) - 4 + index for index in (1, 2, 4, 3))]
    faces += [tuple(4 * step + index for index in face) for step in range(len(part.sections) - 1) for face in around]
    return "\n".join(vertices + ["f " + " ".join(map(str, face)) for face in faces]) + "\n"


@dataclass(frozen=True, slots=True)
class Placement:
    """A grasp as the simulator wants it.

    Args:
        position: of the hand's base link in the world, metres.
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


def placements(
    Ts_world_grasp: Float64[np.ndarray, "grasps 4 4"], widths: Sequence[float], hand: Gripper = PANDA
) -> list[Placement]:
    """TCP poses and openings (metres) as placements of a hand."""
    rotations, tcps = Ts_world_grasp[:, :3, :3], Ts_world_grasp[:, :3, 3]
    z = rotations[:, :, 2]
    bases = tcps - np.reshape(hand.tcp_at(np.asarray(widths, dtype=np.float64)), (-1, 1)) * z
    rows = zip(bases.tolist(), quaternions_xyzw(rotations).tolist(), z.tolist(), widths, strict=True)
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
    """A resident hand in a world; parked far away between uses.

    Args:
        world: which.
        known: the hand; it closes with the least force that it can be told, but at least `LEAST_CLOSING_FORCE`.
    """

    def __init__(self, world: World, known: KnownHand = FRANKA) -> None:
        self._world = world
        self.gripper = known.gripper
        self.empty_width = 0.1 * self.gripper.max_width
        self._force = max(LEAST_CLOSING_FORCE, known.min_force)
        with tempfile.TemporaryDirectory() as folder:
            self.body = world.load_urdf(write_urdf(self.gripper, Path(folder)), PARKED)
        self.fingers = (world.joint(self.body, _SLIDES[0]), world.joint(self.body, _SLIDES[1]))
        self._swings: tuple[int, ...] = ()
        if self.gripper.linkage_length is not None:
            self._swings = tuple(world.joint(self.body, name) for name in _SWINGS)
        self._left, self._right = self._swings or self.fingers
        for finger in (self._left, self._right):
            world.set_dynamics(self.body, finger, lateralFriction=PAD_FRICTION, spinningFriction=PAD_SPINNING_FRICTION)
            world.set_dynamics(self.body, finger, jointDamping=0.0)
        for link in (BASE_LINK, *range(world.num_joints(self.body))):
            world.set_dynamics(self.body, link, linearDamping=0.0, angularDamping=0.0)
        self._hold = world.hold(self.body, force=CARRY_FORCE)
        world.mirror_joints(self.body, *self.fingers, axis=(0.0, 1.0, 0.0), force=GEAR_SHARE * self._force)
        if self._swings:
            world.before_every_step(self._swing)
        self.park()

    def _swing(self) -> None:
        """Let the tips follow their arc: along z to where the fingers' next place along y has them."""
        for slide, swing in zip(self.fingers, self._swings, strict=True):
            ahead = self._world.joint_position(self.body, slide)
            ahead += self._world.joint_speed(self.body, slide) * TIMESTEP
            distance = self._advance(2 * ahead) - self._world.joint_position(self.body, swing)
            self._world.drive_joint_at(self.body, swing, distance / TIMESTEP, force=LIFT_FORCE)

    def _advance(self, width: float) -> float:
        """Metres by which the tips are farther along z than those of the open hand."""
        allowed = min(max(width, 0.0), self.gripper.max_width)
        return float(self.gripper.tcp_at(allowed) - self.gripper.hand_to_tcp)

    def park(self) -> None:
        """Put the hand, open, where it touches nothing and no camera sees it."""
        self.place(PARKED.matrix, self.gripper.max_width)
        self.hold_open(self.gripper.max_width)

    def place(self, T_world_grasp: ArrayLike, width: float) -> None:
        """Put the hand at a grasp without physics: TCP pose (4, 4), opening in metres, everything at rest."""
        self.place_behind(placements(np.asarray(T_world_grasp)[None], [width], self.gripper)[0], 0.0)

    def place_behind(self, grasp: Placement, distance: float) -> None:
        """`place` the hand this far (metres) behind a grasp along its z."""
        position = grasp.behind(distance)
        self._world.set_pose(self.body, position, grasp.quaternion_xyzw)
        for finger in self.fingers:
            self._world.reset_joint(self.body, finger, grasp.width / 2)
        for swing in self._swings:
            self._world.reset_joint(self.body, swing, self._advance(grasp.width))
        self._world.move_hold(self._hold, position, grasp.quaternion_xyzw)

    def carry_to(self, grasp: Placement, *, behind: float = 0.0, above: float = 0.0) -> None:
        """Ask the constraint to bring the hand to a place relative to a grasp (metres along its -z, and upwards)."""
        x, y, z = grasp.behind(behind)
        self._world.move_hold(self._hold, (x, y, z + above), grasp.quaternion_xyzw)

    def hold_open(self, width: float) -> None:
        """Let the motors keep an opening (metres)."""
        for finger in self.fingers:
            self._world.drive_joint_to(self.body, finger, width / 2, force=self._force, speed=CLOSING_SPEED)

    def close(self) -> None:
        """Let the motors close the fingers and press."""
        for finger in self.fingers:
            self._world.drive_joint_at(self.body, finger, -CLOSING_SPEED, force=self._force)

    @property
    def T_world_grasp(self) -> Pose:
        """Where the TCP is."""
        tcp = np.array([0.0, 0.0, self.gripper.tcp_at(min(max(self.width, 0.0), self.gripper.max_width))])
        return self._world.pose(self.body) @ Pose(np.eye(3), tcp)

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
        left, right = self._left, self._right
        parts: dict[int, HandPart] = {BASE_LINK: "palm", left: "left finger", right: "right finger"}
        return HandContact(parts[deepest.link], deepest.other, deepest.position, -deepest.distance)

    def touched(self, *, within: float) -> tuple[set[int], set[int]]:
        """Bodies touched by any part of the hand, and bodies touched by both fingers, by the contacts found last.

        Args:
            within: metres up to which two surfaces count as touching.
        """
        by_link: dict[int, set[int]] = {BASE_LINK: set(), self._left: set(), self._right: set()}
        for contact in self._world.contacts(self.body, within=within):
            if contact.other != self.body:
                by_link[contact.link].add(contact.other)
        left, right = by_link[self._left], by_link[self._right]
        return left | right | by_link[BASE_LINK], left & right
