from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from tesnet import candidates, collision
from tesnet.cloud import PreparedCloud
from tesnet.geometry import PANDA, Gripper, Pose
from tesnet.obstacles import Obstacles
from tests.tesnet.hand_twin import HANDS_TO_TRY, deepest_on_way, depth_in_hand
from tests.tesnet.scenes import Array, bare_cloud, open_hands, prepared, tabletop_query

ROUNDING = 1e-6
SWEEP = 0.05


def depths(points: Array, T: Array, width: float) -> Array:
    """(P,) how deep, in metres, points lie in the resting hand, by the Panda's measures; negative outside."""
    local = (points - T[:3, 3]) @ T[:3, :3]
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
    thickness = np.interp(0.0086 - z, [0, 0.038], [0.0144, 0.0264])
    finger = [y - width / 2, width / 2 + thickness - y, 0.0105 - x, 0.0086 - z, z + 0.0374]
    breadth = np.interp(-0.0374 - z, [0, 0.0625], [0.0315, 0.063])
    palm = [breadth / 2 - x, 0.102 - y, -0.0374 - z, z + 0.0374 + 0.092]
    deepest: Array = np.maximum(np.min(finger, axis=0), np.min(palm, axis=0))
    return deepest


def penetration(points: Array, Ts: Array, width: float, sweep: float = SWEEP) -> Array:
    """(C,) of the deepest point at any of the steps, a millimetre apart, of the way to the grasp. float64, loops."""
    deepest = np.full(len(Ts), -np.inf)
    for row, T in enumerate(Ts):
        for back in np.linspace(0, sweep, 51 if sweep else 1):
            behind = T.copy()
            behind[:3, 3] -= back * T[:3, 2]
            deepest[row] = max(deepest[row], depths(points, behind, width).max())
    return deepest


def assert_agree(found: Array, depth: Array) -> None:
    """Between two steps of the twin the hand moves by 1 mm, so a point may graze it by that much unnoticed."""
    assert found[depth > ROUNDING].all()
    assert not found[depth < -0.001].any()


def hits(points: Array, Ts: Array, width: float, sweep: float = SWEEP) -> Array:
    found = collision.in_collision(bare_cloud(points).points, torch.from_numpy(Ts).float(), PANDA, width, sweep)
    return np.asarray(found.numpy())


@given(
    seed=st.integers(0, 2**31),
    count=st.sampled_from([1, 5, 40]),
    width=st.sampled_from([0.0, 0.04, 0.08]),
    sweep=st.sampled_from([0.0, 0.05]),
)
@settings(max_examples=15, deadline=None)
def test_collision_is_that_of_a_brute_force_twin(seed: int, count: int, width: float, sweep: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.12, 0.12, (count, 3)).astype(np.float32).astype(np.float64)
    Ts = np.array([Pose.random(rng, reach=0.08).matrix for _ in range(20)])
    depth, found = penetration(points, Ts, width, sweep), hits(points, Ts, width, sweep)
    assert_agree(found, depth)
    if not sweep:  # one step is the whole way
        certain = np.abs(depth) > ROUNDING
        np.testing.assert_array_equal(found[certain], depth[certain] > 0)


def test_the_candidates_of_a_scene_collide_as_the_twin_says() -> None:
    ready = prepared(tabletop_query())
    found, _ = candidates.generate(ready, tabletop_query(max_candidates=150), candidates.CandidateConfig())
    hit = collision.in_collision(ready.points, found.Ts_canonical_grasp, PANDA, 0.08, SWEEP).numpy()
    assert_agree(hit, penetration(ready.points.double().numpy(), found.Ts_canonical_grasp.double().numpy(), 0.08))
    assert 0.1 < hit.mean() < 0.99


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ([0.0, 0.0, 0.0], False),  # between the fingers
        ([0.0, 0.05, 0.0], True),  # in the +y finger
        ([0.0, -0.05, 0.0], True),
        ([0.0, 0.068, 0.0], False),  # beside it
        ([0.0, 0.05, 0.009], False),  # beyond the tips
        ([0.0, 0.06, 0.005], False),  # where the finger is tapered
        ([0.0, 0.06, -0.03], True),  # where it is not
        ([0.025, 0.0, -0.05], False),  # where the palm is tapered
        ([0.025, 0.0, -0.1], True),  # where it is not
        ([0.011, 0.05, 0.0], False),  # in front of it
        ([0.0, 0.0, -0.04], True),  # in the palm
        ([0.0, 0.0, -0.036], False),  # just before the palm
        ([0.0, 0.05, -0.07], True),  # where the finger passes
        ([0.0, 0.0, -0.17], True),  # where the palm passes
        ([0.0, 0.0, -0.18], False),  # behind the whole way
    ],
)
def test_a_point_is_hit_where_the_hand_passes(place: list[float], expected: bool) -> None:
    assert hits(np.array([place]), np.eye(4)[None], 0.08).tolist() == [expected]


