"""Known hands against what was measured of them, and those whose tips swing against a twin of their arc."""

from __future__ import annotations

import dataclasses
import importlib
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from tesnet import candidates, collision
from tesnet.geometry import PANDA, WIDEST, GraspSet, Gripper, Pose
from tesnet.hands import HANDS
from tests.tesnet.scenes import bare_cloud

NAMES = tuple(HANDS)
ARCS = tuple(name for name, hand in HANDS.items() if hand.gripper.linkage_length)

BASE_TO_TCP = {
    "robotiq_2f85": {0.085: 0.1306, 0.04: 0.1425, 0.0: 0.1441},
    "robotiq_2f140": {0.128: 0.1770, 0.04: 0.1986, 0.0: 0.2007},
    "xarm": {0.085: 0.1439, 0.04: 0.1542, 0.0: 0.1546},
    "rg2": {0.1041: 0.1752, 0.04: 0.2143, 0.0: 0.2188},
    "rg6": {0.1514: 0.2096, 0.04: 0.2625, 0.0: 0.2652},
    "ag95": {0.0952: 0.1674, 0.04: 0.1826, 0.0: 0.1831},
    "franka": {0.08: 0.1034, 0.0: 0.1034},
    "wsg50": {0.11: 0.1444, 0.0: 0.1444},
    "hand_e": {0.05: 0.135, 0.0: 0.135},
}
"""Metres from the base link to the TCP by opening, by forward kinematics on the published descriptions."""


def from_base(hand: Gripper, width: float) -> float:
    """The closed form, written out again: A + sqrt(L^2 - (w / 2 - B)^2) - tip_offset."""
    if hand.linkage_length is None:
        return hand.hand_to_tcp
    a = hand.hand_to_tcp - math.sqrt(hand.linkage_length**2 - (hand.max_width / 2 - hand.linkage_offset) ** 2)
    return a + math.sqrt(hand.linkage_length**2 - (width / 2 - hand.linkage_offset) ** 2)


@pytest.mark.parametrize("name", NAMES)
def test_a_hand_has_the_name_of_its_file(name: str) -> None:
    module = importlib.import_module(f"tesnet.hands.{name}")
    assert HANDS[name] is module.HAND
    assert HANDS[name].gripper.name == name
    assert 0 < HANDS[name].gripper.max_width <= WIDEST
    assert 0 < HANDS[name].min_force <= HANDS[name].max_force
    assert module.__doc__
    assert "easured on the" in module.__doc__


def test_every_file_of_a_hand_is_listed_and_the_first_is_the_default() -> None:
    folder = importlib.resources.files("tesnet.hands")
    files = {entry.name[:-3] for entry in folder.iterdir() if entry.name.endswith(".py")}
    assert set(HANDS) == files - {"__init__", "entry"}
    assert next(iter(HANDS.values())).gripper is PANDA
    assert {name for name, hand in HANDS.items() if not hand.simulated} == {"wsg50", "xarm", "rg6", "ag95"}


