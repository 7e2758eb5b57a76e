"""Cameras: images agree with the geometry, noise comes in the right place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from simharness.sim.camera import (
    FAR,
    INTRINSICS,
    NEAR,
    PRESETS,
    Observation,
    Preset,
    Stand,
    observe,
    observe_from,
    perception_box,
    render,
    sample_camera,
    thin,
    together,
)
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT, restore_scene
from simharness.sim.sensors.calibration import Calibration
from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.sensors.gaussian import DepthGaussian
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.world import World
from tesnet.geometry import CameraIntrinsics, Pose

pytestmark = pytest.mark.sim

TOP = TABLE_HEIGHT + 0.08


def test_the_camera_is_the_protocols() -> None:
    assert CameraIntrinsics(width=640, height=480, fx=540.0, fy=540.0, cx=320.0, cy=240.0) == INTRINSICS


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


@pytest.mark.parametrize("place", [(0.15, -0.6, 0.3), (0.9, 0.15, 0.06), (0.15, 0.15, 0.8)])
def test_depth_is_where_a_body_is_and_nowhere_else(world: World, place: tuple[float, float, float]) -> None:
    """The sky, which some of these cameras see, has none."""
    images = render(world, Pose.look_at(place, [0.15, 0.15, 0.1501], [0.0, 1.0, 1.0]))
    bodies = images.segmentation >= 0
    assert bodies.any()
    assert bodies.all() == (place[2] > 0.5)
    np.testing.assert_array_equal(images.depth > 0, bodies)
    assert images.depth.max() < FAR - 1e-3


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
        observation = observe(world, "random", np.random.default_rng(0), Sensor(point_sigma=0.003))
        assert observation.points_world.shape == (0, 3)


def test_point_noise_has_its_size_and_comes_after_the_crop(world: World) -> None:
    clean = observe(world, "random", np.random.default_rng(4), Sensor())
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
    noisy = SENSORS["dex"].measure(depth, INTRINSICS, np.random.default_rng(0))
    assert (noisy[:, :100] == 0).all()
    assert 0.002 < noisy[:, 100:].std() < 0.006
    # Neighbours err together.
    assert np.abs(np.diff(noisy[:, 100:], axis=1)).mean() < 0.5 * noisy[:, 100:].std()
    noisy = Sensor((DepthGaussian(0.001),)).measure(depth, INTRINSICS, np.random.default_rng(0))
    assert noisy[:, 100:].std() == pytest.approx(0.001, rel=0.05)


@pytest.mark.parametrize(("preset", "views"), [("random", 1), ("giga", 1), ("multi3", 3), ("vgn6", 6), ("top", 1)])
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
        (camera,) = sample_camera("random", np.random.default_rng(3), Stand(polar_deg))
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
    observation = observe(world, "multi3", np.random.default_rng(0), Sensor())
    points = observation.points_world.astype(np.float64)
    assert observation.viewpoints.shape == (3, 3)
    distances = np.abs(np.abs(points - [0.15, 0.15, TOP - 0.04]) - [0.02, 0.03, 0.04]).min(axis=1)
    assert np.median(distances) < 0.0005
    for low, high, axis in ((0.13, 0.17, 0), (0.12, 0.18, 1)):
        assert (np.abs(points[:, axis] - low) < 0.002).sum() > 100
        assert (np.abs(points[:, axis] - high) < 0.002).sum() > 100


def test_several_looks_together_are_all_that_each_of_them_saw(world: World) -> None:
    first = observe(world, "random", np.random.default_rng(0))
    wrong = Sensor(calibration=Calibration(translation=0.0, rotation_deg=0.0, table_height=0.005))
    second = observe(world, "random", np.random.default_rng(1), wrong)
    both = together([first, second])
    for name in ("points_world", "viewpoints", "Ts_world_camera"):
        np.testing.assert_array_equal(
            getattr(both, name), np.concatenate([getattr(first, name), getattr(second, name)])
        )
    assert both.images == (*first.images, *second.images)
    assert both.table_height == second.table_height != TABLE_HEIGHT
    assert together([first]) is first


def test_an_unknown_preset_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="valid: " + ", ".join(PRESETS)):
        sample_camera("vgn7", np.random.default_rng(0))  # type: ignore[arg-type]


def test_a_camera_straight_above_sees_the_table_middle_in_the_image_middle() -> None:
    (camera,) = sample_camera("top", np.random.default_rng(0))
    assert camera.translation == pytest.approx([0.15, 0.15, TABLE_HEIGHT + 0.6])
    np.testing.assert_allclose(camera.rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-12)
    # Its image is turned like that of a camera that nearly stands there.
    (near,) = sample_camera("top", np.random.default_rng(0), Stand(polar_deg=0.01))
    np.testing.assert_allclose(near.rotation, camera.rotation, atol=1e-3)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_camera_can_be_put_at_any_distance_and_angle_to_the_table(preset: Preset) -> None:
    for polar_deg, distance in ((0.0, 0.35), (80.0, 1.2)):
        for camera in sample_camera(preset, np.random.default_rng(1), Stand(polar_deg, distance)):
            away = camera.translation - [0.15, 0.15, TABLE_HEIGHT]
            assert np.linalg.norm(away) == pytest.approx(distance)
            assert np.rad2deg(np.arccos(away[2] / distance)) == pytest.approx(polar_deg, abs=1e-5)
            np.testing.assert_allclose(camera.inverse().apply([0.15, 0.15, TABLE_HEIGHT]), [0, 0, distance], atol=1e-9)


def test_a_wrong_calibration_moves_the_cloud_and_what_the_planner_believes_but_not_the_truth(world: World) -> None:
    (camera,) = sample_camera("giga", np.random.default_rng(0))
    wrong = Calibration(translation=0.005, rotation_deg=1.0, exact=True)
    true = observe_from(world, [camera], np.random.default_rng(0), Sensor())
    shown = observe_from(world, [camera], np.random.default_rng(0), Sensor(calibration=wrong))
    believed = wrong.believed_pose(camera, np.random.default_rng(0))
    np.testing.assert_allclose(shown.viewpoints[0], believed.translation)
    np.testing.assert_array_equal(shown.Ts_world_camera, true.Ts_world_camera)
    top = true.points_world[true.points_world[:, 2] > TOP - 1e-4].astype(np.float64)
    moved = believed.apply(camera.inverse().apply(top))
    inside = (moved > PERCEPTION_BOX.minimum + 1e-3).all(axis=1)
    gap = np.linalg.norm(moved[inside][:50, None] - shown.points_world[None], axis=2).min(axis=1)
    assert gap.max() < 1e-6
    assert np.linalg.norm(moved - top, axis=1).min() > 0.002


def test_a_wrong_depth_scale_moves_points_along_their_rays_and_a_wrong_table_height_moves_the_crop(
    world: World,
) -> None:
    (camera,) = sample_camera("top", np.random.default_rng(0))
    scaled = Sensor(calibration=Calibration(depth_scale=0.02, exact=True))
    heights = {
        round(float(observe_from(world, [camera], np.random.default_rng(seed), scaled).points_world[:, 2].max()), 4)
        for seed in range(8)
    }
    distance = camera.translation[2] - TOP
    assert heights == {round(camera.translation[2] - distance * factor, 4) for factor in (0.98, 1.02)}
    raised = Sensor(calibration=Calibration(table_height=0.004, exact=True))
    seen = [observe_from(world, [camera], np.random.default_rng(seed), raised) for seed in range(8)]
    assert {round(observation.table_height - TABLE_HEIGHT, 6) for observation in seen} == {-0.004, 0.004}
    lowered = perception_box(TABLE_HEIGHT - 0.004)
    assert lowered.minimum[2] == pytest.approx(PERCEPTION_BOX.minimum[2] - 0.004)
    np.testing.assert_array_equal(lowered.maximum, PERCEPTION_BOX.maximum)


def test_with_the_table_in_view_the_cloud_holds_it_and_all_that_was_shown_without(world: World) -> None:
    (camera,) = sample_camera("giga", np.random.default_rng(0))
    alone = observe_from(world, [camera], np.random.default_rng(0), Sensor()).points_world
    whole = observe_from(world, [camera], np.random.default_rng(0), Sensor(), table_in_view=True).points_world
    assert (np.abs(whole[:, 2] - TABLE_HEIGHT) < 1e-5).sum() > 10_000
    inside = ((whole >= PERCEPTION_BOX.minimum) & (whole <= PERCEPTION_BOX.maximum)).all(axis=1)
    np.testing.assert_array_equal(whole[inside], alone)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("error", [0.0, 0.015])
def test_the_cloud_is_cropped_where_the_table_is_believed_to_be(world: World, error: float, seed: int) -> None:
    sensor = Sensor(calibration=Calibration(table_height=error, exact=True))
    seen = observe(world, "random", np.random.default_rng(seed), sensor)
    assert abs(seen.table_height - TABLE_HEIGHT) == pytest.approx(error)
    lowest = float(PERCEPTION_BOX.minimum[2]) + seen.table_height - TABLE_HEIGHT
    shown = perception_box(seen.table_height)
    assert shown.minimum[2] == pytest.approx(lowest)
    np.testing.assert_allclose(
        [*shown.minimum[:2], *shown.maximum], [*PERCEPTION_BOX.minimum[:2], *PERCEPTION_BOX.maximum]
    )
    # Of the box's walls, or where the crop reaches into the table, of that.
    assert float(seen.points_world[:, 2].min()) == pytest.approx(max(lowest, TABLE_HEIGHT), abs=0.002)


CENTRES: dict[Preset, tuple[float, float, float]] = {
    "random": (0.15, 0.15, 0.25),
    "giga": (0.15, 0.15, 0.1),
    "multi3": (0.15, 0.15, 0.25),
    "vgn6": (0.15, 0.15, 0.0),
    "top": (0.15, 0.15, TABLE_HEIGHT),
}


def stands(preset: Preset, seed: int) -> list[tuple[float, float, float]]:
    """Radius, polar angle and azimuth of each view about what its preset looks at, degrees."""
    found = []
    for camera in sample_camera(preset, np.random.default_rng(seed)):
        np.testing.assert_allclose(camera.inverse().apply(CENTRES[preset])[:2], 0, atol=1e-9)  # in the image's middle
        x, y, z = camera.translation - CENTRES[preset]
        radius = math.hypot(x, y, z)
        azimuth = math.degrees(math.atan2(y, x)) if math.hypot(x, y) > 1e-9 else -90.0
        found.append((radius, math.degrees(math.acos(z / radius)), azimuth))
    return found


def test_presets_without_chance_stand_where_the_protocol_says() -> None:
    assert stands("giga", 0) == [pytest.approx((0.6, 60, -90))]
    assert stands("top", 0) == [pytest.approx((0.6, 0, -90), abs=1e-5)]
    around = [(0.6, 30, azimuth if azimuth <= 180 else azimuth - 360) for azimuth in range(0, 360, 60)]
    for found, (radius, polar, azimuth) in zip(stands("vgn6", 0), around, strict=True):
        assert found[:2] == pytest.approx((radius, polar))
        assert abs(found[2] - azimuth) % 360 == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("preset", "widest"), [("random", 180.0), ("multi3", 120.0)])
def test_presets_of_chance_fill_their_ranges_and_views_of_one_stand_evenly_about(preset: Preset, widest: float) -> None:
    views = [stands(preset, seed) for seed in range(200)]
    firsts = np.array([found[0] for found in views])
    for column, (low, high) in enumerate(((0.6, 0.75), (45.0, 60.0), (0.0, widest))):
        shares = (firsts[:, column] - low) / (high - low)
        assert -1e-6 <= shares.min() < 0.05
        assert 0.95 < shares.max() <= 1 + 1e-6
    for found in views:
        for number, (radius, polar, azimuth) in enumerate(found):
            assert (radius, polar) == pytest.approx(found[0][:2])
            turned = (azimuth - found[0][2] - 120 * number) % 360
            assert min(turned, 360 - turned) == pytest.approx(0, abs=1e-6)


def test_what_is_asked_of_a_view_reaches_it(world: World) -> None:
    def seen(**options: Any) -> Observation:
        return observe(world, "random", np.random.default_rng(3), Sensor(), **options)

    plain = seen()
    assert (plain.images[0].segmentation == -1).all()
    thinned = len(thin(plain.points_world, 0.01))
    assert len(seen(voxel_size=0.01).points_world) == pytest.approx(thinned, rel=0.02)
    assert thinned < len(plain.points_world) / 3
    assert (seen(segmentation=True).images[0].segmentation >= 0).any()
    assert len(seen(table_in_view=True).points_world) > 2 * len(plain.points_world)
    stand = Stand(40.0, 0.5)
    np.testing.assert_allclose(
        seen(stand=stand).viewpoints, [sample_camera("random", np.random.default_rng(3), stand)[0].translation]
    )
