from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor

from tesnet import points as pts
from tesnet.geometry import Pose
from tests.tesnet.scenes import (
    Array,
    box_surface,
    tabletop,
)

FEW = settings(max_examples=15, deadline=None)


def open3d() -> Any:
    return importlib.import_module("open3d")  # not at the top: it needs system libraries


def in_open3d(points: Tensor) -> Any:
    return open3d().geometry.PointCloud(open3d().utility.Vector3dVector(points.double().numpy()))


def sorted_rows(points: Array) -> Array:
    order: Array = points[np.lexsort(points.round(5).T)]
    return order


def uniform(count: int, seed: int, extent: float = 0.1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-extent, extent, (count, 3))).float()


# Against Open3D and SciPy


@pytest.mark.needs("open3d")
@given(count=st.sampled_from([1, 2, 50, 3000]), seed=st.integers(0, 999), voxel=st.sampled_from([0.003, 0.0045, 0.05]))
@FEW
def test_the_voxel_grid_is_open3ds(count: int, seed: int, voxel: float) -> None:
    points = uniform(count, seed)
    expected = np.asarray(in_open3d(points).voxel_down_sample(voxel).points)
    found = pts.voxel_downsample(points, voxel).double().numpy()
    # A point within rounding of a cell's wall may fall on either side: float32 here, float64 there.
    assert abs(len(found) - len(expected)) <= count // 1000
    distance, _ = cKDTree(expected).query(found)
    assert (distance > 1e-6).sum() <= count // 500


def test_voxels_come_in_a_fixed_order_without_duplicates() -> None:
    points = uniform(2000, 0)
    shuffled = points[torch.randperm(2000, generator=torch.Generator().manual_seed(0))]
    first, second = pts.voxel_downsample(points, 0.01), pts.voxel_downsample(shuffled, 0.01)
    torch.testing.assert_close(first, second, atol=1e-7, rtol=0)
    assert len(first.unique(dim=0)) == len(first)


@pytest.mark.needs("open3d")
@pytest.mark.parametrize(("neighbours", "ratio"), [(10, 1.0), (21, 2.0), (21, 3.0)])
def test_statistical_outliers_are_open3ds(neighbours: int, ratio: float) -> None:
    points = torch.cat([uniform(1500, 1), uniform(40, 2, extent=0.4)])
    _, kept = in_open3d(points).remove_statistical_outlier(neighbours, ratio)
    outliers = pts.statistical_outliers(points, pts.nearest_neighbours(points, neighbours), ratio)
    assert (~outliers).nonzero()[:, 0].tolist() == sorted(kept)
    assert 0 < int(outliers.sum()) < 300


@given(
    count=st.sampled_from([1, 5, 16, 17, 700]),
    k=st.sampled_from([1, 4, 16]),
    seed=st.integers(0, 999),
    offset=st.sampled_from([0.0, 8.0]),
)
@FEW
def test_neighbours_are_scipys(count: int, k: int, seed: int, offset: float) -> None:
    points = uniform(count, seed) + offset
    found = pts.nearest_neighbours(points, k)
    exact = points.double().numpy()
    distances, _ = cKDTree(exact).query(exact, k=min(k, count))
    found_distances = np.linalg.norm(exact[found.numpy()] - exact[:, None], axis=2)[:, : min(k, count)]
    # Compared by distance, since equally near points may come in either order.
    np.testing.assert_allclose(found_distances, distances.reshape(count, -1), atol=1e-7)
    assert found.shape == (count, k)
    assert found[:, 0].tolist() == list(range(count))
    assert all(len(set(row)) == min(k, count) for row in found.tolist())


def test_neighbours_of_other_queries_are_scipys() -> None:
    points, queries = uniform(600, 0), uniform(50, 1)
    _, expected = cKDTree(points.double().numpy()).query(queries.double().numpy(), k=8)
    assert pts.nearest_neighbours(points, 8, queries).tolist() == expected.tolist()


