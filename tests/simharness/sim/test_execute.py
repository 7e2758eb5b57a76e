"""Attempts: every outcome in a scene made for it, both executors, labels that agree with attempts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from simharness.sim import execute
from simharness.sim.execute import (
    RETREAT_DISTANCE,
    Executor,
    Grip,
    Outcome,
    attempt,
    label_candidates,
    label_strict,
    snapshot_of,
)
from simharness.sim.hand import Hand, HandContact, Placement
from simharness.sim.objects import ObjectModel
from simharness.sim.scene import TABLE_HEIGHT, restore_scene, settle
from simharness.sim.world import BASE_LINK, World, data_path
from tesnet.geometry import PANDA, Pose
from tesnet.hands import HANDS, KnownHand

pytestmark = pytest.mark.sim

CUBE = ObjectModel("cube", data_path() / "cube_small.urdf")
SIDE = 0.04
MIDDLE = (0.15, 0.15)

Place = tuple[float, float]


def scene(world: World, *places: Place, known: KnownHand = HANDS["franka"]) -> tuple[Hand, tuple[int, ...]]:
    """Cubes of 4 cm on the table, settled, and the hand."""
    items = [
        {
            "name": "cube",
            "scale": SIDE / 0.05,
            "position": [x, y, TABLE_HEIGHT + SIDE / 2],
            "quaternion_xyzw": [0, 0, 0, 1],
        }
        for x, y in places
    ]
    restored = restore_scene(world, {"kind": "packed", "objects": items}, {"cube": CUBE})
    hand = Hand(world, known)
    assert settle(world) == ()
    return hand, tuple(item.body_id for item in restored.placed)


def from_above(x: float = 0.15, y: float = 0.15, z: float = TABLE_HEIGHT + 0.025) -> NDArray[np.float64]:
    """A top-down grasp that closes along y."""
    return np.array([[1.0, 0, 0, x], [0, -1.0, 0, y], [0, 0, -1.0, z], [0, 0, 0, 1.0]])


def from_the_side(z: float = TABLE_HEIGHT + 0.025, downwards_deg: float = 10.0) -> NDArray[np.float64]:
    """A grasp of the middle that travels along +x, a little downwards, and closes along y."""
    angle = np.deg2rad(downwards_deg)
    travel = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross([0.0, 1.0, 0.0], travel), [0.0, 1.0, 0.0], travel], axis=1)
    matrix[:3, 3] = [0.15, 0.15, z]
    return matrix


@pytest.mark.parametrize("executor", ["strict", "edge"])
def test_a_good_grasp_lifts_and_removes_the_object(executor: str) -> None:
    with World() as world:
        hand, (cube, other) = scene(world, MIDDLE, (0.15, 0.25))
        outcome = attempt(world, hand, from_above(), PANDA.max_width, "strict" if executor == "strict" else "edge")
        assert outcome == Outcome("success", (cube,), contact_at_start=False, contact_on_way=False)
        assert world.objects == (other,)


@pytest.mark.parametrize("name", ["robotiq_2f85", "robotiq_2f140", "hand_e", "rg2"])
def test_other_hands_lift_the_object_too(name: str) -> None:
    known = HANDS[name]
    gripper = known.gripper
    travel = gripper.tcp_at(SIDE) - gripper.hand_to_tcp
    with World() as world:
        hand, (cube,) = scene(world, MIDDLE, known=known)
        # The tips come to lie 6 mm over the table once they have closed.
        grasp = from_above(z=TABLE_HEIGHT + 0.006 + gripper.tip_offset + travel)
        outcome = attempt(world, hand, grasp, gripper.max_width, "strict")
        assert outcome == Outcome("success", (cube,), contact_at_start=False, contact_on_way=False)


def test_a_contact_at_the_start_pose_is_noticed_by_the_strict_executor_only() -> None:
    # A tall neighbour: a cube hangs where the palm appears.
    def run(executor: str) -> Outcome:
        with World() as world:
            hand, _ = scene(world, MIDDLE)
            world.add_static_box((0.02, 0.02, 0.02), (0.15, 0.2, 0.26), colour=(1.0, 1.0, 1.0, 1.0))
            return attempt(world, hand, from_above(), PANDA.max_width, "strict" if executor == "strict" else "edge")

    strict, edge = run("strict"), run("edge")
    assert strict.kind == "pregrasp"
    assert strict.contact_at_start
    assert edge.kind != "pregrasp"
    assert edge.contact_at_start
    assert strict.first_contact is not None
    assert edge.first_contact == strict.first_contact


def test_a_contact_on_the_way_fails_under_strict_and_pushes_under_edge() -> None:
    # The left finger comes down onto the edge of a neighbour.
    with World() as world:
        hand, cubes = scene(world, MIDDLE, (0.15, 0.215))
        outcome = attempt(world, hand, from_above(), PANDA.max_width, "strict")
        assert outcome == Outcome("approach", (), contact_at_start=False, contact_on_way=True)
        assert world.objects == cubes
    with World() as world:
        hand, _ = scene(world, MIDDLE, (0.15, 0.215))
        outcome = attempt(world, hand, from_above(), PANDA.max_width, "edge")
        assert outcome.contact_on_way
        assert outcome.kind in ("success", "slip", "drop")


@pytest.mark.parametrize(("executor", "goes_on"), [("strict", False), ("edge", True)])
def test_a_hand_that_touches_something_on_its_way_goes_on_to_the_grasp_under_edge_alone(
    executor: Executor, goes_on: bool
) -> None:
    # One fingertip meets a neighbour 4 cm before the grasp and takes it along, if the hand goes on.
    with World() as world:
        hand, (_, neighbour) = scene(world, MIDDLE, (0.138, 0.205))
        before = world.position(neighbour)[0]
        outcome = attempt(world, hand, from_the_side(TABLE_HEIGHT + 0.04), PANDA.max_width, executor)
        assert not outcome.contact_at_start
        assert outcome.contact_on_way
        pushed = world.position(neighbour)[0] - before
    assert (pushed > 0.03) if goes_on else (abs(pushed) < 0.01)


def test_the_table_counts_as_a_contact_on_the_way() -> None:
    with World() as world:
        hand, _ = scene(world, MIDDLE)
        assert attempt(world, hand, from_above(z=TABLE_HEIGHT + 0.004), PANDA.max_width, "strict").kind == "approach"


def test_closing_beside_everything_is_a_slip() -> None:
    with World() as world:
        hand, cubes = scene(world, MIDDLE)
        outcome = attempt(world, hand, from_above(x=0.25), PANDA.max_width, "strict")
        assert outcome == Outcome("slip", (), contact_at_start=False, contact_on_way=False)
        assert world.objects == cubes


def test_an_object_too_heavy_to_lift_is_dropped() -> None:
    with World() as world:
        hand, (cube,) = scene(world, MIDDLE)
        world.set_dynamics(cube, BASE_LINK, mass=20.0)
        settle(world)
        assert attempt(world, hand, from_above(), PANDA.max_width, "strict").kind == "drop"
        assert world.objects == (cube,)


def test_a_hand_that_comes_from_the_side_lifts_straight_up() -> None:
    # Backwards along z, the cube would be dragged into the block behind the hand's fingers, and stay on the table.
    with World() as world:
        hand, (cube,) = scene(world, MIDDLE)
        outcome = attempt(world, hand, from_the_side(TABLE_HEIGHT + 0.045), PANDA.max_width, "strict")
        assert outcome == Outcome("success", (cube,), contact_at_start=False, contact_on_way=False)


def candidates(seed: int, count: int) -> NDArray[np.float64]:
    """Random grasps around the scene's cubes: down to 45 deg off vertical."""
    rng = np.random.default_rng(seed)
    matrices = []
    for _ in range(count):
        tilt, azimuth, roll = rng.uniform(0, np.pi / 4), *rng.uniform(0, 2 * np.pi, size=2)
        z = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        x = np.cross([-np.sin(azimuth), np.cos(azimuth), 0.0], z)
        y = np.cross(z, x)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 2] = np.cos(roll) * x + np.sin(roll) * y, z
        matrix[:3, 1] = np.cross(z, matrix[:3, 0])
        matrix[:3, 3] = rng.uniform([0.13, 0.13, TABLE_HEIGHT + 0.015], [0.17, 0.2, TABLE_HEIGHT + 0.06])
        matrices.append(matrix)
    return np.array(matrices)


