from __future__ import annotations

import functools
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch

from tesnet import centring, fitting
from tesnet.candidates import (
    CandidateConfig,
    Candidates,
    at_rest,
    clear_of_support,
    contact_places,
    generate,
    hand_clearance,
)
from tesnet.cloud import PreparedCloud
from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from tesnet.outline import is_low
from tesnet.search import search
from tests.tesnet.scenes import UP, Array, ask, bare_cloud, prepared, tabletop_query

BY_RULES = CandidateConfig(centring=None)

ABOVE = np.array([0.05, -0.1, 0.6])


def slab(width: float, seed: int = 0, *, far_wall: bool = True) -> tuple[PreparedCloud, Array]:
    """A bar along x, as wide along y as it says and 4 cm high: its top and the wall at +y, and the other if wanted."""
    rng = np.random.default_rng(seed)
    count = 6000
    top = np.column_stack(
        [rng.uniform(-0.06, 0.06, count), rng.uniform(-width / 2, width / 2, count), np.full(count, 0.04)]
    )
    walls = [
        np.column_stack(
            [rng.uniform(-0.06, 0.06, count), np.full(count, side * width / 2), rng.uniform(0.012, 0.04, count)]
        )
        for side in ((1.0, -1.0) if far_wall else (1.0,))
    ]
    points = np.concatenate([top, *walls])
    viewpoints = [[0.0, 0.5, 0.5], [0.0, -0.5, 0.5]] if far_wall else [[0.0, 0.5, 0.5]]
    return prepared(ask(points, viewpoints=viewpoints, up=UP, support_height=0.0)), points


def towards_y(cloud: PreparedCloud, hand: Gripper = PANDA, *, centred: bool = True, width: str = "full") -> Candidates:
    """Candidates that close along y on the bar from above, in the frame of its cloud."""
    query = ask(np.zeros((1, 3)), up=UP, support_height=0.0, gripper=hand, width=width, num_approach_points=64)
    found = search(cloud, query, replace(BY_RULES, centred=centred)).candidates
    Ts = cloud.T_cloud_canonical.matrix @ found.Ts_canonical_grasp.double().numpy()
    return found.select(torch.from_numpy((np.abs(Ts[:, 1, 1]) > 0.99) & (Ts[:, 2, 2] < -0.99)))


def places(cloud: PreparedCloud, found: Candidates) -> Array:
    """(C, 3) TCPs in the frame of the bar."""
    Ts: Array = cloud.T_cloud_canonical.matrix @ found.Ts_canonical_grasp.double().numpy()
    return Ts[:, :3, 3]


@pytest.mark.parametrize("width", [0.02, 0.045, 0.07])
@pytest.mark.parametrize("far_wall", [True, False])
def test_hands_stand_midway_between_walls_seen_or_guessed(width: float, far_wall: bool) -> None:
    cloud, _ = slab(width, far_wall=far_wall)
    found = towards_y(cloud)
    off = places(cloud, found)[:, 1]
    assert len(found) > 40
    assert np.abs(np.median(off)) < 0.0015
    assert np.quantile(np.abs(off), 0.9) < 0.004
    aside = places(cloud, towards_y(cloud, centred=False))[:, 1]
    assert np.quantile(np.abs(aside), 0.9) > 0.15 * width  # what the rule is for


def test_a_fitted_hand_opens_by_what_it_holds_and_a_margin_and_never_wider_than_it_can() -> None:
    for width in (0.02, 0.045, 0.075):
        cloud, _ = slab(width)
        found = towards_y(cloud, width="fitted")
        wanted = min(width + 2 * fitting.MARGIN, PANDA.max_width)
        assert np.abs(np.median(found.widths.numpy()) - wanted) < 0.004
        assert float(found.widths.max()) <= PANDA.max_width + 1e-9
        assert (found.openings() <= PANDA.max_width).all()
        assert (towards_y(cloud).widths == torch.tensor(PANDA.max_width)).all()