def test_neighbours_in_a_large_cloud_with_dense_and_sparse_parts_are_scipys() -> None:
    points = torch.cat([uniform(2000, 3), uniform(500, 4, extent=0.01) + 3, uniform(500, 5, extent=5)])
    exact = points.double().numpy()
    distances, _ = cKDTree(exact).query(exact, k=16)
    found = pts.nearest_neighbours(points, 16).numpy()
    np.testing.assert_allclose(np.linalg.norm(exact[found] - exact[:, None], axis=2), distances, atol=1e-7)


def test_a_box_holds_what_lies_between_its_corners_borders_included() -> None:
    points = torch.cat([uniform(200, 1), torch.tensor([[0.5, 0.2, 0.3], [0.2, 0.5, 0.3], [0.2, 0.2, 0.5001]])])
    low, high = torch.tensor([0.0, 0.1, 0.2]), torch.tensor([0.5, 0.5, 0.5])
    expected = [all(low[i] <= p[i] <= high[i] for i in range(3)) for p in points]
    assert pts.in_box(points, low, high).tolist() == expected
    assert expected[-3:] == [True, True, False]


def test_a_gpus_neighbours_are_those_of_the_tree() -> None:
    points, queries = torch.cat([uniform(1500, 3), uniform(500, 4, extent=0.01) + 3]), uniform(300, 5)
    for asked in (points, queries):
        by_tree, by_distances = (find(points, asked, 16, lambda: None) for find in (pts._by_tree, pts._by_distances))
        assert torch.equal(by_tree, by_distances)


@given(count=st.sampled_from([1, 40, 1500]), radius=st.sampled_from([0.05, 0.2, 3.0]), seed=st.integers(0, 999))
@FEW
def test_counts_within_a_radius_are_scipys(count: int, radius: float, seed: int) -> None:
    points = uniform(count, seed) + 4
    exact = points.double().numpy()
    expected = cKDTree(exact).query_ball_point(exact, radius, return_length=True)
    assert pts.count_within(points, radius).tolist() == expected.tolist()


def test_coincident_points_are_their_own_first_neighbour() -> None:
    points = torch.zeros(40, 3)
    found = pts.nearest_neighbours(points, 5)
    assert found[:, 0].tolist() == list(range(40))
    assert all(len(set(row)) == 5 for row in found.tolist())


@given(seed=st.integers(0, 999), share=st.sampled_from([0.0, 0.05, 0.5, 0.97]))
@FEW
def test_neighbours_after_dropping_points_are_those_of_a_fresh_search(seed: int, share: float) -> None:
    points = uniform(400, seed)
    keep = torch.rand(400, generator=torch.Generator().manual_seed(seed)) >= share
    kept, neighbours = pts.drop_points(points, pts.nearest_neighbours(points, 16), keep)
    assert torch.equal(kept, points[keep])
    fresh = pts.nearest_neighbours(kept, 16)
    assert neighbours.shape == fresh.shape

    def distances(index: Tensor) -> Tensor:
        found: Tensor = (kept[index] - kept[:, None]).norm(dim=2)
        return found

    torch.testing.assert_close(distances(neighbours), distances(fresh), atol=1e-7, rtol=0)
    assert torch.equal(neighbours[:, 0], fresh[:, 0])


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("seed", range(3))
def test_normals_are_open3ds_up_to_sign(seed: int) -> None:
    points = pts.voxel_downsample(torch.from_numpy(tabletop(seed)).float(), 0.0045)
    normals, _ = pts.estimate_normals(points, pts.nearest_neighbours(points, 30), 0.03)
    reference = in_open3d(points)
    reference.estimate_normals(open3d().geometry.KDTreeSearchParamHybrid(radius=0.03, max_nn=30))
    cosines = np.abs((normals.double().numpy() * np.asarray(reference.normals)).sum(axis=1))
    # Where two eigenvalues nearly agree the normal is not defined; that is hardly anywhere.
    assert (cosines > 0.9999).mean() > 0.995
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals)))


