"""The hand: where its parts are, what it holds."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from simharness.sim.hand import FINGER_BASE, Hand, write_urdf
from simharness.sim.world import World, data_path
from tesnet.geometry import PANDA, Pose
from tesnet.hands import HANDS

pytestmark = pytest.mark.sim

DOWN = np.diag([1.0, -1.0, -1.0])
MARGIN = 0.001
"""Metres by which Bullet rounds the hull of a mesh."""


@pytest.fixture
def world() -> Iterator[World]:
    """Nothing but gravity."""
    with World() as world:
        yield world


def grasp(x: float, y: float, z: float) -> Pose:
    return Pose(DOWN, np.array([x, y, z]))


def test_the_hand_is_placed_by_its_tcp(world: World) -> None:
    hand = Hand(world)
    wanted = Pose.from_quaternion([0.3, 0.8, -0.2, 0.4], [0.1, 0.2, 0.3])
    hand.place(wanted.matrix, 0.05)
    np.testing.assert_allclose(hand.T_world_grasp.matrix, wanted.matrix, atol=1e-9)
    assert hand.width == pytest.approx(0.05)
    base = world.pose(hand.body)
    np.testing.assert_allclose(base.translation, wanted.apply([0.0, 0.0, -PANDA.hand_to_tcp]), atol=1e-9)


def test_the_fingertips_are_112_mm_from_the_hands_base(world: World) -> None:
    floor = world.add_static_box((0.5, 0.5, 0.05), (0.0, 0.0, -0.05), colour=(1.0, 1.0, 1.0, 1.0))
    hand = Hand(world)
    hand.place(grasp(0.0, 0.0, 0.1).matrix, PANDA.max_width)
    gap = world.distance(hand.body, floor, limit=0.2)
    assert gap is not None
    base_height = 0.1 + PANDA.hand_to_tcp
    assert base_height - gap == pytest.approx(0.112 + MARGIN, abs=0.0005)


@pytest.mark.parametrize("width", [0.08, 0.0])
def test_the_published_meshes_are_the_hands_parts(width: float) -> None:
    """Its sizes were measured on these meshes; its body is 1.8 mm off the middle along y."""
    meshes = data_path() / "franka_panda" / "meshes" / "collision"
    palm, finger = (_vertices(meshes / f"{name}.obj") for name in ("hand", "finger"))
    finger += [0.0, 0.0, FINGER_BASE]
    opened = width / 2 * np.array([0.0, 1.0, 0.0])
    solids = (finger + opened, finger * [-1, -1, 1] - opened, palm)
    for part, solid in zip(PANDA.parts, solids, strict=True):
        planes = ConvexHull(part.corners(width)).equations
        # The finger's root reaches into the palm, which covers it.
        in_reach = solid[solid[:, 2] - PANDA.hand_to_tcp > part.back] - [0.0, 0.0, PANDA.hand_to_tcp]
        outside = (in_reach @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        assert outside.max() < 0.0021
        # And no part is much larger than its mesh.
        assert np.abs(in_reach.max(axis=0) - part.corners(width).max(axis=0)).max() < 0.006


def _vertices(path: Path) -> NDArray[np.float64]:
    rows = [line.split()[1:4] for line in path.read_text().splitlines() if line.startswith("v ")]
    return np.array(rows, dtype=np.float64)


@pytest.mark.parametrize("width", [0.08, 0.04])
def test_the_pads_stand_half_the_width_to_either_side_along_y(world: World, width: float) -> None:
    hand = Hand(world)
    for side in (1, -1):
        # A thin plate across the closing direction between the pads, 2 mm inside of one of them.
        plate = world.add_static_box(
            (0.005, 0.0005, 0.005), (0.0, side * (width / 2 - 0.0025), 0.0), colour=(1, 1, 1, 1)
        )
        hand.place(grasp(0.0, 0.0, 0.0).matrix, width)
        gap = world.distance(hand.body, plate, limit=0.1)
        assert gap == pytest.approx(0.002 - MARGIN, abs=0.0005)
        world.remove(plate)


@pytest.mark.parametrize("thickness", [0.02, 0.05])
def test_closing_on_a_box_leaves_its_thickness_as_opening(world: World, thickness: float) -> None:
    world.add_static_box((0.03, thickness / 2, 0.03), (0.0, 0.0, 0.0), colour=(1.0, 1.0, 1.0, 1.0))
    hand = Hand(world)
    hand.place(grasp(0.0, 0.0, 0.02).matrix, PANDA.max_width)
    world.find_contacts()
    assert not hand.touches_anything()
    hand.close()
    world.step(120)
    assert hand.width == pytest.approx(thickness + 2 * MARGIN, abs=0.0005)
    assert hand.finger_speed < 0.002


def test_a_hand_that_closes_on_nothing_meets_itself_only(world: World) -> None:
    hand = Hand(world)
    hand.place(grasp(0.0, 0.0, 0.3).matrix, PANDA.max_width)
    hand.close()
    world.step(120)
    assert hand.width == pytest.approx(0.0, abs=0.001)
    assert hand.touched(within=0.001) == (set(), set())


def test_the_constraint_carries_the_hand_and_gravity_does_not(world: World) -> None:
    hand = Hand(world)
    start = grasp(0.1, 0.1, 0.3)
    hand.place(start.matrix, PANDA.max_width)
    hand.hold_open(PANDA.max_width)
    world.step(120)
    np.testing.assert_allclose(hand.T_world_grasp.matrix, start.matrix, atol=1e-4)
    assert hand.width == pytest.approx(PANDA.max_width, abs=1e-4)


@pytest.mark.parametrize("deep", [0, 1])
def test_the_deepest_contact_is_the_deepest_whichever_was_found_first(world: World, deep: int) -> None:
    hand = Hand(world)
    hand.place(grasp(0.0, 0.0, 0.2).matrix, PANDA.max_width)  # turned over, so that its left finger is at negative y
    tip = 0.2 - 0.112 + PANDA.hand_to_tcp
    depths = [0.006 if finger == deep else 0.002 for finger in (0, 1)]
    plates = [
        world.add_static_box((0.01, 0.01, 0.01), (0.0, side * 0.045, tip + depth - 0.01), colour=(1, 1, 1, 1))
        for side, depth in zip((-1, 1), depths, strict=True)
    ]
    world.find_contacts()
    found = hand.deepest_contact()
    assert found is not None
    assert (found.body, found.part) == (plates[deep], ("left finger", "right finger")[deep])
    assert found.depth == max(-contact.distance for contact in world.contacts(hand.body) if contact.other != hand.body)
    assert found.depth > 0.004


def test_a_finger_that_moves_is_not_overlooked_for_one_that_stands(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = Hand(world)
    for speeds in ((0.0, -0.05), (0.05, 0.0)):
        now = dict(zip(hand.fingers, speeds, strict=True))
        monkeypatch.setattr(World, "joint_speed", lambda _world, _body, joint, now=now: now[joint])
        assert hand.finger_speed == 0.05


def test_what_the_palm_alone_touches_is_touched_and_not_pinched(world: World) -> None:
    hand = Hand(world)
    hand.place(grasp(0.0, 0.0, 0.2).matrix, PANDA.max_width)
    palm = 0.2 + PANDA.hand_to_tcp - 0.03
    block = world.add_static_box((0.01, 0.01, 0.01), (0.0, 0.0, palm), colour=(1, 1, 1, 1))
    world.find_contacts()
    assert hand.touched(within=0.0) == ({block}, set())


# Other hands

OTHERS = tuple(name for name in HANDS if name != "franka")
SWINGING = tuple(name for name, hand in HANDS.items() if hand.gripper.linkage_length)
WHITE = (1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize("name", OTHERS)
def test_the_solid_of_a_hand_is_that_of_its_parts(world: World, name: str) -> None:
    """Small boxes 10 mm before its tips, inside of a pad and beside its palm are so far away."""
    hand, gripper = Hand(world, HANDS[name]), HANDS[name].gripper
    hand.place(grasp(0.0, 0.0, 0.3).matrix, gripper.max_width)
    palm, tips = gripper.parts[2], 0.3 - gripper.tip_offset
    places = {
        "before the tips": (0.0, gripper.max_width / 2 + 0.003, tips - 0.011),
        "inside of a pad": (0.0, gripper.max_width / 2 - 0.011, tips + 0.01),
        "beside the palm": (0.0, palm.thickness.full / 2 + 0.011, 0.3 - palm.front + 0.015),
    }
    for position in places.values():
        box = world.add_static_box((0.001, 0.001, 0.001), position, colour=WHITE)
        assert world.distance(hand.body, box, limit=0.05) == pytest.approx(0.010, abs=0.0006)
        world.remove(box)


@pytest.mark.parametrize("name", OTHERS)
def test_each_mesh_is_its_part_of_the_closed_hand_without_the_margin_that_is_added(tmp_path: Path, name: str) -> None:
    """A margin less on every side; the palm ends where it does as the hand is open, seen from the base link."""
    gripper = HANDS[name].gripper
    write_urdf(gripper, tmp_path)
    for number, part in enumerate(gripper.parts):
        found = _vertices(tmp_path / f"part{number}.obj") - [0.0, 0.0, gripper.hand_to_tcp]
        least, most = part.corners(0.0).min(axis=0) + MARGIN, part.corners(0.0).max(axis=0) - MARGIN
        if part.side:  # shorter by two margins, it may not grow to all of its thickness
            outer = part.thickness.at(part.front - part.back - 2 * MARGIN) - MARGIN
            least[1], most[1] = sorted((part.side * MARGIN, part.side * outer))
        else:
            least[2] += gripper.travel
        np.testing.assert_allclose(found.min(axis=0), least, atol=1.5e-6)
        np.testing.assert_allclose(found.max(axis=0), most, atol=1.5e-6)
        tip = np.abs(found[found[:, 2] > most[2] - 1e-5])
        breadth = part.breadth.front if part.tip_breadth is None else part.tip_breadth
        thickness = part.thickness.front if part.side else part.thickness.front / 2
        np.testing.assert_allclose(tip.max(axis=0)[:2], [breadth / 2 - MARGIN, thickness - MARGIN], atol=1.5e-6)


@pytest.mark.parametrize("name", HANDS)
def test_the_joints_of_a_hand_are_those_that_its_fingers_have(tmp_path: Path, name: str) -> None:
    gripper = HANDS[name].gripper
    joints = {joint.get("name"): joint for joint in ET.parse(write_urdf(gripper, tmp_path)).getroot().iter("joint")}
    assert set(joints) == {
        *("left_slide", "right_slide"),
        *(("left_swing", "right_swing") if gripper.linkage_length else ()),
    }
    for joint_name, joint in joints.items():
        limit, axis, origin = (joint.find(tag) for tag in ("limit", "axis", "origin"))
        assert limit is not None
        assert axis is not None
        assert origin is not None
        slides = str(joint_name).endswith("slide")
        limits = (float(limit.get("lower", "nan")), float(limit.get("upper", "nan")))
        assert limits == ((0.0, gripper.max_width / 2) if slides else (-0.2, 0.2))
        assert (limit.get("effort"), limit.get("velocity")) == ("20.0", "0.2")
        sign = "-1" if str(joint_name).startswith("right") else "1"
        assert axis.get("xyz") == (f"0 {sign} 0" if slides else "0 0 1")
        assert origin.get("xyz") == f"0 0 {FINGER_BASE if name == 'franka' else 0.0}"


@pytest.mark.parametrize("name", SWINGING)
def test_a_fingertip_follows_its_arc_as_the_hand_closes_on_nothing(world: World, name: str) -> None:
    hand, gripper = Hand(world, HANDS[name]), HANDS[name].gripper
    floor = world.add_static_box((0.5, 0.5, 0.05), (0.0, 0.0, 0.2), colour=WHITE)
    hand.place(grasp(0.0, 0.0, 0.35).matrix, gripper.max_width)
    base = world.pose(hand.body)
    assert gripper.linkage_length is not None
    open_rise = np.sqrt(gripper.linkage_length**2 - (gripper.max_width / 2 - gripper.linkage_offset) ** 2)
    hand.close()
    widths, errors = [], []
    for _ in range(40):
        world.step(3)
        rise = np.sqrt(gripper.linkage_length**2 - (hand.width / 2 - gripper.linkage_offset) ** 2)
        gap = world.distance(hand.body, floor, limit=0.2)
        assert gap is not None
        widths.append(hand.width)
        errors.append(0.1 - gripper.tip_offset - gap - (rise - open_rise))
    assert widths[0] > 0.9 * gripper.max_width
    assert widths[-1] < 0.001
    assert np.abs(errors).max() < 0.001
    np.testing.assert_allclose(world.pose(hand.body).matrix, base.matrix, atol=1e-4)


@pytest.mark.parametrize("name", OTHERS)
def test_a_hand_closes_on_a_box_with_parallel_pads_and_presses(world: World, name: str) -> None:
    thickness = 0.03
    world.add_static_box((0.03, thickness / 2, 0.03), (0.0, 0.0, 0.0), colour=WHITE)
    hand, gripper = Hand(world, HANDS[name]), HANDS[name].gripper
    travel = gripper.tcp_at(thickness) - gripper.hand_to_tcp
    hand.place(grasp(0.0, 0.0, 0.02 + travel).matrix, gripper.max_width)
    world.find_contacts()
    assert not hand.touches_anything()
    hand.close()
    world.step(150)
    assert hand.width == pytest.approx(thickness, abs=0.001)
    assert hand.finger_speed < 0.002
    np.testing.assert_allclose(hand.T_world_grasp.translation, [0.0, 0.0, 0.02], atol=0.0015)


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_any_hand_is_placed_by_its_tcp_however_wide_it_is(world: World, name: str, share: float) -> None:
    """Tips that swing are farther from the base link as they close, and that stands so much farther back."""
    gripper = HANDS[name].gripper
    hand, width = Hand(world, HANDS[name]), share * gripper.max_width
    wanted = Pose.from_quaternion([0.3, 0.8, -0.2, 0.4], [0.1, 0.2, 0.3])
    hand.place(wanted.matrix, width)
    np.testing.assert_allclose(hand.T_world_grasp.matrix, wanted.matrix, atol=1e-9)
    base = wanted.apply([0.0, 0.0, -float(gripper.tcp_at(width))])
    np.testing.assert_allclose(world.pose(hand.body).translation, base, atol=1e-9)


@pytest.mark.parametrize("name", HANDS)
def test_no_hand_closes_with_less_than_the_least_force_that_it_can_be_told(world: World, name: str) -> None:
    known = HANDS[name]
    assert max(20.0, known.min_force) == Hand(world, known)._force <= max(20.0, known.max_force)