@given(seed=st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_a_hand_turned_by_half_a_turn_collides_equally(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.1, 0.1, (8, 3))
    Ts = np.array([Pose.random(rng, reach=0.08).matrix for _ in range(40)])
    turned = Ts @ Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)).matrix
    np.testing.assert_array_equal(hits(points, Ts, 0.08), hits(points, turned, 0.08))


def test_no_candidates_have_no_collisions() -> None:
    assert hits(np.zeros((5, 3)), np.empty((0, 4, 4)), 0.08).shape == (0,)


# What a side of the workspace cuts off

STRIP = np.array([(x, y, 0.0) for x in (-0.008, 0.0, 0.008) for y in (0.096, 0.098, 0.1)])
SIDE = torch.tensor([[0.0, 1.0, 0.0, 0.1005]])
"""Of a workspace that ends at y = 0.1005, just beyond the strip of points."""


def blocked_beside_the_side(*ys: float) -> list[bool]:
    """For hands whose TCPs lie at y, level with the strip; fingers close along y."""
    Ts = np.tile(np.eye(4), (len(ys), 1, 1))
    Ts[:, 1, 3] = ys
    hands = open_hands(torch.from_numpy(Ts).float())
    found: list[bool] = collision.blocked(bare_cloud(STRIP, sides=SIDE), hands, "free").tolist()
    return found


def test_things_that_a_side_cuts_off_go_on_straight_out_of_it() -> None:
    places = collision.beyond(bare_cloud(STRIP, sides=SIDE)).double().numpy()
    expected = {(x, round(y + step, 6), 0.0) for x, y, _ in STRIP for step in np.arange(0.005, 0.04, 0.005)}
    assert {tuple(np.round(place, 6)) for place in places} == expected
    assert len(collision.beyond(bare_cloud(STRIP))) == 0
    assert len(collision.beyond(bare_cloud(STRIP - [0.0, 0.01, 0.0], sides=SIDE))) == 0


def test_a_finger_that_comes_down_beyond_the_side_is_blocked_and_one_far_off_is_not() -> None:
    assert blocked_beside_the_side(0.07, -0.2, 0.05) == [True, False, True]  # the last one hits the strip itself


def test_what_is_only_guessed_leaves_a_candidate() -> None:
    assert blocked_beside_the_side(0.07) == [False]
    assert blocked_beside_the_side(0.07, 0.05) == [False, True]


def test_the_shadow_blocks_where_it_counts_as_occupied() -> None:
    Ts = torch.from_numpy(HAND_ALONG_X[None]).float()
    Ts[0, 2, 3] = -0.3
    hands = open_hands(Ts)
    assert not collision.blocked(bare_cloud(SQUARE, ABOVE[None]), hands, "free").any()
    assert collision.blocked(bare_cloud(SQUARE, ABOVE[None]), hands, "occupied").all()


# The shadow of a square of 20 x 20 cm at z = 0, spacing 4 mm, seen from straight above.

_GRID = np.arange(-0.1, 0.1001, 0.004)
SQUARE = np.stack([*np.meshgrid(_GRID, _GRID), np.zeros((len(_GRID), len(_GRID)))], axis=2).reshape(-1, 3)
ABOVE = np.array([0.0, 0.0, 0.6])
HAND_ALONG_X = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
"""Travels along +x, fingers along y: flat under or over the square."""


def shadowed(*translations: list[float], viewpoints: Array = ABOVE[None], points: Array = SQUARE) -> list[bool]:
    Ts = np.tile(HAND_ALONG_X, (len(translations), 1, 1))
    Ts[:, :3, 3] = translations
    found: list[bool] = collision.in_shadow(
        bare_cloud(points, viewpoints), torch.from_numpy(Ts).float(), PANDA, 0.08
    ).tolist()
    return found


