"""Noisy clouds: how noisy they are, what flies, and what smoothing leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tesnet import smoothing
from tesnet.cloud import LEAST_SUPPORT_NOISE, SUPPORT_NOISE, PreparationConfig, PreparedCloud, prepare
from tesnet.geometry import Pose
from tesnet.points import cells_of, nearest_neighbours
from tests.tesnet.scenes import CAMERA, CPU, SUPPORT_HEIGHT, moved_query, tabletop, tabletop_query
from tests.tesnet.test_support import table

FOLLOWING = PreparationConfig(smooth_above=0.0011)


def noisy(sd: float, seed: int = 0) -> np.ndarray:
    points = tabletop(seed, noise=0.0)
    return points + np.random.default_rng(seed).normal(0, sd, points.shape)


def prepared(points: np.ndarray, config: PreparationConfig = FOLLOWING) -> PreparedCloud:
    found = prepare(replace(tabletop_query(), points=points), config, CPU)
    assert found is not None
    return found


def flying(count: int, seed: int = 0) -> np.ndarray:
    """Points in the air behind things, along the camera's rays."""
    rng = np.random.default_rng(seed)
    edges = tabletop(seed, noise=0.0)
    edges = edges[rng.choice(len(edges), count)]
    places: np.ndarray = CAMERA + (edges - CAMERA) * rng.uniform(0.75, 0.95, (count, 1))
    return places


@pytest.mark.parametrize("sd", [0.0008, 0.0012, 0.0016])
def test_noise_is_measured_within_a_fifth(sd: float) -> None:
    found = smoothing.measured(torch.from_numpy(noisy(sd)).float())
    assert found.sd == pytest.approx(sd, rel=0.2)
    assert found.lone < smoothing.MOST_LONE


def test_noise_is_measured_more_where_there_is_more() -> None:
    deviations = [smoothing.measured(torch.from_numpy(noisy(sd)).float()).sd for sd in (0.0, 0.001, 0.002, 0.004)]
    assert deviations == sorted(deviations)
    assert deviations[0] < 0.0003


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sd", [0.0, 0.0004, 0.0008])
def test_quiet_clouds_stay_bit_for_bit(seed: int, sd: float) -> None:
    points = noisy(sd, seed)
    with_table = np.concatenate([points, table(0.2)])
    with_table += np.random.default_rng(seed).normal(0, sd, with_table.shape)
    over = (
        with_table[:, 2] - SUPPORT_HEIGHT
    )  # what a quiet table in view tells from itself, and plain preparation does not
    with_table = with_table[(over < LEAST_SUPPORT_NOISE) | (over > SUPPORT_NOISE)]
    for cloud in (points, with_table if sd < 0.0006 else points):
        following, plain = prepared(cloud), prepared(cloud, PreparationConfig())
        assert torch.equal(following.points, plain.points)
        assert torch.equal(following.normals, plain.normals)


@pytest.mark.parametrize("sd", [0.002, 0.004])
def test_a_noisy_surface_gets_thin_and_its_normals_right(sd: float) -> None:
    truth = prepared(tabletop(0, noise=0.0), PreparationConfig())

    def errors(config: PreparationConfig) -> tuple[float, float]:
        found = prepared(noisy(sd), config)
        points = _in_cloud(found)
        nearest = nearest_neighbours(_in_cloud(truth), 1, points)[:, 0]
        normals = found.normals @ torch.tensor(found.T_cloud_canonical.rotation.T).float()
        true = truth.normals[nearest] @ torch.tensor(truth.T_cloud_canonical.rotation.T).float()
        surface = torch.from_numpy(tabletop(0, noise=0.0)).float()
        distance = (points - surface[nearest_neighbours(surface, 1, points)[:, 0]]).norm(dim=1)
        return float(distance.median()), float((normals * true).sum(dim=1).clamp(-1, 1).arccos().rad2deg().median())

    (far, aslant), (far_before, aslant_before) = errors(FOLLOWING), errors(PreparationConfig())
    assert far < 0.6 * far_before
    assert aslant < 0.5 * aslant_before


def _in_cloud(found: PreparedCloud) -> Tensor:
    return torch.from_numpy(found.T_cloud_canonical.apply(found.points.numpy())).float()


def test_flying_pixels_go_and_the_others_stay() -> None:
    right, wrong = noisy(0.0008), flying(500)
    table_of_points = torch.from_numpy(np.concatenate([right, wrong])).float()
    rows = torch.cat([table_of_points, torch.arange(len(table_of_points))[:, None].float()], dim=1)
    kept = smoothing.without_lone(rows, smoothing.measured(table_of_points))[:, 3].long().numpy()
    assert (kept >= len(right)).sum() < 0.25 * len(wrong)
    assert (kept < len(right)).sum() > 0.99 * len(right)


def test_a_cloud_whose_points_all_lie_apart_flies_nowhere() -> None:
    sparse = torch.from_numpy(np.random.default_rng(0).uniform(0, 0.2, (500, 3))).float()
    noise = smoothing.measured(sparse)
    assert noise.lone == 0.0
    assert torch.equal(smoothing.without_lone(sparse, noise), sparse)


def test_what_follows_the_coordinates_is_averaged() -> None:
    points = torch.from_numpy(noisy(0.002)).float()
    rows = torch.cat([points, (points[:, :1] > 0).float()], dim=1)
    found = smoothing.smoothed(rows, 0.002)
    assert found.shape[1] == 4
    assert bool((found[found[:, 0] > 0.005, 3] == 1).all())
    assert bool((found[found[:, 0] < -0.005, 3] == 0).all())


