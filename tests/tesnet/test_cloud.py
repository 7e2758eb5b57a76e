from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from tesnet import cloud, smoothing, support
from tesnet.depth_noise import DepthNoise
from tesnet.geometry import Box, Pose
from tesnet.query import GraspQuery
from tesnet.support import SupportPlane
from tests.tesnet.raycast import Can, around, cast
from tests.tesnet.scenes import (
    CAMERA,
    CPU,
    SUPPORT_HEIGHT,
    UP,
    Array,
    ask,
    moved_query,
    prepared,
    tabletop,
    tabletop_query,
)

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
    above = query.points[query.points[:, 2] >= cloud.SUPPORT_NOISE]
    np.testing.assert_allclose(frame.translation, above.mean(axis=0), atol=1e-5)
    viewer = frame.inverse().apply(CAMERA)
    assert viewer[0] > 0
    assert abs(viewer[1]) < 1e-9
    assert ready.support_height == pytest.approx(SUPPORT_HEIGHT - frame.translation[2])


@pytest.mark.parametrize(
    ("points", "viewpoint", "up"),
    [
        (torch.rand(50, 3, generator=torch.Generator().manual_seed(0)), [0, 0, 5], UP),  # seen from straight above
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


def cropped(points: NDArray[np.float32], query: GraspQuery) -> NDArray[np.float32]:
    above = cloud.above_support(torch.from_numpy(points), query)
    kept: NDArray[np.float32] = above[cloud.in_workspace(above, query)].numpy()
    return kept


def test_cropping_keeps_the_workspace_above_the_support() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    tilted = np.array([0.0, 0.6, 0.8])
    box = Box(np.array([-0.5, -0.2, -0.9]), np.array([0.1, 0.7, 0.9]))
    kept = cropped(points, ask(points, workspace=box, up=tilted, support_height=0.1))
    wanted = points[((points >= box.minimum) & (points <= box.maximum)).all(axis=1) & (points @ tilted >= 0.1 + 0.005)]
    np.testing.assert_array_equal(kept, wanted)
    assert len(cropped(points, ask(points))) == len(points)


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


def test_with_one_viewpoint_every_normal_faces_it() -> None:
    ready = prepared(tabletop_query())
    facing = ((ready.viewpoints[0] - ready.points) * ready.normals).sum(dim=1)
    assert (facing >= 0).all()


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


def facing_walls() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Points on two walls of a thin box, which of two cameras saw each, and the outward normals.

    Each camera looks along its wall, so that the other one lies more nearly along the normal's line.
    """
    rng = np.random.default_rng(4)
    sides = np.repeat([1.0, -1.0], 1500)
    points = np.column_stack([0.02 * sides, rng.uniform(-0.05, 0.05, (3000, 2))])
    cameras = np.array([[0.1, 0.0, 0.6], [-0.1, 0.0, 0.6], [0.6, 0.0, 0.0], [-0.6, 0.0, 0.0]])
    return points, cameras, sides


@pytest.mark.parametrize("how", ["view_index", "normals"])
def test_normals_are_turned_by_who_saw_the_point_or_by_those_that_are_given(how: str) -> None:
    points, cameras, sides = facing_walls()
    told: dict[str, Any] = (
        {"view_index": np.where(sides > 0, 0, 1)} if how == "view_index" else {"normals": sides[:, None] * [3.0, 0, 0]}
    )
    ready = prepared(ask(points, viewpoints=cameras, up=UP, **told))
    in_cloud = ready.T_cloud_canonical.apply(ready.points.numpy())
    outward = ready.T_cloud_canonical.rotate(ready.normals.numpy())[:, 0] * np.sign(in_cloud[:, 0])
    assert (outward > 0.9).mean() > 0.95
    assert (ready.normals * ready.view_directions).sum(dim=1).min() > -0.2


def test_normals_of_zeros_leave_the_orientation_to_the_viewpoints() -> None:
    points, cameras, _ = facing_walls()
    plain = prepared(ask(points, viewpoints=cameras, up=UP))
    same = prepared(ask(points, viewpoints=cameras, up=UP, normals=np.zeros_like(points)))
    assert torch.equal(plain.normals, same.normals)


@pytest.mark.parametrize("told_by", ["view_index", "normals"])
def test_who_saw_a_point_or_the_normals_that_came_with_it_turn_the_normals(told_by: str) -> None:
    """Told the contrary of what two cameras saw of a can from both sides, walls face inward."""
    views = cast((Can((0.0, 0.0, 0.0), 0.03, 0.1),), around(2, polar_deg=80), np.random.default_rng(0))
    seen = ask(views.points, viewpoints=views.cameras, up=UP)
    contrary = {"view_index": 1 - views.view_index, "normals": -views.normals}[told_by]
    told = prepared(ask(views.points, viewpoints=views.cameras, up=UP, **{told_by: contrary}))
    plain = prepared(seen)
    facing = (plain.view_directions * plain.normals).sum(dim=1)
    walls = ((plain.normals @ torch.tensor(UP).float()).abs() < 0.3) & (facing > 0.4)
    assert int(walls.sum()) > 100
    reversed_ = (told.normals * plain.normals).sum(dim=1) < -0.999
    assert float(reversed_[walls].float().mean()) > 0.98


@pytest.mark.parametrize("distance", [1.0, 1e3, 1e6, 1e9, 1e12])
@pytest.mark.parametrize("direction", [(1, 1, 1), (0, 0, 1), (-3, 1, 2)])
def test_the_canonical_frame_is_one_however_far_and_small_the_cloud_is(
    distance: float, direction: tuple[float, float, float]
) -> None:
    """`Pose` refuses what is no rotation."""
    points = distance * torch.tensor([direction], dtype=torch.float32).expand(500, 3)
    along = torch.nn.functional.normalize(torch.tensor(direction).double(), dim=0)
    for up in (None, torch.tensor([0.0, 0.0, 1.0]), along):
        cloud.canonical_frame(points, torch.zeros(1, 3, dtype=torch.float64), up)


@pytest.mark.parametrize("noise_sd", [0.0, 0.001, 0.003, 0.006])
def test_what_is_as_low_as_a_found_supports_noise_is_dropped_with_it(noise_sd: float) -> None:
    """Whether grasps are looked for there or not; of a plane of little noise 3 mm are dropped."""
    points = np.random.default_rng(0).uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.06], (20_000, 3))
    sides = np.array([[1.0, 0, 0, 0.2], [-1.0, 0, 0, 0.2], [0, 1.0, 0, 0.2], [0, -1.0, 0, 0.2]])
    plane = SupportPlane(UP, 0.0, 0.5, 0.1, noise_sd, sides, DepthNoise(CAMERA[None], noise_sd, 0.0))
    query = ask(points, viewpoints=CAMERA, up=UP, support_height=0.0)
    ready = cloud.prepare(query, cloud.PreparationConfig(), CPU, plane)
    assert ready is not None
    positions = [ready.points] if ready.unsought is None else [ready.points, ready.unsought.points]
    heights = ready.T_cloud_canonical.apply(torch.cat(positions).numpy())[:, 2]
    lowest = max(support.LOWEST, 4 * noise_sd)
    assert lowest - 1e-6 <= heights.min() < lowest + 0.003
    assert ready.support_error == noise_sd


@pytest.mark.parametrize("noise_sd", [0.0015, 0.0025, 0.008])
@pytest.mark.parametrize("smooths", [True, False])
def test_where_preparation_follows_the_noise_what_a_given_supports_noise_lifts_is_dropped_up_to_a_centimetre(
    noise_sd: float, smooths: bool
) -> None:
    """The noise is told by the points under the plane; here none of the surfaces is so noisy that it is smoothed."""
    rng = np.random.default_rng(0)
    things = rng.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.06], (30_000, 3))
    table = np.column_stack([rng.uniform(-0.1, 0.1, (3000, 2)), -np.abs(rng.normal(0, noise_sd, 3000))])
    query = ask(np.concatenate([things, table]), viewpoints=CAMERA, up=UP, support_height=0.0)
    ready = prepared(query, smooth_above=0.05 if smooths else None)
    lowest = min(max(cloud.SUPPORT_NOISE, 3 * noise_sd), cloud.MOST_SUPPORT_NOISE) if smooths else cloud.SUPPORT_NOISE
    heights = ready.T_cloud_canonical.apply(ready.points.numpy())[:, 2]
    assert float(heights.min()) == pytest.approx(lowest + 0.001, abs=0.0015)


@pytest.mark.parametrize(
    ("noise_sd", "beside", "lowest"),
    [(0.0, 0.0, 0.002), (0.0006, 0.0, 0.0024), (0.0010, 0.0, 0.004), (0.0016, 0.0, 0.005), (0.0003, 0.0015, 0.005),
     (0.0003, -0.0015, 0.005)],
)  # fmt: skip
def test_of_a_support_that_is_seen_about_its_height_no_more_than_its_noise_is_dropped(
    noise_sd: float, beside: float, lowest: float
) -> None:
    """One that lies beside the height that was told keeps the usual distance."""
    rng = np.random.default_rng(0)
    things = rng.uniform([-0.06, -0.06, lowest], [0.06, 0.06, 0.06], (30_000, 3))
    table = np.column_stack([rng.uniform(-0.3, 0.3, (9000, 2)), beside + rng.normal(0, noise_sd, 9000)])
    query = ask(np.concatenate([things, table]), viewpoints=CAMERA, up=UP, support_height=0.0)
    over = torch.from_numpy(query.points[:, 2].copy())
    assert cloud._reach_of_seen(over, 0.005) == pytest.approx(lowest, abs=4e-4)
    assert cloud._reach_of_seen(torch.from_numpy(things[:, 2]).float(), 0.005) == 0.005
    ready = prepared(query, smooth_above=0.05)
    heights = ready.T_cloud_canonical.apply(ready.points.numpy())[:, 2]
    assert float(heights.min()) == pytest.approx(lowest + 0.001, abs=0.0015)


def test_where_the_noise_of_a_given_support_grows_with_the_distance_as_much_more_is_dropped() -> None:
    """Four standard deviations at each place, and what is lifted over that and stands alone."""
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.8, 0.8, (60_000, 2)), np.zeros(60_000)])
    sd = 0.0012 * np.linalg.norm(table - CAMERA, axis=1)
    table[:, 2] = sd * rng.standard_normal(len(table))
    far, near = (rng.uniform([x, -0.05, 0.0], [x + 0.1, 0.05, 0.03], (4000, 3)) for x in (-0.75, 0.5))
    query = ask(np.concatenate([table, far, near]), viewpoints=CAMERA, up=UP, support_height=0.0)
    ready = prepared(query, smooth_above=0.05)
    positions = ready.T_cloud_canonical.apply(ready.points.numpy())
    among = [(np.abs(positions[:, 0] - x) < 0.06) & (np.abs(positions[:, 1]) < 0.06) for x in (-0.7, 0.55)]
    assert (among[0] | among[1]).mean() > 0.97
    for mask, x in zip(among, (-0.7, 0.55), strict=True):
        reach = 4 * 0.0012 * np.linalg.norm(CAMERA - [x, 0, 0])
        assert positions[mask, 2].min() == pytest.approx(max(reach, 0.0045), abs=0.0015)


def test_a_cloud_is_as_noisy_as_its_own_surfaces_or_its_support_whichever_is_noisier() -> None:
    config = cloud.PreparationConfig(smooth_above=0.0015)
    quiet = torch.from_numpy(tabletop(0)).float()
    noisy = quiet + 0.003 * torch.randn(quiet.shape, generator=torch.Generator().manual_seed(0))
    measured = smoothing.measured(noisy).sd
    assert smoothing.measured(quiet).sd < 0.0015 < measured
    for table, support_sd, sd in (
        (quiet, 0.001, None),
        (quiet, 0.003, 0.003),
        (noisy, 0.0, measured),
        (noisy, 0.02, 0.02),
    ):
        found = cloud._quieter(table, config, support_sd, lambda: None)
        kept = smoothing.without_lone(table, smoothing.measured(table))
        assert torch.equal(found, kept if sd is None else smoothing.smoothed(kept, sd))


def test_of_much_that_stands_on_a_found_support_the_nearest_to_the_camera_is_looked_at() -> None:
    """The rest still blocks hands; where nothing was found, or a target given, the usual limit holds."""
    points = np.random.default_rng(0).uniform([-0.15, -0.15, 0.02], [0.15, 0.15, 0.06], (60_000, 3))
    sides = np.array([[1.0, 0, 0, 0.3], [-1.0, 0, 0, 0.3], [0, 1.0, 0, 0.3], [0, -1.0, 0, 0.3]])
    plane = SupportPlane(UP, 0.0, 0.5, 0.1, 0.001, sides, DepthNoise(CAMERA[None], 0.001, 0.0))
    query = ask(points, viewpoints=CAMERA, up=UP, support_height=0.0)
    targeted = ask(points, viewpoints=CAMERA, up=UP, support_height=0.0, target=Box(np.full(3, -1.0), np.full(3, 1.0)))
    config = cloud.PreparationConfig()
    found, whole, aimed = (
        cloud.prepare(*asked) for asked in (
            (query, config, CPU, plane), (query, config, CPU), (targeted, config, CPU, plane),
        )
    )  # fmt: skip
    assert found is not None
    assert whole is not None
    assert aimed is not None
    assert 0.9 * cloud.MOST_ON_SUPPORT < len(found) <= cloud.MOST_ON_SUPPORT < len(whole) <= config.max_points
    assert len(aimed) > cloud.MOST_ON_SUPPORT
    distance = (found.points - found.viewpoints[0]).norm(dim=1)
    assert found.unsought is not None
    beyond = (found.unsought.points - found.viewpoints[0]).norm(dim=1)
    assert float(distance.max()) <= float(beyond.min()) + 0.005
    assert len(beyond) > len(found)


@pytest.mark.parametrize(
    ("a_cell", "fewest"), [(0.5, 1), (1.0, 1), (2.0, 2), (3.0, 3), (4.0, 4), (10.0, 4), (100.0, 4)]
)
def test_what_is_not_sought_counts_where_it_does_not_stand_alone(a_cell: float, fewest: int) -> None:
    """In a cube of three cells' edge: four points, or a tenth of what a surface has there."""
    sizes = range(1, 7)
    places = [[0.005, 0.005, 0.05 * size] for size in sizes]
    others = torch.tensor([place for place, size in zip(places, sizes, strict=True) for _ in range(size)])
    found = cloud._unsought(torch.zeros(1, 3), [others], 0.0045, a_cell)
    assert found is not None
    heights = sorted(round(float(height), 3) for height in found.points[:, 2])
    assert heights == [round(0.05 * size, 3) for size in sizes if size >= fewest]


@pytest.mark.parametrize(("distance", "counts"), [(0.0, True), (0.349, True), (0.351, False)])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_what_is_not_sought_counts_as_far_as_a_hand_reaches(
    distance: float, counts: bool, axis: int, sign: int
) -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]])
    other = torch.tensor([0.05, 0.1, 0.15])
    other[axis] = (points[1, axis] + distance) if sign > 0 else -distance
    assert (cloud._unsought(points, [other.expand(5, 3)], 0.0045, 10.0) is not None) == counts


def test_of_very_many_others_some_are_looked_at_and_a_surface_stays_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    surface = np.column_stack([rng.uniform(-0.1, 0.1, (40_000, 2)), np.zeros(40_000)])
    stray = np.column_stack([rng.uniform(-0.1, 0.1, (30, 2)), rng.uniform(0.05, 0.15, 30)])
    others = torch.from_numpy(rng.permutation(np.concatenate([surface, stray]))).float()

    def looked_at() -> torch.Tensor:
        found = cloud._unsought(torch.zeros(1, 3), [others], 0.0045, 20.0)
        assert found is not None
        return found.points

    every = looked_at()
    monkeypatch.setattr(cloud, "MOST_UNSOUGHT", 20_000)
    some = looked_at()
    assert max(float(points[:, 2].max()) for points in (every, some)) < 0.02
    assert len(some) > 0.95 * len(every)
    assert torch.cdist(every, some).amin(dim=1).max() < 0.0045
