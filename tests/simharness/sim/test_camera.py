"""Cameras: images agree with the geometry, noise comes in the right place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from simharness.sim.camera import (
    FAR,
    INTRINSICS,
    NEAR,
    PRESETS,
    Noise,
    Preset,
    add_depth_noise,
    observe,
    render,
    sample_camera,
    thin,
)
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT, restore_scene
from simharness.sim.world import World

pytestmark = pytest.mark.sim

TOP = TABLE_HEIGHT + 0.08


@pytest.fixture
def world() -> Iterator[World]:
    """A table with a box of 40 x 60 x 80 mm in its middle."""
    with World() as world:
        restore_scene(world, {"kind": "packed", "objects": []}, {})
        world.add_static_box((0.02, 0.03, 0.04), (0.15, 0.15, TOP - 0.04), colour=(1.0, 0.0, 0.0, 1.0))
        yield world


def test_rendered_depth_lies_on_the_surfaces_to_a_hundredth_of_a_millimetre(world: World) -> None:
    (camera,) = sample_camera("giga", np.random.default_rng(0))
    images = render(world, camera)
    points = camera.apply(INTRINSICS.back_project(images.depth))
    table, box = np.unique(images.segmentation[images.segmentation >= 0])
    bodies = images.segmentation[images.depth > 0]
    assert images.depth.max() < FAR
    assert images.depth[images.depth > 0].min() > NEAR
    # Half a pixel of error in the rows would lift the table by half a millimetre.
    assert np.abs(points[bodies == table][:, 2] - TABLE_HEIGHT).max() < 1e-5
    top = points[(bodies == box) & (points[:, 2] > TOP - 1e-5)]
    assert len(top) > 500
    assert np.abs(top[:, 2] - TOP).max() < 1e-5
    front = points[(bodies == box) & (points[:, 2] < TOP - 0.002)]
    assert np.abs(front[:, 1] - 0.12).max() < 1e-5
    # Half a pixel of error in the columns would move the middle by half a millimetre.
    assert top[:, 0].mean() == pytest.approx(0.15, abs=1e-4)


def test_colour_and_segmentation_show_the_same_body(world: World) -> None:
    (camera,) = sample_camera("giga", np.random.default_rng(0))
    images = render(world, camera)
    box = images.segmentation == images.segmentation.max()
    assert 1000 < box.sum() < 40000
    red, green = images.colour[box][:, 0], images.colour[box][:, 1]
    assert red.min() > 40
    assert green.max() < red.min()


def test_no_noise_lifts_the_table_into_the_cloud() -> None:
    with World() as world:
        restore_scene(world, {"kind": "packed", "objects": []}, {})
        observation = observe(world, "random", np.random.default_rng(0), Noise(point_sigma=0.003))
        assert observation.points_world.shape == (0, 3)


def test_point_noise_has_its_size_and_comes_after_the_crop(world: World) -> None:
    clean = observe(world, "random", np.random.default_rng(4), Noise())
    noisy = observe(world, "random", np.random.default_rng(4))
    assert (clean.points_world >= PERCEPTION_BOX.minimum.astype(np.float32)).all()
    difference = noisy.points_world - clean.points_world
    assert difference.std() == pytest.approx(0.0008, rel=0.05)
    assert noisy.viewpoints.shape == (1, 3)
    np.testing.assert_array_equal(clean.images[0].depth, noisy.images[0].depth)


def test_the_same_seed_gives_the_same_observation(world: World) -> None:
    first, second = (observe(world, "giga", np.random.default_rng(9)) for _ in range(2))
    assert first.points_world.tobytes() == second.points_world.tobytes()


def test_sensor_noise_leaves_empty_pixels_empty() -> None:
    depth = np.full((480, 640), 0.7, dtype=np.float32)
    depth[:, :100] = 0.0
    noisy = add_depth_noise(depth, Noise(dex=True), np.random.default_rng(0))
    assert (noisy[:, :100] == 0).all()
    assert 0.002 < noisy[:, 100:].std() < 0.006
    # Neighbours err together.
    assert np.abs(np.diff(noisy[:, 100:], axis=1)).mean() < 0.5 * noisy[:, 100:].std()
    noisy = add_depth_noise(depth, Noise(depth_sigma=0.001), np.random.default_rng(0))
    assert noisy[:, 100:].std() == pytest.approx(0.001, rel=0.05)


@pytest.mark.parametrize(("preset", "views"), [("random", 1), ("giga", 1), ("multi3", 3), ("vgn6", 6)])
def test_every_preset_looks_at_the_workspace_from_where_the_protocol_says(preset: Preset, views: int) -> None:
    cameras = sample_camera(preset, np.random.default_rng(2))
    assert len(cameras) == views
    for camera in cameras:
        centre = camera.inverse().apply([0.15, 0.15, 0.1])
        assert 0.4 < centre[2] < 0.8
        assert np.abs(centre[:2] / centre[2]).max() < 0.3
        assert camera.translation[2] > 0.3
    heights = {round(camera.translation[2], 9) for camera in cameras}
    assert len(heights) == 1


def test_another_polar_angle_leaves_the_rest_of_the_view_as_it_was() -> None:
    def view(polar_deg: float | None) -> tuple[float, float, float]:
        (camera,) = sample_camera("random", np.random.default_rng(3), polar_deg)
        away = camera.translation - [0.15, 0.15, 0.25]
        radius = float(np.linalg.norm(away))
        return radius, float(np.arctan2(away[1], away[0])), float(np.rad2deg(np.arccos(away[2] / radius)))

    own, steep = view(None), view(15.0)
    assert own[:2] == pytest.approx(steep[:2])
    assert steep[2] == pytest.approx(15.0)
    assert 45 <= own[2] <= 60


def test_a_thinned_cloud_keeps_the_mean_of_each_voxel() -> None:
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.001, 0.001], [-0.001, 0.001, 0.001], [0.011, 0.0, 0.0]])
    expected = [[-0.001, 0.001, 0.001], [0.002, 0.001, 0.001], [0.011, 0.0, 0.0]]
    np.testing.assert_allclose(thin(points, 0.01), expected, atol=1e-12)
    assert thin(np.empty((0, 3)), 0.01).shape == (0, 3)


@pytest.mark.needs("open3d")
def test_fused_views_show_every_side_of_the_box(world: World) -> None:
    observation = observe(world, "multi3", np.random.default_rng(0), Noise())
    points = observation.points_world.astype(np.float64)
    assert observation.viewpoints.shape == (3, 3)
    distances = np.abs(np.abs(points - [0.15, 0.15, TOP - 0.04]) - [0.02, 0.03, 0.04]).min(axis=1)
    assert np.median(distances) < 0.0005
    for low, high, axis in ((0.13, 0.17, 0), (0.12, 0.18, 1)):
        assert (np.abs(points[:, axis] - low) < 0.002).sum() > 100
        assert (np.abs(points[:, axis] - high) < 0.002).sum() > 100


def test_an_unknown_preset_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="valid: " + ", ".join(PRESETS)):
        sample_camera("vgn7", np.random.default_rng(0))  # type: ignore[arg-type]


def test_dex_noise_leaves_the_mean_depth_as_it_is() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((8, 8), 0.6, dtype=np.float32)
    means = [float(add_depth_noise(flat, Noise(dex=True), rng).mean()) for _ in range(800)]
    assert np.mean(means) == pytest.approx(0.6, abs=0.003)
    assert np.std(means) == pytest.approx(0.6 * np.sqrt(1000) * 0.001, rel=0.2)