PAIR: Sequence[Place] = (MIDDLE, (0.15, 0.22))


def test_labels_agree_with_attempts_and_do_not_depend_on_their_order() -> None:
    grasps = candidates(0, 12)
    widths = np.full(len(grasps), PANDA.max_width)
    with World() as world:
        hand, cubes = scene(world, *PAIR)
        with snapshot_of(world) as snapshot:
            before = [world.position(cube) for cube in cubes]
            labels = label_strict(world, hand, grasps, widths, snapshot)
            assert [world.position(cube) for cube in cubes] == before
            assert label_strict(world, hand, grasps[::-1], widths, snapshot) == labels[::-1]
    assert len(set(labels)) >= 3
    outcomes = []
    for grasp in grasps:
        with World() as world:
            hand, _ = scene(world, *PAIR)
            outcomes.append(attempt(world, hand, grasp, PANDA.max_width, "strict").kind)
    agreement = np.mean([label == outcome for label, outcome in zip(labels, outcomes, strict=True)])
    assert agreement > 0.9


def test_labels_for_the_edge_executor_are_paid_for_on_request() -> None:
    grasps = candidates(1, 4)
    widths = np.full(len(grasps), PANDA.max_width)
    with World() as world:
        hand, _ = scene(world, *PAIR)
        with snapshot_of(world) as snapshot:
            plain = label_candidates(world, hand, grasps, widths, snapshot, edge=False)
            both = label_candidates(world, hand, grasps, widths, snapshot, edge=True)
    assert all(labels.edge is None for labels in plain)
    assert [labels.strict for labels in plain] == [labels.strict for labels in both]
    assert all(labels.edge in ("success", "slip", "drop") for labels in both)


