from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet import candidates, cloud, collision
from tesnet.candidates import CandidateConfig, Candidates
from tesnet.clearance import LEAST_REACH, NEAREST, WANTED_REACH
from tesnet.geometry import PANDA, Gripper, Pose
from tesnet.hands import HANDS
from tesnet.outline import Outline, outline
from tesnet.points import farthest_points
from tesnet.query import MAX_APPROACH_POINTS, ApproachCone
from tests.tesnet.hand_twin import HANDS_TO_TRY, depth_in_hand
from tests.tesnet.raycast import Bowl, Slab, around, overhead_query
from tests.tesnet.scenes import (
    CAMERA,
    UP,
    Array,
    ask,
    bare_cloud,
    box_surface,
    prepared,
    seen_from,
    tabletop,
    tabletop_query,
)

CONFIG = CandidateConfig()
ROUNDING = 1e-6
"""Metres; float32 coordinates of a tenth of a metre are exact to 4e-9."""


@functools.cache
def ready(seed: int = 0) -> cloud.PreparedCloud:
    return prepared(tabletop_query(seed))


def exact(tensor: torch.Tensor) -> Array:
    return tensor.double().numpy()


def generate(options: dict[str, Any] | None = None, seed: int = 0) -> tuple[Candidates, dict[str, int]]:
    return candidates.generate(ready(seed), tabletop_query(seed, **(options or {})), CONFIG)


def farthest_points_one_by_one(points: Array, count: int, start: int) -> list[int]:
    """Gonzalez 1985, as it stands."""
    chosen, distance = [start], np.linalg.norm(points - points[start], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def coverage(points: Array, chosen: list[int]) -> float:
    """The largest distance of a point from its nearest chosen one."""
    return float(np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(axis=1).max())


# Approach points


def test_four_times_as_many_approach_points_are_tried_each_time_up_to_the_limit() -> None:
    counts = [1]
    while counts[-1] < MAX_APPROACH_POINTS and len(counts) < 20:
        counts.append(candidates.more_approach_points(counts[-1]))
    assert counts == [1, 4, 16, 64, 256, 1024]
    assert candidates.more_approach_points(300) == MAX_APPROACH_POINTS == 1024


@given(seed=st.integers(0, 2), count=st.sampled_from([2, 8, 32, 100]), start=st.integers(0, 1000))
@settings(max_examples=12, deadline=None)
def test_farthest_points_cover_nearly_as_well_as_one_by_one(seed: int, count: int, start: int) -> None:
    points = ready(seed).points
    chosen = farthest_points(points, count, start).tolist()
    assert chosen[0] == start
    assert len(set(chosen)) == count
    reference = farthest_points_one_by_one(exact(points), count, start)
    # One by one is at most twice as wide as the best choice there is; this one is held to twice that.
    assert coverage(exact(points), chosen) <= 2 * coverage(exact(points), reference)


def test_no_more_points_are_chosen_than_are_different() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0], [0, 2, 0]])
    assert sorted(map(tuple, points[farthest_points(points, 5, 2)].tolist())) == [
        (0.0, 0.0, 0.0),
        (0.0, 2.0, 0.0),
        (1.0, 0.0, 0.0),
    ]
    assert farthest_points(points[:1], 8, 0).tolist() == [0]
    assert farthest_points(points, 1, 4).tolist() == [4]


# Pairs and poses


def test_pairs_are_those_of_a_double_loop_over_the_limits() -> None:
    points, normals = exact(ready().points), exact(ready().normals)
    approach = farthest_points(ready().points, 12, 5)
    pairs = candidates.pairs_in_reach(ready().points, ready().normals, approach, CONFIG)
    found = set(zip(*(index.tolist() for index in pairs), strict=True))
    certain, possible = set(), set()
    for a in approach.tolist():
        d = points - points[a]
        offset = (d * normals).sum(axis=1)
        distance = np.linalg.norm(d, axis=1)
        depth = np.linalg.norm(d - offset[:, None] * normals, axis=1)
        margins = np.stack([0.038 - distance, depth - 0.003, 0.040 - depth, offset + 0.003, 0.038 - offset])
        certain |= {(a, int(c)) for c in np.flatnonzero(margins.min(axis=0) > ROUNDING)}
        possible |= {(a, int(c)) for c in np.flatnonzero(margins.min(axis=0) > -ROUNDING)}
    assert len(certain) > 300
    assert certain <= found <= possible


