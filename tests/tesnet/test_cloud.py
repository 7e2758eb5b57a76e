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

from tesnet import cloud
from tesnet.geometry import Pose
from tesnet.query import Box
from tests.tesnet.scenes import (
    CAMERA,
    CPU,
    SUPPORT_HEIGHT,
    UP,
    Array,
    ask,
    box_surface,
    moved_query,
    prepared,
    tabletop,
    tabletop_query,
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
    found = cloud.voxel_downsample(points, voxel).double().numpy()
    # A point within rounding of a cell's wall may fall on either side: float32 here, float64 there.
    assert abs(len(found) - len(expected)) <= count // 1000
    distance, _ = cKDTree(expected).query(found)
    assert (distance > 1e-6).sum() <= count // 500


def test_voxels_come_in_a_fixed_order_without_duplicates() -> None:
    points = uniform(2000, 0)
    shuffled = points[torch.randperm(2000, generator=torch.Generator().manual_seed(0))]
    first, second = cloud.voxel_downsample(points, 0.01), cloud.voxel_downsample(shuffled, 0.01)
    torch.testing.assert_close(first, second, atol=1e-7, rtol=0)
    assert len(first.unique(dim=0)) == len(first)


@pytest.mark.needs("open3d")
@pytest.mark.parametrize(("neighbours", "ratio"), [(10, 1.0), (21, 2.0), (21, 3.0)])
def test_statistical_outliers_are_open3ds(neighbours: int, ratio: float) -> None:
    points = torch.cat([uniform(1500, 1), uniform(40, 2, extent=0.4)])
    _, kept = in_open3d(points).remove_statistical_outlier(neighbours, ratio)
    outliers = cloud.statistical_outliers(points, cloud.nearest_neighbours(points, neighbours), ratio)
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
    found = cloud.nearest_neighbours(points, k)
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
    assert cloud.nearest_neighbours(points, 8, queries).tolist() == expected.tolist()


def test_neighbours_in_a_large_cloud_with_dense_and_sparse_parts_are_scipys() -> None:
    points = torch.cat([uniform(2000, 3), uniform(500, 4, extent=0.01) + 3, uniform(500, 5, extent=5)])
    exact = points.double().numpy()
    distances, _ = cKDTree(exact).query(exact, k=16)
    found = cloud.nearest_neighbours(points, 16).numpy()
    np.testing.assert_allclose(np.linalg.norm(exact[found] - exact[:, None], axis=2), distances, atol=1e-7)


def test_coincident_points_are_their_own_first_neighbour() -> None:
    points = torch.zeros(40, 3)
    found = cloud.nearest_neighbours(points, 5)
    assert found[:, 0].tolist() == list(range(40))
    assert all(len(set(row)) == 5 for row in found.tolist())


@given(seed=st.integers(0, 999), share=st.sampled_from([0.0, 0.05, 0.5, 0.97]))
@FEW
def test_neighbours_after_dropping_points_are_those_of_a_fresh_search(seed: int, share: float) -> None:
    points = uniform(400, seed)
    keep = torch.rand(400, generator=torch.Generator().manual_seed(seed)) >= share
    kept, neighbours = cloud.drop_points(points, cloud.nearest_neighbours(points, 16), keep)
    assert torch.equal(kept, points[keep])
    fresh = cloud.nearest_neighbours(kept, 16)
    assert neighbours.shape == fresh.shape

    def distances(index: Tensor) -> Tensor:
        found: Tensor = (kept[index] - kept[:, None]).norm(dim=2)
        return found

    torch.testing.assert_close(distances(neighbours), distances(fresh), atol=1e-7, rtol=0)
    assert torch.equal(neighbours[:, 0], fresh[:, 0])


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("seed", range(3))
def test_normals_are_open3ds_up_to_sign(seed: int) -> None:
    points = cloud.voxel_downsample(torch.from_numpy(tabletop(seed)).float(), 0.0045)
    normals, _ = cloud.estimate_normals(points, cloud.nearest_neighbours(points, 30), 0.03)
    reference = in_open3d(points)
    reference.estimate_normals(open3d().geometry.KDTreeSearchParamHybrid(radius=0.03, max_nn=30))
    cosines = np.abs((normals.double().numpy() * np.asarray(reference.normals)).sum(axis=1))
    # Where two eigenvalues nearly agree the normal is not defined; that is hardly anywhere.
    assert (cosines > 0.9999).mean() > 0.995
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals)))