def test_a_smoothed_cloud_moves_with_its_frame() -> None:
    query = replace(tabletop_query(), points=noisy(0.003), workspace=None)
    moved = moved_query(query, Pose.random(np.random.default_rng(1), reach=0.3))
    here, there = prepare(query, FOLLOWING, CPU), prepare(moved, FOLLOWING, CPU)
    assert here is not None
    assert there is not None
    assert abs(len(here) - len(there)) <= 0.01 * len(here)
    distance = (here.points[nearest_neighbours(here.points, 1, there.points)[:, 0]] - there.points).norm(dim=1)
    assert float(distance.quantile(0.95)) < 0.0005


@pytest.mark.parametrize("sd", [0.002, 0.004])
def test_of_a_table_in_view_what_its_noise_lifts_is_dropped(sd: float) -> None:
    points = np.concatenate([tabletop(0, noise=0.0), table(0.2)])
    points += np.random.default_rng(0).normal(0, sd, points.shape)
    limit = min(3 * sd, 0.010)
    heights = _in_cloud(prepared(points))[:, 2]
    assert float(heights.min()) > limit - 0.003


def test_files_without_the_setting_leave_clouds_as_they_are() -> None:
    assert PreparationConfig(voxel_size=0.0045).smooth_above is None


def test_each_point_moves_to_the_weighted_plane_of_all_cells_about_it() -> None:
    rng = np.random.default_rng(3)
    rows = torch.from_numpy(np.column_stack([rng.uniform(-0.05, 0.05, (9000, 2)), rng.normal(0, 0.002, 9000)])).float()
    sd, width = 0.002, 0.006
    fine, _ = cells_of(rows, 0.003)
    samples, sizes = cells_of(rows, 0.005)
    expected = []
    for point in fine.double():
        offsets = samples.double() - point
        squares = offsets.square().sum(dim=1)
        weights = sizes * torch.exp(-squares / (2 * width**2)) * (squares <= 4 * width**2)
        mean = (offsets * weights[:, None]).sum(dim=0) / weights.sum()
        centred = offsets - mean
        _, axes = torch.linalg.eigh((centred * weights[:, None]).T @ centred)
        expected.append((point + (mean @ axes[:, 0]) * axes[:, 0], weights.sum()))
    total = torch.stack([weight for _, weight in expected])
    kept = total >= 0.25 * total.median()
    moved = torch.stack([place for place, _ in expected])[kept]
    torch.testing.assert_close(smoothing.smoothed(rows, sd).double(), moved, atol=1e-6, rtol=0)


def clusters(sizes: list[int]) -> tuple[Tensor, Tensor]:
    """Points in clusters of such sizes, each within 2 mm and far from the others; and each point's cluster's size."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.001, 0.001, (sum(sizes), 3))
    points[:, 0] += np.repeat(0.1 * np.arange(len(sizes)), sizes)
    return torch.from_numpy(points).float(), torch.tensor(np.repeat(sizes, sizes))


@pytest.mark.parametrize("crowd", [17.0, 34.0, 50.0, 90.0])
def test_a_point_is_alone_by_the_others_about_it_and_not_by_itself(crowd: float) -> None:
    points, sizes = clusters(list(range(1, 12)))
    noise = smoothing.Noise(sd=0.001, lone=0.5, crowd=crowd)
    kept = smoothing.without_lone(torch.cat([points, sizes[:, None].float()], dim=1), noise)
    assert kept[:, 3].tolist() == [size for size in sizes.tolist() if size - 1 > 0.06 * crowd]


@pytest.mark.parametrize("others", [1, 2, 3])
def test_exactly_the_share_that_a_lone_point_has_at_most_is_lone(others: int) -> None:
    points, sizes = clusters([1, 2, 3, 4, 5, 6])
    noise = smoothing.Noise(sd=0.001, lone=0.5, crowd=others / smoothing._LONE_SHARE)
    kept = smoothing.without_lone(points, noise)
    assert len(kept) == int((sizes - 1 > others).sum())


@pytest.mark.parametrize(("lone", "goes"), [(0.0, False), (0.0125, False), (0.0126, True)])
def test_nothing_goes_where_no_more_are_lone_than_of_quiet_clouds(lone: float, goes: bool) -> None:
    points, _ = clusters([1, 2, 20])
    kept = smoothing.without_lone(points, smoothing.Noise(sd=0.001, lone=lone, crowd=100.0))
    assert len(kept) == (20 if goes else 23)


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_a_small_cloud_is_that_of_a_loop_over_its_points(seed: int) -> None:
    """So few that all of them are the sample: others in 6 mm, and what planes leave in balls of 8 mm."""
    rng = np.random.default_rng(seed)
    sheet = np.column_stack([rng.uniform(0, 0.02, (300, 2)), rng.normal(0, 0.001 * (seed + 1), 300)])
    points = np.concatenate([sheet, rng.uniform(0, 0.2, (30, 3))]) + np.array([0.5, -2.0, 0.25])
    points = points.astype(np.float32).astype(np.float64)
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    others = (distances <= 0.006).sum(axis=1) - 1
    crowd = float(np.sort(others)[(len(others) - 1) // 2])
    residuals = []
    for row in range(len(points)):
        ball = points[distances[row] <= 0.008]
        if len(ball) >= 12:
            spread = np.linalg.svd(ball - ball.mean(axis=0), compute_uv=False)[-1]
            residuals.append(np.sqrt(spread**2 / (len(ball) - 3)))
    found = smoothing.measured(torch.from_numpy(points).float())
    assert found.crowd == crowd
    assert found.lone == pytest.approx((others <= 0.06 * crowd).mean(), abs=1e-9)
    assert found.sd == pytest.approx(np.quantile(residuals, 0.25), rel=0.02)
