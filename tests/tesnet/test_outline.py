from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tesnet.cloud import PreparedCloud
from tesnet.geometry import Box, Pose
from tesnet.outline import Outline, _drop, is_low, outline
from tesnet.query import GraspQuery
from tests.tesnet.raycast import OVERHEAD, Can, Slab, overhead_query
from tests.tesnet.scenes import UP, Array, ask, bare_cloud, prepared, tabletop_query

CELL = 0.0045


def outlined(query: GraspQuery, **changes: Any) -> tuple[Array, Array, Array, PreparedCloud]:
    """Points, outward directions and travel in the query's frame."""
    cloud = prepared(query, **changes)
    found: Outline = outline(cloud, query)
    frame = cloud.T_cloud_canonical
    return (
        frame.apply(cloud.points[found.points].double().numpy()),
        frame.rotate(found.outward.double().numpy()),
        frame.rotate(found.travel.double().numpy()),
        cloud,
    )


@pytest.mark.parametrize("height", [0.012, 0.04, 0.15])
def test_a_box_straight_below_has_its_four_edges_and_nothing_else(height: float) -> None:
    size = np.array([0.06, 0.04])
    points, outward, travel, _ = outlined(overhead_query((Slab((0.0, 0.0, 0.0), (*size, height)),)))
    inside = size / 2 - np.abs(points[:, :2])
    np.testing.assert_allclose(inside.min(axis=1), 0, atol=1.2 * CELL)
    np.testing.assert_allclose(points[:, 2], height, atol=0.002)
    np.testing.assert_allclose(travel, np.tile(-UP, (len(points), 1)), atol=1e-6)
    np.testing.assert_allclose(outward @ UP, 0, atol=1e-5)
    along_edge = np.sort(inside, axis=1)[:, 1] > 2.5 * CELL  # not in a corner
    axis = inside.argmin(axis=1)
    rows = np.arange(len(points))
    cosines = outward[rows, axis] * np.sign(points[rows, axis])
    assert (cosines[along_edge] > np.cos(np.radians(20))).all()
    assert np.median(cosines[along_edge]) > np.cos(np.radians(5))
    for side_axis in (0, 1):
        for sign in (-1, 1):
            on_side = along_edge & (axis == side_axis) & (np.sign(points[:, side_axis]) == sign)
            assert on_side.sum() >= 0.6 * (size[1 - side_axis] - 5 * CELL) / CELL


def test_a_standing_can_has_its_rim() -> None:
    points, outward, _, _ = outlined(overhead_query((Can((0.0, 0.0, 0.0), 0.03, 0.1),)))
    radius = np.linalg.norm(points[:, :2], axis=1)
    np.testing.assert_allclose(radius, 0.03, atol=1.2 * CELL)
    cosines = (outward[:, :2] * points[:, :2]).sum(axis=1) / radius
    assert (cosines > np.cos(np.radians(20))).all()
    angles = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.radians(45)


def test_where_a_taller_thing_begins_a_face_does_not_end() -> None:
    low, tall = Slab((-0.02, 0.0, 0.0), (0.04, 0.05, 0.03)), Slab((0.02, 0.0, 0.0), (0.04, 0.05, 0.09))
    points, outward, _, _ = outlined(overhead_query((low, tall)))
    of_low, of_tall = np.abs(points[:, 2] - 0.03) < 0.005, np.abs(points[:, 2] - 0.09) < 0.005
    assert not (of_low & (np.abs(points[:, 0]) < 0.01) & (np.abs(points[:, 1]) < 0.018)).any()
    assert (of_tall & (outward[:, 0] < -0.9)).sum() >= 3  # there the tall one falls away to the low one
    assert (of_low & (outward[:, 0] < -0.9)).sum() >= 3


LONG = Slab((0.0, 0.0, 0.0), (0.20, 0.05, 0.04))


def at_its_real_ends(points: Array, end: float = 0.1) -> bool:
    inside = np.stack([end - np.abs(points[:, 0]), 0.025 - np.abs(points[:, 1])])
    return bool((inside.min(axis=0) < 1.2 * CELL).all())


def test_a_face_does_not_end_where_the_workspace_cuts_it() -> None:
    workspace = Box(np.array([-0.05, -0.2, -0.1]), np.array([0.05, 0.2, 0.3]))
    points, _, _, cloud = outlined(overhead_query((LONG,), workspace=workspace))
    assert len(points) > 10
    assert float(cloud.points[:, :2].norm(dim=1).max()) < 0.07
    assert at_its_real_ends(points)


def test_a_face_does_not_end_where_the_cell_limit_cuts_it() -> None:
    points, _, _, cloud = outlined(overhead_query((LONG,)), max_points=200)
    assert cloud.dropped_surplus > 100
    assert len(points) > 5
    assert at_its_real_ends(points)


def test_a_face_does_not_end_where_the_image_does() -> None:
    query = overhead_query((LONG,))
    in_image = ask(
        query.points[query.points[:, 0] < 0.04], viewpoints=query.viewpoints, up=query.up, support_height=0.0
    )
    points, _, _, _ = outlined(in_image)
    assert len(points) > 10
    assert at_its_real_ends(points)