def test_a_thing_beyond_a_gap_is_another_one() -> None:
    """A second bar, a finger's breadth behind the first, moves no hand; where it touches the first it does."""
    alone, points = slab(0.03)
    middle = np.median(places(alone, towards_y(alone))[:, 1])
    for distance, moved in ((0.024, False), (0.004, True)):
        other = points[points[:, 2] > 0.035] * [1, 0.3, 1] - [0, 0.015 + distance + 0.005, 0]
        viewpoints = [[0.0, 0.5, 0.5], [0.0, -0.5, 0.5]]
        cloud = prepared(ask(np.vstack([points, other]), viewpoints=viewpoints, up=UP, support_height=0.0))
        found = towards_y(cloud)
        on_near_wall = exact_y(cloud, found) > 0.01
        shift = np.median(places(cloud, found)[on_near_wall, 1]) - middle
        assert (abs(shift) > 0.004) == moved


def exact_y(cloud: PreparedCloud, found: Candidates) -> Array:
    """(C,) where the contact points lie along y."""
    y: Array = cloud.T_cloud_canonical.apply(cloud.points[found.contact].double().numpy())[:, 1]
    return y


def test_the_far_side_of_a_curve_is_that_of_its_circle() -> None:
    """A lying cylinder that a camera sees from one side, up to where its surface turns away."""
    radius = 0.025
    rng = np.random.default_rng(1)
    angle = rng.uniform(np.radians(-20), np.radians(120), 8000)
    points = np.column_stack([rng.uniform(-0.06, 0.06, 8000), radius * np.cos(angle), 0.04 + radius * np.sin(angle)])
    cloud = prepared(ask(points, viewpoints=[[0.0, 0.6, 0.4]], up=UP, support_height=0.0))
    found = towards_y(cloud)
    assert len(found) > 20
    assert np.abs(np.median(places(cloud, found)[:, 1])) < 0.003


@pytest.mark.parametrize("name", ["robotiq_2f85", "rg2"])
def test_tips_that_swing_come_to_rest_where_those_of_a_parallel_hand_would(name: str) -> None:
    """However wide the hand arrives: the base link then stands where its tips, closed on the bar, are as deep."""
    hand = HANDS[name].gripper
    cloud, _ = slab(0.03)
    bases = {}
    for width in ("full", "fitted"):
        found = towards_y(cloud, hand, width=width)
        Ts = found.Ts_canonical_grasp.double().numpy()
        base = Ts[:, :3, 3] - hand.tcp_at(found.widths.double().numpy())[:, None] * Ts[:, :3, 2]
        bases[width] = dict(zip(zip(found.approach.tolist(), found.contact.tolist(), strict=True), base, strict=True))
    both = bases["full"].keys() & bases["fitted"].keys()
    assert len(both) > 10
    apart = np.array([np.linalg.norm(bases["full"][pair] - bases["fitted"][pair]) for pair in both])
    assert np.mean(apart < 1e-5) > 0.9  # but where it would come too low midway between the walls


@pytest.mark.parametrize("name", ["franka", "rg2", "wsg50"])
def test_what_lies_between_the_fingers_is_what_each_pose_by_itself_has_there(name: str) -> None:
    """Within half a finger's breadth and 3 mm of the middle plane, from the palm to the tips, past the near wall."""
    hand = HANDS[name].gripper
    query = tabletop_query(max_candidates=40, gripper=hand)
    cloud = prepared(query)
    found, _ = generate(cloud, query, BY_RULES)
    near = contact_places(cloud, found)
    rows, y, n = (part.numpy() for part in fitting._between_fingers(cloud, found, near))
    points, normals = cloud.points.double().numpy(), cloud.normals.double().numpy()
    seen = 0
    for row, T in enumerate(found.Ts_canonical_grasp.double().numpy()):
        local = (points - T[:3, 3]) @ T[:3, :3]
        wall = local[int(found.contact[row]), 1]
        margin = np.min(
            [
                hand.finger_breadth / 2 + 0.003 - np.abs(local[:, 0]),
                hand.tip_offset - local[:, 2],
                local[:, 2] - hand.palm_front,
                wall + 0.002 - local[:, 1],
                local[:, 1] - wall + hand.max_width,
            ],
            axis=0,
        )
        inside, certain = margin > 0, np.abs(margin) > 1e-6
        seen += int(inside.sum())
        expected, told = (np.sort(values) for values in (local[inside & certain, 1], y[rows == row]))
        assert len(expected) <= len(told) <= len(expected) + int((~certain).sum())
        if len(expected) == len(told):
            np.testing.assert_allclose(told, expected, atol=1e-6)
            along = np.sort((normals @ T[:3, 1])[inside & certain])
            np.testing.assert_allclose(np.sort(n[rows == row]), along, atol=1e-5)
        assert float(near[row]) == pytest.approx(wall, abs=1e-6)
    assert seen > 900