def test_the_same_attempts_end_the_same_to_the_bit_in_a_fresh_world() -> None:
    def run() -> list[object]:
        with World() as world:
            hand, _ = scene(world, *PAIR, (0.1, 0.1))
            record: list[object] = []
            for grasp in candidates(2, 2):
                record.append(attempt(world, hand, grasp, PANDA.max_width, "edge"))
                record += [world.pose(body).matrix.tobytes() for body in world.objects]
            return record

    assert run() == run()


def test_strict_holds_what_both_fingers_touch_and_edge_what_any_part_touches() -> None:
    one, two = frozenset({1}), frozenset({1, 2})
    assert Grip(two, one, empty=False).held("strict") == one
    assert Grip(two, one, empty=False).held("edge") == two
    for executor in ("strict", "edge"):
        assert Grip(two, one, empty=True).held("strict" if executor == "strict" else "edge") == frozenset()


def test_an_object_at_one_finger_alone_is_lifted_by_edge_and_slips_from_strict() -> None:
    # A cube stands between the fingers; a post that nothing moves keeps one finger from it.
    def run(executor: Executor) -> Outcome:
        with World() as world:
            hand, _ = scene(world, (0.15, 0.165))
            world.add_static_box((0.005, 0.004, 0.02), (0.15, 0.138, TABLE_HEIGHT + 0.02), colour=(1.0, 1.0, 1.0, 1.0))
            return attempt(world, hand, from_above(), PANDA.max_width, executor)

    strict, edge = run("strict"), run("edge")
    assert strict.closed is not None
    assert strict.closed.touched
    assert not strict.closed.pinched
    assert strict.kind == "slip"
    assert edge.closed == strict.closed
    assert edge.kind != "slip"


@pytest.mark.parametrize(("from_down_deg", "upwards"), [(50.0, False), (59.0, False), (61.0, True), (75.0, True)])
def test_hands_retreat_backwards_up_to_60_deg_from_straight_down_and_upwards_beyond(
    from_down_deg: float, upwards: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[float, float]] = []
    carry_to = Hand.carry_to

    def told(self: Hand, grasp: Placement, *, behind: float = 0.0, above: float = 0.0) -> None:
        asked.append((behind, above))
        carry_to(self, grasp, behind=behind, above=above)

    with World() as world:
        hand, _ = scene(world, MIDDLE)
        monkeypatch.setattr(Hand, "carry_to", told)
        outcome = attempt(
            world, hand, from_the_side(TABLE_HEIGHT + 0.04, 90.0 - from_down_deg), PANDA.max_width, "edge"
        )
    assert outcome.closed is not None
    assert outcome.closed.touched
    assert asked[-1] == pytest.approx((0.0, RETREAT_DISTANCE) if upwards else (RETREAT_DISTANCE, 0.0))