def test_a_hand_behind_a_surface_is_hidden_and_one_before_or_beside_it_is_not() -> None:
    behind, just_behind, before, beside, far_behind = (
        [0.0, 0.0, -0.1], [0.0, 0.0, -0.02], [0.0, 0.0, 0.1], [0.5, 0.0, -0.1], [0.0, 0.0, -0.4],
    )  # fmt: skip
    assert shadowed(behind, just_behind, before, beside, far_behind) == [True, True, False, False, True]


def test_a_hand_within_the_margin_of_a_surface_is_not_hidden() -> None:
    assert shadowed([0.0, 0.0, -0.005]) == [False]


def test_what_reaches_into_the_shadow_with_one_finger_is_hidden() -> None:
    assert shadowed([0.0, 0.14, -0.1], [0.0, 0.3, -0.1]) == [True, False]


def test_a_second_viewpoint_that_sees_the_place_lifts_the_shadow() -> None:
    below = np.array([0.0, 0.0, -0.6])
    assert shadowed([0.0, 0.0, -0.1], viewpoints=np.stack([ABOVE, below])) == [False]
    assert shadowed([0.0, 0.0, -0.1], viewpoints=np.stack([ABOVE, ABOVE + 0.01])) == [True]


@pytest.mark.parametrize("turn", range(3))
def test_the_shadow_moves_with_the_scene(turn: int) -> None:
    motion = Pose.random(np.random.default_rng(turn), reach=0.5)
    Ts = np.tile(HAND_ALONG_X, (3, 1, 1))
    Ts[:, :3, 3] = [[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.5, 0.0, -0.1]]
    moved = torch.from_numpy(motion.matrix @ Ts).float()
    cloud = bare_cloud(motion.apply(SQUARE), motion.apply(ABOVE[None]))
    assert collision.in_shadow(cloud, moved, PANDA, 0.08).tolist() == [True, False, False]


@pytest.mark.parametrize("viewpoint", [[0.0, 0.0, 0.0], [0.0, 0.0, 1e6]])
def test_a_viewpoint_inside_the_cloud_or_far_away_is_no_trouble(viewpoint: list[float]) -> None:
    assert len(shadowed([0.0, 0.0, -0.1], viewpoints=np.array([viewpoint]))) == 1


# Every part of the judgement goes by the hand that was asked for and by the opening of each candidate


@pytest.fixture(params=HANDS_TO_TRY)
def hand(request: pytest.FixtureRequest) -> Gripper:
    found: Gripper = HANDS_TO_TRY[request.param]
    return found