@pytest.mark.parametrize("name", ["franka", "rg2", "robotiq_2f140"])
@pytest.mark.parametrize("policy", ["fitted", "full"])
def test_a_hand_too_low_midway_stops_short_or_keeps_its_place(name: str, policy: Literal["fitted", "full"]) -> None:
    """Low things. Whatever was done: clear of the support, tips no less deep than the contact, as wide as was asked."""
    hand, config, stayed = HANDS[name].gripper, BY_RULES, 0
    for seed in range(3):
        query = tabletop_query(seed, max_candidates=800, gripper=hand)
        cloud = prepared(query)
        found, _ = generate(cloud, query, BY_RULES)
        placed = fitting.fitted(cloud, found, config, policy=policy)
        clearance = hand_clearance(cloud, placed)
        assert float(clearance.min()) >= 0.0015 - 2e-5
        rest = at_rest(cloud, placed).Ts_canonical_grasp
        moved = placed.Ts_canonical_grasp - found.Ts_canonical_grasp
        aside = (moved[:, :3, 3] * found.Ts_canonical_grasp[:, :3, 1]).sum(dim=1).abs() > 1e-6
        past = ((rest[:, :3, 3] - cloud.points[placed.contact]) * rest[:, :3, 2]).sum(dim=1) + hand.tip_offset
        assert float(past[aside].min()) >= -2e-5
        assert float(past.max()) <= 0.007 + 2e-5
        stayed += int((~aside).sum())
        if policy == "full":
            assert torch.equal(placed.widths, found.widths)
        else:
            assert float((placed.widths < hand.max_width).double().mean()) > 0.3
    assert stayed > 0


def test_a_hand_that_stays_where_it_is_opens_by_what_it_will_hold_all_the_same() -> None:
    """Only where even that is too low it arrives wide open."""
    hand, config = HANDS["rg2"].gripper, BY_RULES
    query = tabletop_query(1, max_candidates=2000, gripper=hand)
    cloud = prepared(query)
    found, _ = generate(cloud, query, BY_RULES)
    placed = fitting.fitted(cloud, found, config, policy="fitted")
    apart = (placed.Ts_canonical_grasp - found.Ts_canonical_grasp)[:, :3, 3]
    in_place = (apart * found.Ts_canonical_grasp[:, :3, 1]).sum(dim=1).abs() < 1e-6
    narrower = placed.widths < hand.max_width - 1e-6
    assert int((in_place & narrower).sum()) > 0
    _, low = clear_of_support(cloud, found, config)
    assert not bool(low.any())