def assert_within_limits(cloud_: cloud.PreparedCloud, found: Candidates) -> None:
    """Every limit of CONVENTIONS.md, in float64, by formulas of the test's own."""
    p_a, p_c = exact(cloud_.points[found.approach]), exact(cloud_.points[found.contact])
    n_c = exact(candidates.contact_normals(cloud_, CONFIG)[found.contact])
    Ts = exact(found.Ts_canonical_grasp)
    x, y, z, tcp = (Ts[:, :3, column] for column in range(4))
    d = p_c - p_a
    offset = np.einsum("ij,ij->i", d, n_c)
    across = d - offset[:, None] * n_c
    depth = np.linalg.norm(across, axis=1)
    assert (np.linalg.norm(d, axis=1) <= 0.038 + ROUNDING).all()
    assert ((depth >= 0.003 - ROUNDING) & (depth <= 0.040 + ROUNDING)).all()
    assert ((offset >= -0.003 - ROUNDING) & (offset <= 0.038 + ROUNDING)).all()
    np.testing.assert_allclose(z, across / depth[:, None], atol=2e-5)  # a depth of 3 mm, points to 2e-8 m
    np.testing.assert_allclose(y, n_c, atol=2e-5)
    np.testing.assert_allclose(x, np.cross(y, z), atol=1e-6)
    # The fingertips, 8.6 mm beyond the TCP, stop 7 mm past the depth of p_c on the line through p_a, which is moved
    # along the closing direction until it lies midway between the walls; near to the support they stop short of that.
    p_a = p_a + np.einsum("ij,ij->i", tcp - p_a, y)[:, None] * y
    short = np.einsum("ij,ij->i", p_a + (depth[:, None] + 0.007) * z - (tcp + 0.0086 * z), z)
    tips = p_a + (depth + 0.007 - short)[:, None] * z
    np.testing.assert_allclose(tcp + 0.0086 * z, tips, atol=ROUNDING)
    np.testing.assert_allclose(tcp - 0.1034 * z, tips - 0.112 * z, atol=3e-4)  # the page rounds
    assert (short > -ROUNDING).all()
    assert (short < 0.007 + ROUNDING).all()
    stopped = short > ROUNDING
    assert 0 < stopped.mean() < 0.2
    # As near as they may be, unless centring then lifts a hand that closes aslant.
    assert (np.abs(lowest_corner(cloud_, found)[stopped] - CONFIG.support_clearance) < 0.0026).mean() > 0.98
    np.testing.assert_allclose(Ts[:, 3], np.tile([0.0, 0, 0, 1], (len(Ts), 1)))
    np.testing.assert_allclose(
        Ts[:, :3, :3].transpose(0, 2, 1) @ Ts[:, :3, :3], np.tile(np.eye(3), (len(Ts), 1, 1)), atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_no_candidate_breaks_a_limit_of_the_conventions(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of low things and of outlines aside, which have limits of their own."""
    monkeypatch.setattr(candidates, "is_low", lambda some: torch.zeros(len(some), dtype=torch.bool))
    nothing = Outline(torch.empty(0, dtype=torch.long), torch.empty(0, 3), torch.empty(0, 3))
    monkeypatch.setattr(candidates, "outline", lambda *_: nothing)
    found, _ = generate({"max_candidates": 20_000}, seed)
    assert len(found) > 500
    assert_within_limits(ready(seed), found)
    up = ready(seed).up
    assert up is not None
    z_upward = exact(found.Ts_canonical_grasp)[:, :3, 2] @ exact(up)
    assert z_upward.max() < 0.1 + ROUNDING
    low = lowest_corner(ready(seed), found)
    assert low.min() >= NEAREST - ROUNDING
    p_a = exact(ready(seed).points[found.approach])
    Ts = exact(found.Ts_canonical_grasp)
    reach = np.einsum("ij,ij->i", Ts[:, :3, 3] - p_a, Ts[:, :3, 2]) + PANDA.tip_offset
    assert (reach[low < 0.004 - 2e-5] <= WANTED_REACH + 2e-5).all()  # centring may cost 10 micrometres


def lowest_corner(cloud_: cloud.PreparedCloud, found: Candidates) -> Array:
    """(C,) height over the support of the lowest of the open hand's corners, in float64."""
    assert cloud_.up is not None
    assert cloud_.support_height is not None
    Ts = exact(found.Ts_canonical_grasp)
    places = np.einsum("cij,kj->cki", Ts[:, :3, :3], PANDA.corners(0.08)) + Ts[:, None, :3, 3]
    lowest: Array = (places @ exact(cloud_.up)).min(axis=1) - cloud_.support_height
    return lowest


def test_hand_clearance_is_that_of_the_lowest_corner() -> None:
    found, _ = candidates.generate(ready(), tabletop_query(), CandidateConfig(support_clearance=-1.0))
    clearance = exact(candidates.hand_clearance(ready(), found))
    np.testing.assert_allclose(clearance, lowest_corner(ready(), found), atol=ROUNDING)
    assert clearance.min() < 0 < clearance.max()


@pytest.mark.parametrize("name", HANDS_TO_TRY)
def test_no_part_of_a_hand_comes_lower_than_its_clearance(name: str) -> None:
    """By places drawn in the twin of the hand: the lowest of them is a little higher than the lowest corner."""
    hand = HANDS_TO_TRY[name].with_sizes({"finger_tip_breadth": HANDS_TO_TRY[name].finger_breadth})
    rng = np.random.default_rng(4)
    places = rng.uniform(-1, 1, (400_000, 3)) * [0.09, 0.16, 0.1] - [0.0, 0.0, 0.09]
    inside = places[depth_in_hand(places, hand, hand.max_width) > 0]
    up = np.array([0.48, -0.6, 0.64])
    cloud_ = bare_cloud(rng.uniform(-0.1, 0.1, (50, 3)), up=torch.tensor(up).float(), support_height=-0.3)
    Ts = np.array([Pose.random(rng, reach=0.1).matrix for _ in range(30)])
    poses = torch.from_numpy(Ts).float()
    point = torch.zeros(len(poses), dtype=torch.long)
    found = candidates.Candidates(point, point, poses, candidates.wide_open(poses, hand), hand)
    clearance = exact(candidates.hand_clearance(cloud_, found))
    lowest = np.array([(inside @ T[:3, :3].T @ up).min() + T[:3, 3] @ up + 0.3 for T in Ts])
    assert (lowest >= clearance - ROUNDING).all()
    np.testing.assert_allclose(lowest, clearance, atol=0.012)


@pytest.mark.parametrize("hand", [*HANDS_TO_TRY.values(), *(known.gripper for known in HANDS.values())])
def test_limits_follow_half_the_opening_and_the_depth_of_the_fingers(hand: Gripper) -> None:
    """Each fingertip has half of the opening, and leaves the Panda's margins within it."""
    limits = candidates.limits_for(hand, CONFIG)
    assert hand.max_width / 2 - limits.max_offset == pytest.approx(0.08 / 2 - CONFIG.max_offset)
    assert hand.finger_depth - limits.max_depth == pytest.approx(PANDA.finger_depth - CONFIG.max_depth)
    farther = max(limits.max_offset - CONFIG.max_offset, limits.max_depth - CONFIG.max_depth, 0.0)
    assert limits.max_pair_distance == pytest.approx(CONFIG.max_pair_distance + farther)
    kept = ("min_depth", "min_offset", "max_upward", "support_clearance", "levelled_within_deg")
    assert all(getattr(limits, field) == getattr(CONFIG, field) for field in kept)


def test_without_a_support_nothing_is_too_low() -> None:
    query = ask(tabletop(0), viewpoints=CAMERA, up=UP)
    found, rejected = candidates.generate(prepared(query), query, CONFIG)
    assert rejected["support"] == 0
    assert torch.isinf(candidates.hand_clearance(prepared(query), found)).all()


def test_without_up_nothing_comes_from_behind_what_is_seen() -> None:
    query = ask(tabletop(0), viewpoints=CAMERA)
    ready_ = prepared(query)
    found, rejected = candidates.generate(ready_, query, CONFIG)
    towards_camera = exact(ready_.viewpoints[0]) - exact(ready_.points[found.approach])
    towards_camera /= np.linalg.norm(towards_camera, axis=1, keepdims=True)
    z = exact(found.Ts_canonical_grasp)[:, :3, 2]
    assert np.einsum("ij,ij->i", z, towards_camera).max() < 0.1 + ROUNDING
    assert rejected["from_below"] > 0


@pytest.mark.parametrize("angle", [0.0, 25.0, 90.0, 180.0])
def test_the_approach_cone_keeps_exactly_what_travels_within_it(angle: float) -> None:
    direction = np.array([0.3, 0.2, -1.0])
    found, rejected = every_candidate(approach=ApproachCone(direction, angle))
    everything, _ = every_candidate()
    z = exact(everything.Ts_canonical_grasp)[:, :3, 2] @ coarse().T_cloud_canonical.rotation.T
    inside = np.degrees(np.arccos(np.clip(z @ direction / np.linalg.norm(direction), -1, 1)))
    # The mask allows 1e-6 of the cosine: 0.1 degrees at the tip of the cone, nothing to speak of elsewhere.
    assert (inside <= angle - 0.1).sum() <= len(found) <= (inside <= angle + 0.1).sum()
    assert (rejected["approach"] == 0) == (angle == 180.0)


# The account


@functools.cache
def coarse() -> cloud.PreparedCloud:
    """A cloud so small that every point can be an approach point."""
    return prepared(tabletop_query(), voxel_size=0.014)


def every_candidate(config: CandidateConfig = CONFIG, **options: Any) -> tuple[Candidates, dict[str, int]]:
    query = tabletop_query(**{"num_approach_points": 1024, "max_candidates": 20_000, **options})
    return candidates.generate(coarse(), query, config)


def test_every_pair_is_a_candidate_or_counted_as_rejected() -> None:
    assert len(coarse()) < 1024
    found, rejected = every_candidate(approach=ApproachCone(-UP, 60.0))
    pairs, none = every_candidate(CandidateConfig(max_upward=2.0, support_clearance=-1.0))
    assert set(rejected) == {"support", "from_below", "approach", "target"}
    assert rejected.pop("target") == 0
    assert min(rejected.values()) > 0
    assert not any(none.values())
    assert len(found) + sum(rejected.values()) == len(pairs) < 20_000


def test_more_approach_points_are_tried_while_there_are_too_few_candidates() -> None:
    few, _ = generate({"num_approach_points": 1, "max_candidates": 1})
    many, _ = generate({"num_approach_points": 1, "max_candidates": 400})
    assert len(few) == 1
    assert 200 <= len(many) <= 400
    assert len(set(many.approach.tolist())) > 1


@pytest.mark.parametrize("limit", [1, 7, 300])
def test_at_most_max_candidates_are_kept_a_random_choice(limit: int) -> None:
    found, _ = every_candidate()
    few, _ = every_candidate(max_candidates=limit)
    pairs, chosen = (set(zip(c.approach.tolist(), c.contact.tolist(), strict=True)) for c in (found, few))
    assert len(chosen) == limit
    assert chosen <= pairs


def test_the_same_seed_gives_the_same_candidates_and_another_seed_others() -> None:
    queries = [replace(tabletop_query(), seed=seed) for seed in (3, 3, 4)]
    first, second, other = (candidates.generate(ready(), query, CONFIG)[0] for query in queries)
    assert torch.equal(first.Ts_canonical_grasp, second.Ts_canonical_grasp)
    assert set(first.approach.tolist()) != set(other.approach.tolist())


def test_candidates_are_selected_by_index_and_by_mask() -> None:
    found, _ = generate()
    mask = torch.arange(len(found)) % 3 == 0
    by_mask, by_index = found.select(mask), found.select(mask.nonzero()[:, 0])
    assert len(by_mask) == int(mask.sum())
    assert torch.equal(by_mask.Ts_canonical_grasp, by_index.Ts_canonical_grasp)
    assert torch.equal(by_mask.contact, found.contact[mask])


def test_candidates_know_their_hand_and_keep_their_widths_when_selected_and_joined() -> None:
    hand = HANDS["rg2"].gripper
    found, _ = generate({"gripper": hand})
    assert found.gripper == hand
    assert torch.equal(found.widths, torch.full((len(found),), hand.max_width))
    own = replace(found, widths=torch.arange(len(found)) / 1e3)
    few = own.select(torch.tensor([3, 1]))
    assert torch.equal(few.widths, torch.tensor([0.003, 0.001]))
    joined = few.joined_by(own)
    assert torch.equal(joined.widths, torch.cat([few.widths, own.widths]))
    assert joined.gripper == few.gripper == hand


def test_points_too_far_apart_make_no_pair() -> None:
    sparse = bare_cloud(np.random.default_rng(0).permutation(40)[:, None] * np.array([0.05, 0.0, 0.0]))
    found, _ = candidates.generate(sparse, ask(np.zeros((1, 3))), CONFIG)
    assert len(found) == 0
    assert found.Ts_canonical_grasp.shape == (0, 4, 4)


def test_the_axes_of_one_pair_are_those_drawn_in_the_conventions() -> None:
    """An approach point on a top face and a contact point 2 cm lower on the side that faces +y."""
    poses = candidates.grasp_poses(
        torch.tensor([[0.0, 0.0, 0.1]]), torch.tensor([[0.0, 0.03, 0.08]]), torch.tensor([[0.0, 1.0, 0.0]])
    )
    np.testing.assert_allclose(poses[0, :3, 2], [0, 0, -1], atol=1e-7)
    np.testing.assert_allclose(poses[0, :3, 1], [0, 1, 0], atol=1e-7)
    np.testing.assert_allclose(poses[0, :3, 0], [-1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(poses[0, :3, 3], [0, 0, 0.1 - (0.02 - 0.0016)], atol=1e-7)
    assert math.isclose(CONFIG.max_pair_distance, 0.038)


def test_hands_close_level_on_walls_that_are_nearly_upright_and_only_there() -> None:
    cloud_ = ready()
    assert cloud_.up is not None
    levelled = candidates.contact_normals(cloud_, CONFIG)
    tilt = torch.rad2deg(torch.asin((cloud_.normals @ cloud_.up).abs().clamp(max=1)))
    nearly = tilt < CONFIG.levelled_within_deg
    assert 0 < int(nearly.sum()) < len(cloud_)
    assert (levelled[~nearly] == cloud_.normals[~nearly]).all()
    torch.testing.assert_close(levelled[nearly] @ cloud_.up, torch.zeros(int(nearly.sum())), atol=1e-6, rtol=0)
    turned = torch.rad2deg(torch.acos((levelled * cloud_.normals).sum(dim=1).clamp(-1, 1)))[nearly]
    torch.testing.assert_close(turned, tilt[nearly], atol=0.1, rtol=0)
    assert candidates.contact_normals(replace(cloud_, up=None), CONFIG) is cloud_.normals


@pytest.mark.parametrize("height", [0.006, 0.008, 0.0105, 0.0125, 0.0135, 0.015, 0.0165])
def test_hands_come_straight_down_on_low_things(height: float) -> None:
    points, normals = box_surface((0.05, 0.07, height), 60_000, np.random.default_rng(0))
    seen = seen_from(points + height / 2 * UP, normals, CAMERA)
    query = ask(seen, viewpoints=CAMERA, up=UP, support_height=0.0)
    flat = prepared(query)
    found, rejected = candidates.generate(flat, query, CONFIG)
    assert rejected["support"] > 0
    assert flat.up is not None
    assert flat.support_height is not None
    up = exact(flat.up)
    straight = exact(found.Ts_canonical_grasp[:, :3, 2]) @ up < -0.9999
    assert straight.sum() > 100
    low = found.select(torch.from_numpy(straight))
    rotations = exact(low.Ts_canonical_grasp[:, :3, :3])
    np.testing.assert_allclose(rotations[:, :, 1] @ up, 0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-5)
    approach = exact(flat.points[low.approach]) @ up - flat.support_height
    contact = exact(flat.points[low.contact]) @ up - flat.support_height
    assert (approach - contact >= CONFIG.min_offset - 1e-6).all()
    tips = exact(low.Ts_canonical_grasp[:, :3, 3]) @ up - flat.support_height - PANDA.tip_offset
    np.testing.assert_allclose(tips, tips_over(approach, contact), atol=2e-4)
    assert (lowest_corner(flat, low) >= NEAREST - 1e-6).all()
    assert (approach - tips >= LEAST_REACH - 2e-5).all()


def tips_over(approach: Array, contact: Array) -> Array:
    """Where the tips of hands that come straight down stop, by heights over the support: 7 mm past the contact point.

    4 mm over the support at the lowest, or 5 mm past the approach point, or 1.5 mm over the support.
    """
    lowest: Array = np.maximum(contact - 0.007, np.minimum(np.maximum(approach - 0.005, 0.0015), 0.004))
    return lowest


def card(options: dict[str, Any] | None = None) -> tuple[cloud.PreparedCloud, Candidates]:
    """A box so low that all pairs on it are shallow, few enough points to try each, and the candidates on it."""
    points, normals = box_surface((0.05, 0.07, 0.0125), 60_000, np.random.default_rng(0))
    seen = seen_from(points + 0.00625 * UP, normals, CAMERA)
    given = {"viewpoints": CAMERA, "up": UP, "support_height": 0.0, "num_approach_points": 1024}
    query = ask(seen, **{**given, "max_candidates": 20_000, **(options or {})})
    flat = prepared(query, voxel_size=0.006)
    assert len(flat) < 1024
    return flat, candidates.generate(flat, query, CONFIG)[0]


@pytest.mark.parametrize("hand", [PANDA, HANDS["hand_e"].gripper, PANDA.with_sizes({"max_width": 0.05})])
@pytest.mark.parametrize("cone", [None, ApproachCone(-UP, 20.0), ApproachCone(UP, 20.0)])
def test_shallow_pairs_are_those_of_a_double_loop(
    hand: Gripper, cone: ApproachCone | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs less deep than `min_depth`, closing level along the wall's normal and coming straight down, in float64."""
    nothing = torch.empty(0, dtype=torch.long)
    monkeypatch.setattr(candidates, "outline", lambda *_: Outline(nothing, torch.empty(0, 3), torch.empty(0, 3)))
    flat, found = card({"gripper": hand, "approach": cone})
    assert flat.up is not None
    assert flat.support_height is not None
    up, points, normals = exact(flat.up), exact(flat.points), exact(flat.normals)
    limits = candidates.limits_for(hand, CONFIG)
    rise = normals @ up
    level = normals - rise[:, None] * up
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-12)
    certain: dict[tuple[int, int], float] = {}
    possible: dict[tuple[int, int], float] = {}
    for c in np.flatnonzero(np.abs(rise) < 0.95):
        d = points[c] - points
        depth, along = -(d @ up), d @ level[c]
        aside = np.sqrt(np.clip((d**2).sum(axis=1) - depth**2 - along**2, 0, None))
        margins = [
            limits.max_pair_distance - np.linalg.norm(d, axis=1), depth, limits.min_depth - depth,
            along - limits.min_offset, limits.max_offset - along, 0.005 - aside,
        ]  # fmt: skip
        least = np.min(margins, axis=0)
        top = points @ up - flat.support_height
        tips = tips_over(top, top - depth)
        short = tips - (top - depth - 0.007)
        reach = np.minimum.reduce([top - tips - 0.003, 0.007 - short, rise - 0.5, 0.017 - top, np.full(len(d), 0.001)])
        certain |= {(int(a), int(c)): float(tips[a]) for a in np.flatnonzero(np.minimum(least, reach) > 1e-4)}
        possible |= {(int(a), int(c)): float(tips[a]) for a in np.flatnonzero(np.minimum(least, reach) > -1e-4)}
    straight = exact(found.Ts_canonical_grasp[:, :3, 2]) @ up < -0.9999
    depths = exact(flat.points[found.approach] - flat.points[found.contact]) @ up
    shallow = found.select(torch.from_numpy(straight & (depths < limits.min_depth)))
    if cone is not None and cone.direction[2] > 0:
        assert len(shallow) == 0
        return
    pairs = list(zip(shallow.approach.tolist(), shallow.contact.tolist(), strict=True))
    assert len(certain) > 50
    assert set(certain) <= set(pairs) <= set(possible)
    tips = exact(shallow.Ts_canonical_grasp[:, :3, 3]) @ up - flat.support_height - hand.tip_offset
    np.testing.assert_allclose(tips, [possible[pair] for pair in pairs], atol=2e-4)
    closing = exact(shallow.Ts_canonical_grasp[:, :3, 1])
    np.testing.assert_allclose(closing, level[shallow.contact.numpy()], atol=1e-4)


def test_shallow_pairs_are_sought_on_low_faces_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, "_low_walls", lambda *_: pytest.fail("no face is low"))
    found, _ = generate()
    assert len(found) >= 100


def test_a_thing_too_low_for_the_tips_has_no_candidates() -> None:
    points, normals = box_surface((0.05, 0.07, 0.0052), 60_000, np.random.default_rng(0))
    seen = seen_from(points + 0.0026 * UP, normals, CAMERA)
    query = ask(seen, viewpoints=CAMERA, up=UP, support_height=0.0)
    for error, some in ((0.0, True), (0.004, False)):  # tips 4 mm over the plane reach 1.2 mm past the face
        found, _ = candidates.generate(replace(prepared(query), support_error=error), query, CONFIG)
        assert (len(found) > 0) is some


@pytest.mark.parametrize("height", [0.003, 0.004, 0.005, 0.007])
@pytest.mark.parametrize("polar_deg", [0.5, 45.0])
def test_a_thing_of_three_millimetres_is_taken_where_its_table_is_seen(height: float, polar_deg: float) -> None:
    thing = Slab((0.0, 0.0, 0.0), (0.06, 0.04, height), 30.0)
    query = overhead_query((thing,), around(1, polar_deg), max_candidates=20_000)
    ready = prepared(query, smooth_above=0.0011)
    found, _ = candidates.generate(ready, query, CONFIG)
    assert len(found) > 20
    heights = ready.T_cloud_canonical.apply(exact(ready.points))[:, 2]
    assert heights.min() > 0.0015  # of the table nothing is left
    tips = ready.T_cloud_canonical.apply(exact(found.Ts_canonical_grasp[:, :3, 3]))[:, 2] - PANDA.tip_offset
    assert (tips >= NEAREST - 1e-4).all()
    assert (tips <= height - LEAST_REACH + 1.5e-3).all()


@pytest.mark.parametrize("height", [0.011, 0.04, 0.12])
def test_hands_come_straight_down_over_the_edges_of_a_face_seen_from_above(height: float) -> None:
    query = overhead_query((Slab((0.0, 0.0, 0.0), (0.06, 0.04, height)),), max_candidates=20_000)
    cloud = prepared(query)
    found, rejected = candidates.generate(cloud, query, CONFIG)
    assert set(rejected) == {"from_below", "approach", "support", "target"}
    frame = cloud.T_cloud_canonical
    # Over a high face there are pairs for hands that come from the side, too: one finger above, one beneath.
    found = found.select(found.Ts_canonical_grasp[:, 2, 2] < -0.9999)
    assert len(found) > 100
    rotations = frame.rotation @ exact(found.Ts_canonical_grasp[:, :3, :3])
    np.testing.assert_allclose(rotations[:, :, 2], np.tile(-UP, (len(found), 1)), atol=1e-5)
    contact, approach = (frame.apply(exact(cloud.points[index])) for index in (found.contact, found.approach))
    assert ((np.array([0.03, 0.02]) - np.abs(contact[:, :2])).min(axis=1) < 0.006).all()
    outward = (rotations[:, :, 1] * (contact - approach)).sum(axis=1)
    assert (outward >= CONFIG.min_offset - 1e-6).all()
    tips = frame.apply(exact(found.Ts_canonical_grasp[:, :3, 3]))[:, 2] - PANDA.tip_offset
    np.testing.assert_allclose(tips, np.maximum(contact[:, 2] - 0.007, CONFIG.support_clearance), atol=2e-5)
    free = ~collision.blocked(cloud, found, "free")
    assert int(free.sum()) > 20


def without_outline(monkeypatch: pytest.MonkeyPatch, cloud_: cloud.PreparedCloud) -> None:
    nothing = torch.empty(0, dtype=torch.long)
    none = Outline(nothing, cloud_.points[nothing], cloud_.points[nothing])
    monkeypatch.setattr(candidates, "outline", lambda *_: none)


def test_the_outline_joins_the_pairs_where_both_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a bowl an overhead camera sees the inner wall, of the box beside it none."""
    query = overhead_query(
        (Slab((-0.05, 0.0, 0.0), (0.05, 0.04, 0.06)), Bowl((0.06, 0.0, 0.0), 0.035, 0.004)), max_candidates=20_000
    )
    ready_ = prepared(query)
    edges = outline(ready_, query)
    both, _ = candidates.generate(ready_, query, CONFIG)
    without_outline(monkeypatch, ready_)
    pairs, _ = candidates.generate(ready_, query, CONFIG)
    assert 100 < len(pairs) < len(both) - 100
    assert torch.equal(both.Ts_canonical_grasp[: len(pairs)], pairs.Ts_canonical_grasp)
    assert set(both.contact[len(pairs) :].tolist()) <= set(edges.points.tolist())


def test_what_is_rejected_of_the_outline_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    query = overhead_query((Slab((0.0, 0.0, 0.0), (0.06, 0.04, 0.05)),))
    sideways = replace(query, approach=ApproachCone(np.array([1.0, 0.0, 0.0]), 30.0))
    ready_ = prepared(query)
    both, rejected = candidates.generate(ready_, sideways, CONFIG)
    without_outline(monkeypatch, ready_)
    pairs, of_pairs = candidates.generate(ready_, sideways, CONFIG)
    assert torch.equal(both.Ts_canonical_grasp, pairs.Ts_canonical_grasp)
    assert rejected["approach"] > of_pairs["approach"] + 100
    assert {**rejected, "approach": 0} == {**of_pairs, "approach": 0}


def test_without_up_edges_make_candidates_for_want_of_others_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    query = ask(tabletop(), viewpoints=CAMERA)
    ready_ = prepared(query)
    monkeypatch.setattr(candidates, "outline", lambda *_: pytest.fail("there are other candidates"))
    found, _ = candidates.generate(ready_, query, CONFIG)
    assert len(found) == query.max_candidates


@pytest.mark.parametrize("name", HANDS)
def test_at_rest_the_tips_lie_7_mm_past_the_contact_point(name: str) -> None:
    """However wide the hand arrived; of tips that slide that is where they arrived."""
    hand = HANDS[name].gripper
    rng = np.random.default_rng(8)
    points = torch.from_numpy(rng.uniform(-0.02, 0.02, (20, 3))).float()
    cloud = bare_cloud(points.numpy())
    pair = torch.zeros(19, dtype=torch.long), torch.arange(1, 20)
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(19, 3))).float(), dim=1)
    poses = candidates.grasp_poses(points[pair[0]], points[pair[1]], normals, hand=hand)
    found = candidates.Candidates(*pair, poses, candidates.wide_open(poses, hand), hand)
    rest = candidates.at_rest(cloud, found).Ts_canonical_grasp
    past = (rest[:, :3, 3] + hand.tip_offset * rest[:, :3, 2] - cloud.points[pair[1]]) * rest[:, :3, 2]
    np.testing.assert_allclose(past.sum(dim=1).numpy(), 0.007, atol=1e-6)
    assert torch.equal(rest[:, :3, :3], poses[:, :3, :3])
    if hand.linkage_length is None:
        assert torch.equal(rest, poses)


@given(st.floats(0.01, 0.2), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
@settings(deadline=None)
def test_a_hand_is_told_micrometres_and_no_more_than_it_opens(widest: float, shares: list[float]) -> None:
    hand = replace(PANDA, max_width=widest)
    widths = torch.tensor([share * widest for share in [*shares, 1.0]])
    nowhere = torch.zeros(len(widths), dtype=torch.long)
    told = Candidates(nowhere, nowhere, torch.eye(4).expand(len(widths), 4, 4), widths, hand).openings()
    assert told.dtype == np.float64
    assert (told <= widest).all()
    assert np.abs(told - exact(widths)).max() < 1e-6
    assert all(opening in (widest, round(opening, 6)) for opening in told.tolist())
