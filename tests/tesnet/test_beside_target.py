"""A hand that is to grasp one thing closes on no other: what lies farther out between its fingers is of that one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tesnet.beside_target import MARGIN, closes_on_others
from tesnet.geometry import PANDA, Box, GraspSet, Pose
from tests.tesnet.scenes import CAMERA, Array, ask, bare_cloud, box_surface, fresh_predictor, open_hands, seen_from

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("others", "closes"),
    [
        ([(0.0, 0.025, 0.0), (0.0, 0.027, 0.0)], True),
        ([(0.0, -0.025, 0.0), (0.0, -0.027, 0.0)], True),
        ([(0.0, 0.025, 0.0)], False),  # one point alone
        ([(0.0, 0.01 + MARGIN / 2, 0.0), (0.002, 0.01 + MARGIN / 2, 0.0)], False),  # a mark that ends early
        ([(0.0, 0.0, 0.0), (0.0, 0.005, 0.0)], False),  # amid the target
        ([(0.0, 0.045, 0.0), (0.0, 0.047, 0.0)], False),  # outside the open hand
        ([(0.015, 0.025, 0.0), (0.015, 0.027, 0.0)], False),  # beside the pads
        ([(0.0, 0.025, 0.02), (0.0, 0.027, 0.02)], False),  # under the fingertips
    ],
)
def test_what_lies_farther_out_between_the_fingers_is_closed_on(
    others: list[tuple[float, float, float]], closes: bool
) -> None:
    target = [(0.0, y, 0.0) for y in np.linspace(-0.01, 0.01, 9)]
    on_target = torch.arange(len(target) + len(others)) < len(target)
    cloud = replace(bare_cloud(np.array([*target, *others])), on_target=on_target)
    hands = open_hands(torch.eye(4).repeat(3, 1, 1))
    assert closes_on_others(cloud, hands).tolist() == [closes] * 3


def two_blocks() -> tuple[Array, NDArray[np.bool_]]:
    """Points of two upright blocks, 14 mm wide and 5 mm apart, and which are of the first."""
    rng = np.random.default_rng(0)
    parts, blocks = [], []
    for number, y in enumerate((-0.0095, 0.0095)):
        points, normals = box_surface((0.06, 0.014, 0.07), 12_000, rng)
        parts.append((points + np.array([0.0, y, 0.035]), normals))
        blocks.append(np.full(len(points), number == 0))
    points, normals = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    seen = seen_from(points, normals, CAMERA)
    order = {tuple(point): index for index, point in enumerate(points)}
    return seen, np.concatenate(blocks)[[order[tuple(point)] for point in seen]]


def grasps_of(points: Array, target: Any) -> tuple[GraspSet, int]:
    """Grasps, and how many were rejected for the target."""
    query = ask(
        points, viewpoints=CAMERA, up=UP, support_height=0.0, target=target, max_grasps=1000,
        separation_translation=0.0, max_candidates=3000,
    )  # fmt: skip
    result = fresh_predictor().predict(query)
    return result.grasps, result.counts.rejected["target"]


def on_both(grasps: GraspSet, points: Array, first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(M,) whether points of both blocks lie between the pads."""
    found = []
    for pose in grasps.Ts_cloud_grasp:
        x, y, z = Pose.from_matrix(pose).inverse().apply(points).T
        inside = (np.abs(x) < PANDA.finger_tip_breadth / 2) & (np.abs(y) < 0.04) & (z < PANDA.tip_offset) & (z > -0.02)
        found.append((inside & first).sum() > 20 and (inside & ~first).sum() > 20)
    return np.array(found)


def test_with_a_marked_target_no_hand_closes_on_its_neighbour_too() -> None:
    points, first = two_blocks()
    everything, _ = grasps_of(points, None)
    assert on_both(everything, points, first).mean() > 0.3
    alone, rejected = grasps_of(points, first)
    assert len(alone) > 20
    assert rejected > 0
    closing = alone.Ts_cloud_grasp[:, :3, 1]
    across = np.abs(closing @ [0.0, 1.0, 0.0]) > 0.9
    assert (on_both(alone, points, first) & across).mean() < 0.01  # a corner that is one point of the grid


def test_a_mark_that_ends_short_of_the_edges_costs_hardly_a_grasp() -> None:
    points, first = two_blocks()
    eroded = first & (points[:, 1] < points[first, 1].max() - 0.004)
    assert eroded.sum() < 0.95 * first.sum()
    whole, _ = grasps_of(points, first)
    part, _ = grasps_of(points, eroded)
    assert len(part) > 0.5 * len(whole)


def test_a_box_says_where_and_not_what() -> None:
    points, first = two_blocks()
    box = Box(np.array([-0.1, -0.1, -0.1]), np.array([0.1, 0.0, 0.1]))
    assert on_both(grasps_of(points, box)[0], points, first).any()