def test_the_spectrum_is_that_of_the_covariance() -> None:
    points = pts.voxel_downsample(torch.from_numpy(tabletop(0)).float(), 0.0045)
    neighbours = pts.nearest_neighbours(points, 30)
    _, spectrum = pts.estimate_normals(points, neighbours, 0.02)
    for index in range(0, len(points), 97):
        local = points[neighbours[index]].double()
        local = local[(local - points[index].double()).norm(dim=1) <= 0.02]
        eigenvalues = np.linalg.eigvalsh(np.cov(local.numpy().T, bias=True))
        np.testing.assert_allclose(spectrum[index], (eigenvalues / eigenvalues.sum())[:2], atol=2e-6)


def symmetric(eigenvalues: Array, rng: np.random.Generator) -> Array:
    bases = np.linalg.qr(rng.normal(size=(len(eigenvalues), 3, 3)))[0]
    matrices: Array = bases @ (eigenvalues[:, :, None] * bases.transpose(0, 2, 1))
    return (matrices + matrices.transpose(0, 2, 1)) / 2


@given(seed=st.integers(0, 2**31), scale=st.sampled_from([1e-12, 1e-6, 1.0, 1e6]))
@FEW
def test_the_smallest_eigenvector_is_numpys(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0.01, 1, (64, 3))
    gaps[:16, 0] = 0  # exactly planar
    matrices = symmetric(gaps.cumsum(axis=1) * scale, rng)
    expected_values, expected_vectors = np.linalg.eigh(matrices)
    values, vectors = pts.smallest_eigenvector(torch.from_numpy(matrices))
    np.testing.assert_allclose(values.numpy(), np.maximum(expected_values, 0), atol=1e-9 * scale)
    cosines = np.abs((vectors.numpy() * expected_vectors[:, :, 0]).sum(axis=1))
    np.testing.assert_allclose(cosines, 1, atol=1e-9)


@pytest.mark.parametrize("gap", [0.0, 1e-16, 1e-13, 1e-10, 1e-7, 1e-4])
def test_the_smallest_eigenvector_is_never_that_of_the_largest_eigenvalue(gap: float) -> None:
    rng = np.random.default_rng(0)
    matrices = symmetric(np.tile([1.0, 1.0 + gap, 2.0], (200, 1)), rng)
    _, vectors = pts.smallest_eigenvector(torch.from_numpy(matrices))
    quotients = np.einsum("bi,bij,bj->b", vectors.numpy(), matrices, vectors.numpy())
    np.testing.assert_allclose(vectors.norm(dim=1), 1, atol=1e-12)
    assert quotients.max() < 1.01


def test_a_matrix_of_zeros_or_of_one_value_has_some_unit_eigenvector() -> None:
    values, vectors = pts.smallest_eigenvector(torch.stack([torch.zeros(3, 3), torch.eye(3)]).double())
    torch.testing.assert_close(values, torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64))
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(2, dtype=torch.float64))


# Orientation


def test_normals_turn_towards_the_viewpoint_most_nearly_along_them() -> None:
    rng = np.random.default_rng(0)
    points, outward = box_surface((0.1, 0.1, 0.1), 500, rng)
    viewpoints = np.eye(3)
    seen = outward.sum(axis=1) > 0  # the three faces that a viewpoint sees
    points, outward = points[seen], outward[seen]
    signs = rng.choice([-1.0, 1.0], (len(points), 1))
    normals, directions = pts.orient_normals(
        *(torch.from_numpy(array).float() for array in (points, outward * signs, viewpoints))
    )
    np.testing.assert_allclose(normals, outward, atol=1e-6)
    # The viewpoint over a face is the one that its normals point to.
    best = viewpoints[np.argmax(outward @ viewpoints.T, axis=1)]
    expected = (best - points) / np.linalg.norm(best - points, axis=1, keepdims=True)
    np.testing.assert_allclose(directions, expected, atol=1e-6)