@pytest.mark.parametrize("support_height", [0.0, None])
def test_a_plane_that_the_caller_removed_lies_beyond_an_edge_where_it_is_known(support_height: float | None) -> None:
    query = overhead_query((LONG,))
    above = query.points[query.points[:, 2] > 0.01]
    workspace = Box(np.array([-0.06, -0.2, -0.1]), np.array([0.06, 0.2, 0.3]))
    options = {"viewpoints": query.viewpoints, "up": UP, "support_height": support_height, "workspace": workspace}
    within = above[np.abs(above[:, 0]) < 0.06]
    points, _, _, _ = outlined(ask(within, **options))
    if support_height is None:
        assert len(points) == 0
    else:
        assert len(points) > 10
        assert at_its_real_ends(points)


def test_a_view_from_the_side_has_no_outline() -> None:
    query = tabletop_query()
    assert len(outline(prepared(query), query).points) == 0
    aslant = overhead_query((LONG,), camera=np.array([[0.35, 0.3, 0.5]]))
    assert len(outline(prepared(aslant), aslant).points) == 0


def test_where_the_camera_s_pose_is_in_doubt_faces_have_an_outline_from_straight_above_alone() -> None:
    for camera, some in ((np.array([[0.45, 0.0, 0.45]]), False), (OVERHEAD, True)):
        query = overhead_query((LONG,), camera=camera, calibrate=True)
        assert (len(outline(prepared(query), query).points) > 0) == some


@pytest.mark.parametrize("aside", [0.0, 0.06])
def test_seen_from_its_end_a_long_box_ends_along_its_sides(aside: float) -> None:
    points, outward, travel, _ = outlined(overhead_query((LONG,), camera=np.array([[0.45, aside, 0.45]])))
    assert len(points) > 10
    assert (np.abs(outward[:, 1]) > 0.9).mean() > 0.9
    np.testing.assert_allclose(np.abs(points[np.abs(outward[:, 1]) > 0.9, 1]), 0.025, atol=1.2 * CELL)
    assert {-1.0, 1.0} >= set(np.sign(outward[:, 1]))
    assert (outward[:, 1] < -0.9).any()  # where nobody sees the wall
    np.testing.assert_allclose(travel, np.tile(-UP, (len(points), 1)), atol=1e-6)


def test_edges_whose_wall_is_seen_are_left_to_the_pairs_with_that_wall() -> None:
    """Beside the optical axis a camera sees the walls that face it."""
    box = Slab((0.12, 0.0, 0.0), (0.05, 0.05, 0.12))
    points, outward, _, cloud = outlined(overhead_query((box,)))
    assert int(((cloud.normals @ torch.tensor(UP).float()).abs() < 0.5).sum()) > 20
    assert (outward[:, 0] > 0.9).sum() >= 3
    assert not (outward[:, 0] < -0.9).any()
    assert (np.abs(points[:, 2] - 0.12) < 0.003).all()


def test_without_up_the_travel_is_along_the_sight() -> None:
    query = overhead_query((Slab((0.0, 0.0, 0.0), (0.06, 0.04, 0.05)),), up=None, support_height=None)
    workspace = Box(np.array([-0.1, -0.1, 0.02]), np.array([0.1, 0.1, 0.3]))
    points, outward, travel, _ = outlined(
        ask(query.points, viewpoints=query.viewpoints, workspace=workspace)  # else the table's own outline counts
    )
    assert len(points) > 10
    sight = points - OVERHEAD
    np.testing.assert_allclose(travel, sight / np.linalg.norm(sight, axis=1, keepdims=True), atol=1e-4)
    np.testing.assert_allclose((outward * travel).sum(axis=1), 0, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_low_is_what_lies_less_than_17_mm_over_a_plane_that_is_known(seed: int) -> None:
    pose = Pose.random(np.random.default_rng(seed), reach=0.3)
    heights = np.array([-0.01, 0.0, 0.01, 0.0169, 0.0171, 0.03])
    points = pose.apply(np.column_stack([np.linspace(-0.1, 0.1, 6), np.linspace(0.1, -0.05, 6), heights]))
    up = pose.rotate(np.array([0.0, 0.0, 1.0]))
    cloud = bare_cloud(points, up=torch.tensor(up).float(), support_height=float(up @ pose.translation))
    assert is_low(cloud).tolist() == [True, True, True, True, False, False]
    for unknown in (replace(cloud, up=None), replace(cloud, support_height=None)):
        assert not is_low(unknown).any()


def test_beyond_low_faces_less_of_a_drop_is_enough_but_never_none() -> None:
    heights = np.array([-0.001, 0.0, 0.001, 0.0025, 0.004, 0.01, 0.02, 0.2])
    points = np.column_stack([np.zeros((8, 2)), heights])
    cloud = replace(bare_cloud(points), up=torch.tensor([0.0, 0.0, 1.0]), support_height=0.0)
    every = torch.arange(8)
    expected = [0.0015, 0.0015, 0.0015, 0.0015, 0.0024, 0.006, 0.006, 0.006]
    assert _drop(cloud, every)[:, 0].tolist() == pytest.approx(expected, abs=1e-6)
    assert _drop(replace(cloud, support_height=None), every)[:, 0].tolist() == pytest.approx([0.006] * 8)