def test_the_spectrum_is_that_of_the_covariance() -> None:
    points = cloud.voxel_downsample(torch.from_numpy(tabletop(0)).float(), 0.0045)
    neighbours = cloud.nearest_neighbours(points, 30)
    _, spectrum = cloud.estimate_normals(points, neighbours, 0.02)
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
    values, vectors = cloud.smallest_eigenvector(torch.from_numpy(matrices))
    np.testing.assert_allclose(values.numpy(), np.maximum(expected_values, 0), atol=1e-9 * scale)
    cosines = np.abs((vectors.numpy() * expected_vectors[:, :, 0]).sum(axis=1))
    np.testing.assert_allclose(cosines, 1, atol=1e-9)


@pytest.mark.parametrize("gap", [0.0, 1e-16, 1e-13, 1e-10, 1e-7, 1e-4])
def test_the_smallest_eigenvector_is_never_that_of_the_largest_eigenvalue(gap: float) -> None:
    rng = np.random.default_rng(0)
    matrices = symmetric(np.tile([1.0, 1.0 + gap, 2.0], (200, 1)), rng)
    _, vectors = cloud.smallest_eigenvector(torch.from_numpy(matrices))
    quotients = np.einsum("bi,bij,bj->b", vectors.numpy(), matrices, vectors.numpy())
    np.testing.assert_allclose(vectors.norm(dim=1), 1, atol=1e-12)
    assert quotients.max() < 1.01


def test_a_matrix_of_zeros_or_of_one_value_has_some_unit_eigenvector() -> None:
    values, vectors = cloud.smallest_eigenvector(torch.stack([torch.zeros(3, 3), torch.eye(3)]).double())
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
    normals, directions = cloud.orient_normals(
        *(torch.from_numpy(array).float() for array in (points, outward * signs, viewpoints))
    )
    np.testing.assert_allclose(normals, outward, atol=1e-6)
    # The viewpoint over a face is the one that its normals point to.
    best = viewpoints[np.argmax(outward @ viewpoints.T, axis=1)]
    expected = (best - points) / np.linalg.norm(best - points, axis=1, keepdims=True)
    np.testing.assert_allclose(directions, expected, atol=1e-6)


def test_with_one_viewpoint_every_normal_faces_it() -> None:
    ready = prepared(tabletop_query())
    facing = ((ready.viewpoints[0] - ready.points) * ready.normals).sum(dim=1)
    assert (facing >= 0).all()


# The canonical frame


@given(seed=st.integers(0, 2**31), with_up=st.booleans())
@settings(max_examples=5, deadline=None)
def test_the_canonical_frame_moves_with_the_cloud(seed: int, with_up: bool) -> None:
    rng = np.random.default_rng(seed)
    query = tabletop_query(seed % 3) if with_up else ask(tabletop(seed % 3), viewpoints=CAMERA)
    moved = moved_query(query, Pose.random(rng, reach=0.5))
    first, second = prepared(query), prepared(moved)
    # float32 coordinates of the moved query are exact to 6e-8 m or so; a point in a few thousand changes its cell.
    assert abs(len(first) - len(second)) <= 3
    distance, _ = cKDTree(first.points.numpy()).query(second.points.numpy())
    assert (distance < 2e-6).mean() > 0.995
    torch.testing.assert_close(first.viewpoints, second.viewpoints, atol=5e-6, rtol=0)
    if first.up is not None and second.up is not None:
        torch.testing.assert_close(first.up, second.up, atol=1e-6, rtol=0)
        assert first.support_height == pytest.approx(second.support_height, abs=1e-6)


def test_the_canonical_frame_has_its_origin_in_the_middle_and_z_upwards() -> None:
    query = tabletop_query()
    ready = prepared(query)
    frame = ready.T_cloud_canonical
    np.testing.assert_allclose(frame.rotation[:, 2], UP, atol=1e-12)
    above = query.points[query.points[:, 2] >= cloud.SUPPORT_CLEARANCE]
    np.testing.assert_allclose(frame.translation, above.mean(axis=0), atol=1e-5)
    viewer = frame.inverse().apply(CAMERA)
    assert viewer[0] > 0
    assert abs(viewer[1]) < 1e-9
    assert ready.support_height == pytest.approx(SUPPORT_HEIGHT - frame.translation[2])