def scattered(seed: int, hand: Gripper, poses: int = 40) -> tuple[Array, Array, Array]:
    """Four points, poses about them, and openings of the hand from nearly closed to wide."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.15, 0.15, (4, 3)).astype(np.float32).astype(np.float64)
    Ts = np.array([Pose.random(rng, reach=0.15).matrix for _ in range(poses)])
    return points, Ts, rng.uniform(0.1, 1.0, poses) * hand.max_width


def opened(Ts: Array, widths: Array, hand: Gripper) -> candidates.Candidates:
    """Hands at poses (C, 4, 4), open by widths (C,)."""
    hands = open_hands(torch.from_numpy(Ts).float())
    return replace(hands, widths=torch.from_numpy(widths).float(), gripper=hand)


def judged(cloud: PreparedCloud, Ts: Array, widths: Array, hand: Gripper) -> Array:
    found: Array = collision.blocked(cloud, opened(Ts, widths, hand), "free").numpy()
    return found


NOWHERE = np.full((20, 3), 5.0)
"""Far from every hand."""


def test_the_hand_that_is_asked_for_meets_the_cloud_as_its_twin_does(hand: Gripper) -> None:
    points, Ts, widths = scattered(0, hand)
    found = judged(bare_cloud(np.concatenate([points, NOWHERE])), Ts, widths, hand)
    assert_agree(found, deepest_on_way(points, Ts, hand, widths, SWEEP))
    assert 0 < found.sum() < len(found)


def test_the_hand_that_is_asked_for_meets_what_was_not_sought_as_its_twin_does(hand: Gripper) -> None:
    points, Ts, widths = scattered(1, hand)
    unsought = Obstacles.of(torch.from_numpy(points).float())
    found = judged(bare_cloud(NOWHERE, unsought=unsought), Ts, widths, hand)
    assert_agree(found, deepest_on_way(points, Ts, hand, widths, SWEEP))
    assert 0 < found.sum() < len(found)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_hand_that_is_asked_for_meets_what_a_side_cuts_off_as_its_twin_does(hand: Gripper, sign: float) -> None:
    """On the side of the workspace where the strip is, whichever of the two that is."""
    turn = np.array([1.0, sign, 1.0])
    sides = torch.tensor([[0.0, sign, 0.0, 0.1005], [0.0, -sign, 0.0, 0.1005]])
    further = np.array([(x, y + step, 0.0) for x, y, _ in STRIP for step in np.arange(0.005, 0.04, 0.005)])
    _, Ts, widths = scattered(2, hand, poses=150)
    Ts[:, :3, 3] += turn * [0.0, 0.12, 0.0]
    strip, guessed = (deepest_on_way(points * turn, Ts, hand, widths, SWEEP) for points in (STRIP, further))
    cloud = bare_cloud(STRIP * turn, sides=sides)
    found = judged(cloud, Ts, widths, hand)
    assert_agree(found, np.maximum(strip, guessed))
    assert not found.all()
    only_guessed = (strip < -0.001) & (guessed > ROUNDING)
    assert only_guessed.any()
    assert not judged(cloud, Ts[only_guessed], widths[only_guessed], hand).any(), "a guess leaves a candidate"


def test_a_guess_that_would_leave_nothing_beside_what_is_seen_counts_for_none() -> None:
    """One hand meets the strip, the other only what may stand beyond it: together nothing would be left."""
    assert blocked_beside_the_side(0.05, 0.07) == [True, False]
    assert blocked_beside_the_side(0.05, 0.07, -0.2) == [True, True, False]


@pytest.mark.parametrize("part", ["left", "right", "palm"])
@pytest.mark.parametrize("end", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_each_part_of_the_hand_that_is_asked_for_is_looked_for_in_the_shadow(
    hand: Gripper, part: str, end: float, share: float
) -> None:
    """The shadow of a small square covers one part alone: a finger's tip or its back, or an end of the palm."""
    width = share * hand.max_width
    beside = width / 2 + hand.finger_tip_thickness / 2
    tip, back = hand.tip_offset, hand.palm_front
    depth = tip - 0.003 if end > 0 else back + 0.003
    of_palm = [0.0, end * 0.45 * hand.palm_length, back - 0.005]
    place = {"left": [0.0, beside, depth], "right": [0.0, -beside, depth], "palm": of_palm}[part]
    T = HAND_ALONG_X.copy()
    T[:3, 3] = -T[:3, :3] @ place
    aside = T.copy()
    aside[1, 3] += 1.0
    along = np.arange(-0.02, 0.0201, 0.002)
    square = np.stack([*np.meshgrid(along, along), np.full((len(along), len(along)), 0.03)], axis=2).reshape(-1, 3)
    cloud = bare_cloud(square, np.array([[0.0, 0.0, 3.0]]))
    hands = opened(np.stack([T, aside]), np.array([width, width]), hand)
    alone = collision.blocked(cloud, hands.select(torch.tensor([1])), "free")
    assert alone.tolist() == [False]
    assert collision.in_shadow(cloud, hands.Ts_canonical_grasp, hand, hands.widths).tolist() == [True, False]
    assert collision.blocked(cloud, hands, "occupied").tolist() == [True, False]


def test_what_is_not_sought_blocks_beside_what_is_and_frees_no_hand() -> None:
    """Points outside the workspace are one more set of obstacles: a hand is free where it meets neither."""
    query = tabletop_query(max_candidates=150)
    ready = prepared(query)
    found, _ = candidates.generate(ready, query, candidates.CandidateConfig())
    others = ready.points + torch.tensor([0.03, 0.0, 0.02])
    with_others = replace(ready, unsought=Obstacles.of(others))
    alone, both = (collision.blocked(cloud, found, "free") for cloud in (ready, with_others))
    met = collision.in_collision(others, found.Ts_canonical_grasp, PANDA, found.widths, SWEEP)
    assert (met & ~alone).any()
    assert (alone & ~met).any()
    assert torch.equal(both, alone | met)