@pytest.mark.parametrize(("name", "width"), [(name, width) for name, row in BASE_TO_TCP.items() for width in row])
def test_the_tcp_is_where_forward_kinematics_have_it(name: str, width: float) -> None:
    # Of a crank that lies nearly flat a tenth of a millimetre of opening is four of height.
    tolerance = 4e-4 if width > 0.1 else 1.1e-4
    hand = HANDS[name].gripper
    assert from_base(hand, width) == pytest.approx(BASE_TO_TCP[name][width], abs=tolerance)
    assert hand.tcp_at(width) == pytest.approx(from_base(hand, width), abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_travel_is_that_of_the_farthest_tip_while_the_hand_closes(name: str) -> None:
    hand = HANDS[name].gripper
    rises = [from_base(hand, width) for width in np.linspace(0, hand.max_width, 2001)]
    assert hand.travel == pytest.approx(max(rises) - rises[-1], abs=1e-6)
    assert (hand.travel > 0) == (name in ARCS)
    assert hand.swings_far == (name in {"rg2", "rg6"})
    widths = torch.linspace(0, hand.max_width, 7, dtype=torch.float64)
    expected = [from_base(hand, width) for width in widths.tolist()]
    np.testing.assert_allclose(np.broadcast_to(hand.tcp_at(widths), 7), expected, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_the_closed_palm_is_covered_at_every_opening(name: str) -> None:
    """In the frame of the base the palm stands still, so the part, which moves with the tips, must be long enough."""
    hand = HANDS[name].gripper
    palm = hand.parts[2]
    backs = [palm.back + hand.tcp_at(width) for width in (0.0, 0.04, hand.max_width)]
    assert max(backs) < 0.035  # the body begins at the base link, or behind it
    assert hand.palm_depth > hand.travel


@pytest.mark.parametrize("name", NAMES)
def test_the_check_and_the_samples_hold_for_a_hand(name: str) -> None:
    hand = HANDS[name].gripper
    for width in (0.0, 0.6 * hand.max_width, hand.max_width):
        samples = np.concatenate(
            [np.array(collision._samples(part)) + np.array([0.0, part.side * width / 2, 0.0]) for part in hand.parts]
        )
        corners = hand.corners(width)
        assert (samples <= corners.max(axis=0) + 1e-9).all()
        assert (samples >= corners.min(axis=0) - 1e-9).all()
        inner = samples * [1, 1 + 1e-6, 1] - [0, 0, 1e-5]
        hits = collision.in_collision(torch.tensor(inner).float(), torch.eye(4)[None], hand, width, 0.0)
        assert hits.all()


# Placing and clearance


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("width", [0.0, 0.03, 0.05])
def test_the_base_link_stands_behind_the_tcp_in_its_own_axes(name: str, width: float) -> None:
    hand = HANDS[name].gripper
    T = Pose.random(np.random.default_rng(1), reach=0.5)
    points = np.zeros((1, 3))
    grasps = GraspSet(np.ones(1), T.matrix[None], np.array([width]), points, points, hand)
    base = grasps.hand_poses[0]
    np.testing.assert_allclose(base[:3, 3], T.apply([0.0, 0.0, -from_base(hand, width)]), atol=1e-12)
    np.testing.assert_allclose(base[:3, 2], T.rotation[:, 2], atol=1e-12)
    closing = base[:3, 0] if hand.hand_yaw else base[:3, 1]
    np.testing.assert_allclose(closing, T.rotation[:, 1], atol=1e-12)
    other = grasps.in_convention("contact_graspnet")[0]
    np.testing.assert_allclose(other[:3, 3], base[:3, 3], atol=1e-12)
    np.testing.assert_allclose(other[:3, :3], np.stack([T.rotation[:, 1], -T.rotation[:, 0], T.rotation[:, 2]], 1))


@pytest.mark.parametrize("name", NAMES)
def test_the_tips_come_to_lie_7_mm_past_the_contact_once_they_have_closed_up_to_it(name: str) -> None:
    hand = HANDS[name].gripper
    rng = np.random.default_rng(2)
    approach = torch.from_numpy(rng.uniform(-0.1, 0.1, (30, 3)))
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(30, 3))), dim=1)
    contact = approach + torch.from_numpy(rng.uniform(-0.02, 0.02, (30, 3)))
    poses = candidates.grasp_poses(approach, contact, normals, hand=hand).numpy()
    for T, p_a, p_c, n_c in zip(poses, approach.numpy(), contact.numpy(), normals.numpy(), strict=True):
        along = (p_c - p_a) @ n_c
        closed = 2 * min(max(along, 0.0), hand.max_width / 2)
        advance = from_base(hand, closed) - from_base(hand, hand.max_width)
        tips = T[:3, 3] + (advance + hand.tip_offset) * T[:3, 2]
        assert (tips - p_c) @ T[:3, 2] == pytest.approx(0.007, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_clearance_holds_for_the_lowest_tip_on_the_way(name: str) -> None:
    hand = HANDS[name].gripper
    rng = np.random.default_rng(3)
    up = np.array([0.0, 0.6, 0.8])
    cloud = bare_cloud(rng.uniform(-0.1, 0.1, (50, 3)), up=torch.tensor(up).float(), support_height=-0.1)
    Ts = np.array([Pose.random(rng, reach=0.1).matrix for _ in range(40)])
    contact, widths = rng.integers(50, size=40), rng.uniform(0.4, 1.0, 40) * hand.max_width
    poses, opened = torch.from_numpy(Ts).float(), torch.from_numpy(widths).float()
    found = candidates.Candidates(torch.zeros(40).long(), torch.from_numpy(contact), poses, opened, hand)
    for row, clearance in enumerate(candidates.hand_clearance(cloud, found).tolist()):
        T, width = Ts[row], widths[row]
        along = (cloud.points[contact[row]].double().numpy() - T[:3, 3]) @ T[:3, 1]
        closed = max(min(2 * along, width) - 0.01, 0.0)  # 10 mm narrower than the walls, which may be elsewhere
        lowest = np.inf
        for closing in np.linspace(width, closed, 200) if name in ARCS else [width]:
            advance = from_base(hand, closing) - from_base(hand, width)
            fingers = np.concatenate([part.corners(closing) for part in hand.parts[:2]]) + np.array([0, 0, advance])
            places = np.concatenate([fingers, hand.parts[2].corners(width)]) @ T[:3, :3].T + T[:3, 3]
            lowest = min(lowest, float((places @ up).min()) + 0.1)
        assert clearance == pytest.approx(lowest, abs=4e-4)
        assert clearance > lowest - 1e-5  # never more than what was looked at


@pytest.mark.parametrize("name", ARCS)
@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_of_a_hand_that_closes_straight_down_on_nothing_the_clearance_is_exact(name: str, share: float) -> None:
    """Also where the tips are lowest between two of the openings that are looked at."""
    hand = HANDS[name].gripper
    cloud = bare_cloud(np.zeros((1, 3)), up=torch.tensor([0.0, 0.0, 1.0]).double(), support_height=-0.1)
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()[None]
    width, point = share * hand.max_width, torch.zeros(1).long()
    found = candidates.Candidates(point, point, pose, torch.tensor([width]).double(), hand)
    farthest = max(from_base(hand, closing) for closing in np.linspace(0, width, 4001)) - from_base(hand, width)
    clearance = float(candidates.hand_clearance(cloud, found))
    assert clearance == pytest.approx(0.1 - hand.tip_offset - farthest, abs=1e-7)


@pytest.mark.parametrize("name", ARCS)
def test_a_low_thing_is_held_where_the_tips_come_to_rest_over_the_support(name: str) -> None:
    """A slab 12 mm high, pairs of its top and of its wall: the hand stops short as if it had slid there closed."""
    hand = HANDS[name].gripper
    half = 0.3 * hand.max_width
    points = torch.tensor([[0.0, 0.0, 0.012], [0.0, half, 0.008]], dtype=torch.float64)
    cloud = bare_cloud(points.numpy(), up=torch.tensor([0.0, 0.0, 1.0]).double(), support_height=0.0)
    normal = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    poses = candidates.grasp_poses(points[:1], points[1:], normal, hand=hand)
    pair = torch.zeros(1).long(), torch.ones(1).long()
    found = candidates.Candidates(*pair, poses, candidates.wide_open(poses, hand), hand)
    cleared, too_near = candidates.clear_of_support(cloud, found, candidates.CandidateConfig())
    assert not bool(too_near)
    resting = from_base(hand, 2 * half) - from_base(hand, hand.max_width) + hand.tip_offset
    tips = float(cleared.Ts_canonical_grasp[0, 2, 3]) - resting
    deeper = max(from_base(hand, w) for w in np.linspace(2 * half, 2 * half - 0.01, 99)) - from_base(hand, 2 * half)
    assert float(candidates.hand_clearance(cloud, cleared)) == pytest.approx(tips - deeper, abs=2e-4)
    assert float(candidates.hand_clearance(cloud, cleared)) >= 0.0015 - 1e-9
    assert 0.012 - tips >= 0.003  # so far past the face, or they slip off


@pytest.mark.parametrize("name", NAMES)
def test_limits_of_candidates_follow_the_opening_and_the_depth_of_the_fingers(name: str) -> None:
    hand = HANDS[name].gripper
    limits = candidates.limits_for(hand, candidates.CandidateConfig())
    assert limits.max_offset == pytest.approx(hand.max_width / 2 - 0.002)
    assert limits.max_depth == pytest.approx(hand.finger_depth - 0.01)


def test_a_hand_of_other_sizes_has_no_name() -> None:
    robotiq = HANDS["robotiq_2f85"].gripper
    longer = robotiq.with_sizes({"finger_depth": 0.06})
    assert (longer.name, longer.finger_depth, longer.linkage_length) == (None, 0.06, robotiq.linkage_length)
    assert robotiq.with_sizes({}) == robotiq
    assert PANDA.with_sizes(robotiq.sizes()) == robotiq
    assert robotiq.sizes()["linkage_length"] == 0.05715
    limited = robotiq.with_sizes({"max_width": 0.04})
    assert limited.hand_to_tcp == pytest.approx(robotiq.tcp_at(0.04))
    assert limited.tcp_at(0.02) == pytest.approx(robotiq.tcp_at(0.02))
    rg2 = HANDS["rg2"].gripper
    other = {"linkage_length": 0.08}
    both = rg2.with_sizes(other | {"max_width": 0.05})
    assert both.tcp_at(0.03) == pytest.approx(rg2.with_sizes(other).tcp_at(0.03))
    assert rg2.with_sizes({"max_width": 0.05, "hand_to_tcp": 0.2}).hand_to_tcp == 0.2
    assert (
        rg2.with_sizes({"max_width": 0.05, "linkage_length": 0.03}).hand_to_tcp == rg2.hand_to_tcp
    )  # too short for both


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"linkage_length": 0.03}, r"max_width is 0\.08; cranks .* open less than 0\.06 m"),
        ({"linkage_length": 0.06, "linkage_offset": -0.03}, r"open less than 0\.06 m"),
        ({"linkage_length": 0.06, "linkage_offset": 0.06}, r"linkage_offset is 0\.06; it must be nearer to 0"),
        ({"linkage_offset": 0.02}, r"linkage_offset is 0\.02; it needs linkage_length"),
        ({"linkage_length": -0.1}, r"linkage_length is -0\.1"),
        ({"hand_to_tcp": 0.0}, r"hand_to_tcp is 0"),
    ],
)
def test_a_linkage_that_cannot_be_is_refused(sizes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PANDA.with_sizes(sizes)


def test_a_known_hand_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        HANDS["rg2"].gripper.max_width = 1.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        HANDS["mine"] = HANDS["rg2"]  # type: ignore[index]


@given(length=st.floats(0.06, 0.12), offset=st.floats(-0.03, 0.05), opening=st.floats(0.05, 0.15))
def test_hands_whose_tips_swing_reach_farthest_where_nothing_reaches_farther(
    length: float, offset: float, opening: float
) -> None:
    assume(max(abs(opening / 2 - offset), abs(offset)) < 0.9 * length)
    hand = dataclasses.replace(HANDS["rg2"].gripper, max_width=opening, linkage_length=length, linkage_offset=offset)
    widths = np.linspace(0, opening, 401)
    reached = hand.tcp_at(widths)
    assert 0 <= hand.farthest_width <= opening
    assert hand.tcp_at(hand.farthest_width) >= reached.max() - 1e-12
    assert hand.travel == pytest.approx(reached.max() - reached[-1], abs=1e-5)