def test_the_first_contact_is_told_whether_or_not_the_hand_goes_on() -> None:
    def run(executor: Executor) -> Outcome:
        with World() as world:
            hand, _ = scene(world, MIDDLE, (0.15, 0.215))
            return attempt(world, hand, from_above(), PANDA.max_width, executor)

    strict, edge = run("strict"), run("edge")
    assert strict.first_contact is not None
    assert edge.first_contact == strict.first_contact


def test_the_hand_is_far_away_after_an_attempt() -> None:
    with World() as world:
        hand, _ = scene(world, MIDDLE)
        attempt(world, hand, from_above(), PANDA.max_width, "strict")
        assert np.linalg.norm(hand.T_world_grasp.translation - [0.15, 0.15, TABLE_HEIGHT]) > 0.5
        assert hand.width == pytest.approx(PANDA.max_width, abs=1e-3)


@pytest.mark.parametrize(("thickness", "empty"), [(0.012, False), (0.004, True)])
def test_fingers_hold_nothing_when_they_all_but_meet(thickness: float, empty: bool) -> None:
    with World() as world:
        hand, _ = scene(world)
        world.add_static_box((0.02, thickness / 2, 0.03), (0.15, 0.15, TABLE_HEIGHT + 0.03), colour=(1, 1, 1, 1))
        outcome = attempt(world, hand, from_above(z=TABLE_HEIGHT + 0.04), PANDA.max_width, "strict")
        assert outcome.closed is not None
        assert outcome.closed.empty is empty


BESIDE_A_FINGER, UNDER_THE_CUBE = (0.15, 0.15 + SIDE / 2 + 0.024, 0.4), (0.15, 0.15, 0.4 - SIDE / 2 - 0.0095)


@pytest.mark.parametrize(
    ("blocks", "hangs"), [([], True), ([BESIDE_A_FINGER], False), ([UNDER_THE_CUBE], False), ([(0.3, 0.3, 0.4)], True)]
)
def test_a_thing_hangs_where_it_alone_is_touched_and_touches_the_hand_alone(
    blocks: list[tuple[float, float, float]], hangs: bool
) -> None:
    """Only then does nothing change any more, and the rest of a retreat need not be waited for."""
    with World() as world:
        hand, (cube,) = scene(world, MIDDLE)
        world.set_pose(cube, (*MIDDLE, 0.4), (0.0, 0.0, 0.0, 1.0))
        for place in blocks:
            world.add_static_box((0.01, 0.01, 0.01), place, colour=(1.0, 1.0, 1.0, 1.0))
        hand.place(from_above(z=0.4), SIDE)
        world.find_contacts()
        found = execute._hanging(world, hand)
        assert list(found) == ([cube] if hangs else [])
        for pose in found.values():
            np.testing.assert_allclose(pose.translation, 0.0, atol=1e-6)


@pytest.mark.parametrize("moved", [0.0, 0.00015, 0.00025])
@pytest.mark.parametrize("turned_deg", [0.0, 0.25, 0.35])
def test_a_thing_is_still_where_it_neither_moves_nor_turns(moved: float, turned_deg: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        before, axis, direction = Pose.random(rng, reach=0.1), rng.normal(size=3), rng.normal(size=3)
        half = np.deg2rad(turned_deg) / 2
        turn = Pose.from_quaternion([*np.sin(half) * axis / np.linalg.norm(axis), np.cos(half)], np.zeros(3))
        shift = moved * direction / np.linalg.norm(direction)
        now = Pose(turn.rotation @ before.rotation, before.translation + shift)
        assert execute._still(before, now) == (moved < 0.0002 and turned_deg < 0.3)


@pytest.mark.parametrize("touches", [(True, True), (True, False), (False, True), (False, False)])
def test_of_a_contact_at_the_start_and_one_on_the_way_the_first_is_told(touches: tuple[bool, bool]) -> None:
    start = HandContact("left finger", 1, (0.1, 0.1, 0.1), 0.001) if touches[0] else None
    way = HandContact("right finger", 1, (0.1, 0.2, 0.1), 0.002) if touches[1] else None
    with World() as world:
        hand, _ = scene(world, MIDDLE)
        outcome = execute._finish(world, hand, "slip", start, way)
    assert (outcome.contact_at_start, outcome.contact_on_way) == touches
    assert outcome.first_contact == (start if touches[0] else way)