@pytest.mark.parametrize("count", range(collision.HELD_POINTS - 1, collision.HELD_POINTS + 2))
@pytest.mark.parametrize("deeper", [-0.0005, 0.0005])
def test_a_hand_holds_things_from_so_many_points_so_deep_in_it_on(count: int, deeper: float) -> None:
    """Counted in the palm of a hand at rest somewhere, from its front."""
    pose = Pose.random(np.random.default_rng(3), reach=0.2)
    along = np.linspace(-0.05, 0.05, count)
    depth = collision.HELD_DEPTH + deeper
    places = np.column_stack([np.zeros(count), along, np.full(count, PANDA.palm_front - depth)])
    beside = np.column_stack([np.full(50, 0.2), np.linspace(-0.1, 0.1, 50), np.zeros(50)])
    posted = torch.from_numpy(pose.apply(np.concatenate([places, beside]))).float()
    hands = open_hands(torch.from_numpy(np.stack([pose.matrix, np.eye(4) + np.diag([0, 0, 5.0], 1)])).float())
    assert collision.holds(posted, hands)[0] == (count >= collision.HELD_POINTS and deeper > 0)


def test_the_fingers_of_an_open_hand_hold_what_lies_outermost_in_them_however_it_is_turned(hand: Gripper) -> None:
    rng = np.random.default_rng(0)
    side, breadth = hand.max_width / 2, hand.finger_breadth / 2
    finger = rng.uniform(
        [-breadth, side, hand.palm_front], [breadth, side + hand.finger_thickness, hand.tip_offset], (20_000, 3)
    )
    deep = finger[depth_in_hand(finger, hand, hand.max_width) > collision.HELD_DEPTH + 1e-4]
    outermost = deep[(deep @ [0.0, 1.0, 1.0]).argsort()[-collision.HELD_POINTS :]]
    for seed in range(20):
        pose = Pose.random(np.random.default_rng(seed), reach=0.2)
        alone = opened(pose.matrix[None], np.array([hand.max_width]), hand)
        assert collision.holds(torch.from_numpy(pose.apply(outermost)).float(), alone)[0]


@pytest.mark.parametrize("rise", [0.0, 0.03])
def test_a_palm_is_blocked_by_what_it_meets_wherever_the_hand_may_yet_be_moved(hand: Gripper, rise: float) -> None:
    rng = np.random.default_rng(1)
    palm, count, sweep = hand.parts[2], 800, np.array([0.0, 0.0, collision.APPROACH_DISTANCE])
    corners = palm.corners(0.0)
    low, high = corners.min(axis=0) - sweep, corners.max(axis=0)
    places = rng.uniform(low - 0.03, high + 0.03, (count, 3))
    moves = np.array([[rng.uniform(-0.03, 0.0), rng.uniform(0.0, 0.03)] for _ in range(count)])
    planes = ConvexHull(np.concatenate([corners, corners - sweep])).equations
    deepest = np.full(count, -np.inf)  # of all that it may be moved by, how far the palm's surface is: most is outside
    for across, along in itertools.product(np.linspace(0, 1, 5), np.linspace(-rise, rise, 5)):
        moved = places - np.outer(moves @ [1 - across, across], [0, 1, 0]) - [0, 0, along]
        deepest = np.maximum(deepest, (moved @ planes[:, :3].T + planes[:, 3]).max(axis=1))
    Ts = np.array([Pose.random(rng).matrix for _ in range(count)])
    Ts[:, :3, 3] = -np.einsum("cij,cj->ci", Ts[:, :3, :3], places)  # the one point is the origin
    hands = opened(Ts, np.full(count, hand.max_width), hand)
    least, most = torch.from_numpy(moves).float().unbind(dim=1)
    found = collision.palm_blocked(torch.zeros(1, 3), hands, least, most, rise, lambda: None).numpy()
    assert_agree(found, -deepest)
    assert 0.02 < found.mean() < 0.9


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_a_hand_is_looked_for_in_the_shadow_at_places_inside_its_parts_from_end_to_end(
    hand: Gripper, share: float
) -> None:
    width = share * hand.max_width
    for part in hand.parts:
        places = np.array(collision._samples(part))
        places[:, 1] += part.side * width / 2
        planes = ConvexHull(part.corners(width)).equations
        assert (places @ planes[:, :3].T + planes[:, 3]).max() < 1e-9
        assert (places[:, 0] == 0).all()
        if part.side:
            assert (places[:, 2].min(), places[:, 2].max()) == pytest.approx((part.back, part.front))
        else:
            np.testing.assert_allclose(places[:, 2], part.front - 0.005)
            assert np.abs(places[:, 1]).max() == pytest.approx(0.45 * part.thickness.full)
            assert sorted(places[:, 1]) == pytest.approx(sorted(-places[:, 1]))