@pytest.mark.parametrize("width", [0.104, 0.08, 0.07])
def test_what_swinging_tips_will_hold_is_looked_for_where_they_rest(width: float) -> None:
    """A block 50 mm wide between the tips at rest, 30 mm ahead of where the wide open RG2's are: however it arrives."""
    hand = HANDS["rg2"].gripper
    y, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.025, 0.025, 26), np.linspace(-0.012, 0.012, 13)))
    points = np.stack([np.zeros_like(y), y, z], axis=1)
    cloud = bare_cloud(points, np.array([[0.0, 0.0, -0.6]]))
    contact = int(np.flatnonzero((np.abs(y - 0.025) < 1e-9) & (np.abs(z) < 1e-9))[0])
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = -(hand.tcp_at(0.05) - hand.tcp_at(width))
    pair = torch.tensor([0]), torch.tensor([contact])
    candidate = Candidates(*pair, pose, torch.tensor([width]), hand)
    placed = fitting.fitted(cloud, candidate, BY_RULES, policy="fitted")
    assert float(placed.widths[0]) == pytest.approx(0.05 + 2 * 0.014, abs=0.004)
    assert float(at_rest(cloud, placed).Ts_canonical_grasp[0, 2, 3]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("name", ["franka", "rg2"])
@pytest.mark.parametrize("policy", ["fitted", "full"])
@pytest.mark.parametrize("centred", [False, True])
def test_a_hand_has_the_opening_of_the_place_where_it_stands(
    name: str, policy: Literal["fitted", "full"], centred: bool
) -> None:
    """Midway if that is clear of the support, else in place, else as it was found: pose and width from one of them."""
    hand, config = HANDS[name].gripper, replace(BY_RULES, centred=centred)
    elsewhere = 0
    for seed in range(2):
        query = tabletop_query(seed, max_candidates=800, gripper=hand)
        cloud = prepared(query)
        found, _ = generate(cloud, query, BY_RULES)
        span = fitting.spans(cloud, at_rest(cloud, found))
        expected = found
        for midway in (False, True):
            if centred if midway else policy == "fitted":
                shift = (span.near + span.far) / 2 if midway else torch.zeros(len(found))
                opens = span if policy == "fitted" else None
                moved, low = clear_of_support(cloud, fitting._moved(found, span.near, shift, opens), config)
                rows = [
                    moved.select(torch.tensor([row])) if not low[row] else expected.select(torch.tensor([row]))
                    for row in range(len(found))
                ]
                elsewhere += int((low & (moved.widths != expected.widths)).sum())
                expected = functools.reduce(Candidates.joined_by, rows)
        placed = fitting.fitted(cloud, found, config, policy=policy)
        assert torch.equal(placed.widths, expected.widths)
        assert torch.equal(placed.Ts_canonical_grasp, expected.Ts_canonical_grasp)
        assert torch.equal(placed.contact, found.contact)
    assert policy == "full" or not centred or elsewhere > 0


def test_no_wall_is_guessed_more_than_20_mm_beyond_what_was_seen() -> None:
    radius, last = 0.037, np.radians(108)
    rng = np.random.default_rng(1)
    angle = rng.uniform(np.radians(-20), last, 12_000)
    points = np.column_stack([rng.uniform(-0.06, 0.06, 12_000), radius * np.cos(angle), 0.05 + radius * np.sin(angle)])
    cloud = prepared(ask(points, viewpoints=[[0.0, 0.6, 0.4]], up=UP, support_height=0.0))
    found = towards_y(cloud, centred=False)
    span = fitting.spans(cloud, found)
    far = exact_y(cloud, found) - (span.near - span.far).double().numpy()
    seen = radius * np.cos(last)
    assert far.min() >= seen - 0.02 - 0.002
    assert (far < seen - 0.02 + 0.002).mean() > 0.3  # though the circle ends 26 mm beyond it


@pytest.mark.parametrize("policy", ["fitted", "full"])
def test_hands_on_low_things_go_by_rules_whatever_was_learned(policy: Literal["fitted", "full"]) -> None:
    """Of the others each stands where the network has it; both are found beside each other."""
    query = tabletop_query(1, max_candidates=800)
    cloud = prepared(query)
    found, _ = generate(cloud, query, BY_RULES)
    low = is_low(cloud)[found.contact]
    assert 10 < int(low.sum()) < len(found) - 10
    resting = at_rest(cloud, found)
    span = fitting.spans(cloud, resting)
    shift = fitting._to_middle(cloud, resting, span if policy == "fitted" else None, "1")
    rules = (span.near + span.far) / 2
    torch.testing.assert_close(shift[low], rules[low])
    learned = centring.shipped("1", torch.device("cpu")).shifts(centring.seen_between(cloud, resting), cloud, resting)
    torch.testing.assert_close(shift[~low], learned[~low])
    assert float((learned - rules).abs().median()) > 1e-4
    placed = fitting.fitted(cloud, found, replace(BY_RULES, centring="1"), policy=policy)
    by_rules = fitting.fitted(cloud, found, BY_RULES, policy=policy)
    assert torch.equal(placed.Ts_canonical_grasp[low], by_rules.Ts_canonical_grasp[low])
    assert torch.equal(placed.widths[low], by_rules.widths[low])