def test_a_direction_out_of_the_surface_decides_where_it_is_known() -> None:
    rng = np.random.default_rng(0)
    points, outward = box_surface((0.1, 0.1, 0.1), 500, rng)
    viewpoints = rng.normal(size=(5, 3))
    signs = rng.choice([-1.0, 1.0], (len(points), 1))
    told = (np.arange(500) % 2 == 0)[:, None]
    tilted = outward + rng.uniform(-0.4, 0.4, (500, 3))
    tensors = [torch.from_numpy(array).float() for array in (points, outward * signs, viewpoints, tilted * told)]
    normals, directions = pts.orient_normals(*tensors)
    untold_normals, untold_directions = pts.orient_normals(*tensors[:3])
    known = told[:, 0]
    np.testing.assert_allclose(normals[known], outward[known], atol=1e-6)
    torch.testing.assert_close(normals[~known], untold_normals[~known], rtol=0, atol=0)
    torch.testing.assert_close(directions[~known], untold_directions[~known], rtol=0, atol=0)
    to_viewpoints = viewpoints[None] - points[:, None]
    to_viewpoints /= np.linalg.norm(to_viewpoints, axis=2, keepdims=True)
    best = (to_viewpoints * tilted[:, None]).sum(axis=2).argmax(axis=1)
    np.testing.assert_allclose(directions[known], to_viewpoints[np.arange(500), best][known], atol=1e-6)


# Frames


def test_points_are_expressed_in_every_grasps_frame() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.2, 0.2, (20, 3))
    motions = [Pose.random(rng, reach=0.5) for _ in range(6)]
    Ts = torch.from_numpy(np.array([motion.matrix for motion in motions]))
    found = torch.stack(pts.points_in_grasp_frames(torch.from_numpy(points), Ts), dim=2)
    expected = np.array([motion.inverse().apply(points) for motion in motions])
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(count=st.integers(2, 2000), queries=st.integers(1, 1500), margin=st.sampled_from([0.0, 0.01, 0.5]))
@FEW
def test_a_strip_knows_every_point_near_its_queries(count: int, queries: int, margin: float) -> None:
    points, asked = uniform(count, 1).double(), uniform(queries, 2).double()
    seen = []
    for rows, around in pts.strips(points, asked, margin):
        near = (torch.cdist(asked[rows], points) <= margin).any(dim=0)
        assert set(near.nonzero()[:, 0].tolist()) <= set(around.tolist())
        seen += rows.tolist()
    assert sorted(seen) == list(range(queries))


@pytest.mark.parametrize(("counted", "at_once"), [(0, 10**6), (10**7, 10**6), (10**7, 7), (0, 7)])
def test_members_of_cells_are_those_of_a_loop_however_they_are_found(
    monkeypatch: pytest.MonkeyPatch, counted: int, at_once: int
) -> None:
    monkeypatch.setattr(pts, "_CELLS_COUNTED", counted)
    monkeypatch.setattr(pts, "ROWS_AT_ONCE", at_once)
    points = torch.from_numpy(np.random.default_rng(3).uniform(-0.02, 0.03, (200, 3))).float()
    origin, asked = torch.tensor([0.001, -0.002, 0.0]), []
    member_of, counts = pts.members_of_cells(points, 0.01, origin, shift=0.5, between=lambda: asked.append(1))
    cells = [tuple(np.floor((point - origin.numpy()) / np.float32(0.01) + 0.5)) for point in points.numpy()]
    occupied = sorted(set(cells))
    assert member_of.tolist() == [occupied.index(cell) for cell in cells]
    assert counts.tolist() == [cells.count(cell) for cell in occupied]
    assert len(asked) == (0 if counted == 0 else math.ceil(200 / at_once))