@pytest.mark.parametrize(
    ("points", "viewpoint", "up"),
    [
        (uniform(50, 0), [0, 0, 5], UP),  # seen from straight above
        (torch.zeros(50, 3), [0, 0, 1], None),
        (torch.zeros(50, 3), [0, 0, 0], None),  # nothing tells a direction
        (torch.linspace(0, 1, 50)[:, None] * torch.tensor([0.0, 0, 1]), [0, 0, 5], None),
        (torch.linspace(0, 1, 50)[:, None] * torch.tensor([0.0, 0, 1]), [0, 0, 5], UP),
        (torch.linspace(0, 1, 50)[:, None] * torch.tensor([1.0, 2, 3]), [1, 2, 3], None),
    ],
)
def test_there_is_a_canonical_frame_where_symmetry_leaves_it_open(
    points: Tensor, viewpoint: list[float], up: Array | None
) -> None:
    frame = cloud.canonical_frame(
        points, torch.tensor([viewpoint], dtype=torch.float32), None if up is None else torch.from_numpy(up)
    )
    assert isinstance(frame, Pose)  # which checks that it is a rotation
    if up is not None:
        np.testing.assert_allclose(frame.rotation[:, 2], up)


# The whole preparation


def test_cropping_keeps_the_workspace_above_the_support() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    tilted = np.array([0.0, 0.6, 0.8])
    box = Box(np.array([-0.5, -0.2, -0.9]), np.array([0.1, 0.7, 0.9]))
    kept = cloud.crop(torch.from_numpy(points), ask(points, workspace=box, up=tilted, support_height=0.1)).numpy()
    wanted = points[((points >= box.minimum) & (points <= box.maximum)).all(axis=1) & (points @ tilted >= 0.1 + 0.005)]
    np.testing.assert_array_equal(kept, wanted)
    assert len(cloud.crop(torch.from_numpy(points), ask(points))) == len(points)


def test_a_prepared_cloud_is_complete_and_consistent() -> None:
    query = tabletop_query()
    ready = prepared(query)
    count = len(ready)
    assert ready.points.shape == ready.normals.shape == ready.view_directions.shape == (count, 3)
    assert ready.neighbours.shape == (count, 16)
    assert ready.spectrum.shape == (count, 2)
    assert (ready.spectrum >= 0).all()
    assert (ready.spectrum[:, 0] <= ready.spectrum[:, 1]).all()
    assert (ready.spectrum.sum(dim=1) <= 2 / 3 + 1e-6).all()
    for vectors in (ready.normals, ready.view_directions):
        torch.testing.assert_close(vectors.norm(dim=1), torch.ones(count))
    back = ready.T_cloud_canonical.apply(ready.points.numpy())
    distance, _ = cKDTree(query.points).query(back)
    assert distance.max() < 0.0045
    assert back[:, 2].min() >= 0.005


def test_outliers_in_the_air_are_dropped() -> None:
    points = np.vstack([tabletop(0), [[0.0, 0.0, 0.25], [0.1, -0.1, 0.3]]])
    ready = prepared(ask(points, viewpoints=CAMERA, up=UP))
    assert ready.T_cloud_canonical.apply(ready.points.numpy())[:, 2].max() < 0.15


def test_a_room_is_cut_down_to_the_points_around_its_median() -> None:
    rng = np.random.default_rng(0)
    query = ask(rng.uniform(-1, 1, (6000, 3)), viewpoints=CAMERA)
    ready = prepared(query, max_points=1000)
    everything = prepared(query, max_points=10_000)
    assert ready.dropped_surplus == len(query.points) - 1000
    assert len(ready) <= 1000
    # A ball around the median, of the radius at which it holds its share of the cube's volume.
    radius = 2 * (1000 / 6000 / (4 / 3 * math.pi)) ** (1 / 3)
    assert ready.points.norm(dim=1).max() < 1.15 * radius < everything.points.norm(dim=1).max()


def test_far_points_are_ignored_and_counted() -> None:
    points = np.vstack([tabletop(0), np.random.default_rng(0).normal(0, 1e6, (30, 3)), [[3e38, 0, -3e38]]])
    query = ask(points, viewpoints=CAMERA, up=UP)
    ready, alone = prepared(query), prepared(ask(tabletop(0), viewpoints=CAMERA, up=UP))
    assert ready.dropped_far == 31
    assert alone.dropped_far == 0
    torch.testing.assert_close(ready.points, alone.points)


@pytest.mark.parametrize(
    "options", [{"workspace": Box(np.full(3, 5.0), np.full(3, 6.0))}, {"up": UP, "support_height": 3.0}]
)
def test_nothing_left_is_none(options: dict[str, Any]) -> None:
    assert cloud.prepare(ask(tabletop(0), **options), cloud.PreparationConfig(), CPU) is None
    assert cloud.prepare(ask(np.empty((0, 3))), cloud.PreparationConfig(), CPU) is None
