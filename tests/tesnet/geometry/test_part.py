"""Parts against their definition, and what follows from them against a twin that tests planes of their convex hulls."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tesnet import collision
from tesnet.geometry import PANDA, Extent, Gripper, Part
from tesnet.geometry.part import ROUNDED
from tesnet.networks import around_hand

Array = NDArray[np.float64]

ROUNDING = 1e-6


def depth(points: Array, part: Part, width: float) -> Array:
    """(P,) how deep, in metres, points lie in the convex hull of a part's corners; negative outside."""
    planes = ConvexHull(part.corners(width)).equations
    return np.asarray(-(points @ planes[:, :3].T + planes[:, 3]).max(axis=1))


def depth_in_hand(points: Array, hand: Gripper, width: float) -> Array:
    return np.asarray(np.max([depth(points, part, width) for part in hand.parts], axis=0))


@st.composite
def hands(draw: st.DrawFn) -> Gripper:
    """Hands of many shapes."""

    def length(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    thickness, breadth, palm = length(0.005, 0.04), length(0.008, 0.04), length(0.02, 0.1)
    depth = length(0.03, 0.1)
    return Gripper(
        max_width=length(0.03, 0.16),
        finger_depth=depth,
        finger_thickness=thickness,
        finger_tip_thickness=thickness * length(0.2, 1),
        finger_taper=(depth - 0.004) * length(0.2, 1),
        finger_breadth=breadth,
        finger_tip_breadth=breadth * length(0.4, 1),
        palm_depth=0.1,
        palm_length=length(0.05, 0.2),
        palm_breadth=palm,
        palm_front_breadth=palm * length(0.3, 1),
        palm_taper=length(0.01, 0.1),
    )


def test_an_extent_grows_evenly_from_the_front_and_then_stays() -> None:
    extent = Extent(full=0.03, front=0.01, taper=0.02)
    assert [extent.at(behind) for behind in (0.0, 0.005, 0.02, 0.5)] == pytest.approx([0.01, 0.015, 0.03, 0.03])
    assert {Extent.constant(0.04).at(behind) for behind in (0.0, 0.1)} == {0.04}


def test_a_part_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        PANDA.parts[0].front = 0.0  # type: ignore[misc]


@given(hand=hands(), share=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_no_corner_of_a_part_lies_within_the_hull_of_the_others(hand: Gripper, share: float) -> None:
    for part in hand.parts:
        corners = part.corners(share * hand.max_width)
        assert depth(corners, part, share * hand.max_width).max() < ROUNDING


@given(hand=hands(), share=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_fingers_stand_half_the_opening_to_either_side_and_mirror_each_other(hand: Gripper, share: float) -> None:
    width = share * hand.max_width
    left, right, palm = (part.corners(width) for part in hand.parts)
    assert left[:, 1].min() == pytest.approx(width / 2)
    assert {tuple(corner) for corner in left.round(9)} == {tuple(corner) for corner in (right * [1, -1, 1]).round(9)}
    np.testing.assert_array_equal(palm, hand.parts[2].corners(0.0))


@given(hand=hands(), seed=st.integers(0, 2**31), share=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_the_collision_check_finds_what_lies_in_a_part(hand: Gripper, seed: int, share: float) -> None:
    """But for the rounding of the tips, which it leaves out."""
    width, sharp = share * hand.max_width, dataclasses.replace(hand, finger_tip_breadth=hand.finger_breadth)
    points = np.random.default_rng(seed).uniform([-0.05, -0.12, -0.16], [0.05, 0.12, 0.02], (400, 3))
    poses = torch.eye(4)[None].repeat(400, 1, 1)
    poses[:, :3, 3] = -torch.from_numpy(points).float()  # one point at the origin, and a hand for each place
    found = collision.in_collision(torch.zeros(1, 3), poses, hand, width, approach_distance=0.0).numpy()
    inside = depth_in_hand(points, sharp, width)
    certain = np.abs(inside) > ROUNDING
    np.testing.assert_array_equal(found[certain], inside[certain] > 0)
    rounded = depth_in_hand(points, hand, width)
    assert (points[(rounded < -ROUNDING) & (inside > 0), 2] > hand.tip_offset - ROUNDED).all()


@given(hand=hands(), share=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_the_samples_for_the_shadow_lie_in_their_part(hand: Gripper, share: float) -> None:
    width = share * hand.max_width
    for part in hand.parts:
        places = np.array(collision._samples(part)) + np.array([0.0, part.side * width / 2, 0.0])
        assert depth(places, part, width).min() > -ROUNDING
        assert np.ptp(places, axis=0).max() > 0.8 * min(part.front - part.back, part.thickness.full)


def test_the_networks_probes_lie_in_and_before_the_open_hand() -> None:
    probes = around_hand.probes(PANDA).open.double().numpy()
    ends = around_hand.ends(PANDA).open.double().numpy()
    fingers, between, ahead, behind = np.split(probes, [60, 90, 95])
    by_part = [depth(fingers, part, PANDA.max_width) for part in PANDA.parts[:2]]
    # Probes at the outside of the tapered finger lie up to 10 mm beside it.
    assert np.max(by_part, axis=0).min() > -0.0101
    assert depth_in_hand(between, PANDA, PANDA.max_width).max() < 0
    assert (ahead[:, 2] > PANDA.tip_offset).all()
    assert depth(behind, PANDA.parts[2], 0.0).min() > -0.005
    assert depth_in_hand(ends[1:], PANDA, PANDA.max_width).min() > -ROUNDING


def corners_of_sections(part: dict[str, Any], width: float) -> Array:
    """What a reader of `/model` makes of a part."""
    rows = []
    for section in part["sections"]:
        half, thick = section["breadth"] / 2, section["thickness"]
        inner = part["side"] * width / 2 if part["side"] else -thick / 2
        outer = inner + (part["side"] or 1) * thick
        rows += [(x, y, section["z"]) for y in (inner, outer) for x in (-half, half)]
    return np.array(rows)


@given(hand=hands(), share=st.floats(0, 1))
@settings(max_examples=10, deadline=None)
def test_sections_and_sides_say_all_of_a_part(hand: Gripper, share: float) -> None:
    for part in hand.parts:
        said = {"side": part.side, "sections": [dataclasses.asdict(section) for section in part.sections]}
        np.testing.assert_allclose(
            corners_of_sections(said, share * hand.max_width), part.corners(share * hand.max_width), atol=1e-12
        )
