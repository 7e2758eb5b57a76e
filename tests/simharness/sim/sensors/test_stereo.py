"""Stereo: deviation against distance, steps, near limit, hidden bands and edges against their formulae."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from simharness.sim.sensors.catalogue import D415, D435
from simharness.sim.sensors.stereo import Stereo
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@pytest.mark.parametrize(
    ("sensor", "z", "expected"),
    [
        (D435, 0.4, 0.00060),
        (D435, 0.5, 0.00094),
        (D435, 0.7, 0.00185),
        (D435, 1.0, 0.0038),
        (D415, 0.5, 0.00036),
        (D415, 0.7, 0.00071),
        (D415, 1.0, 0.00145),
    ],
)
def test_depth_deviates_by_the_squared_distance_over_focal_length_and_baseline(
    sensor: Stereo, z: float, expected: float, camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(0)
    error = np.stack([sensor(plane(z), camera, rng) - z for _ in range(3)])
    disparity_sigma = np.hypot(sensor.sigma, 1 / sensor.steps / np.sqrt(12))
    assert error.std() == pytest.approx(z**2 * disparity_sigma / (sensor.focal_length * sensor.baseline), rel=0.05)
    assert error.std() == pytest.approx(expected, rel=0.06)
    assert abs(error.mean()) < 0.05 * error.std() + z**2 / (sensor.focal_length * sensor.baseline) / sensor.steps


def test_disparity_comes_in_steps(camera: CameraIntrinsics, plane: Callable[..., Array]) -> None:
    measured = D435(plane(0.7, 30.0), camera, np.random.default_rng(0))
    steps = 424.0 * 0.05 / measured * 32
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_errors_are_alike_over_the_matching_window_scaled_to_the_image(
    camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    def alike(sensor: Stereo, pixels: int) -> float:
        error = replace(sensor, steps=10**6)(plane(0.7), camera, np.random.default_rng(0)) - 0.7
        return float((error[:, :-pixels] * error[:, pixels:]).mean() / error.var())

    # 7 pixels of the sensor are 8.9 of a D435's image here and 3.8 of a D415's.
    assert alike(D435, 3) > 0.6
    assert alike(D415, 3) < 0.3
    assert abs(alike(D435, 20)) < 0.05


def test_nothing_is_nearer_than_the_searched_disparity(camera: CameraIntrinsics, plane: Callable[..., Array]) -> None:
    for sensor, limit in ((D435, 0.168), (D415, 0.4385)):
        assert (sensor(plane(limit * 0.99), camera, np.random.default_rng(0)) == 0).all()
        assert (sensor(plane(limit * 1.01), camera, np.random.default_rng(0)) > 0).all()


def test_a_band_on_the_left_of_things_is_empty_as_wide_as_the_difference_of_disparities(
    camera: CameraIntrinsics, block: Array
) -> None:
    sensor = replace(D435, sigma=0.0, window=0.1)
    measured = sensor(block, camera, np.random.default_rng(0))
    expected = camera.fx * 0.05 * (1 / 0.6 - 1 / 0.8)
    band = np.flatnonzero(measured[240] == 0)
    assert len(band) == pytest.approx(expected, abs=1.0)
    assert band.max() == 259
    assert band.min() == 260 - len(band)
    assert (measured[:170] > 0).all()
    assert (measured[310:] > 0).all()


def test_hidden_pixels_are_those_whose_ray_from_the_right_imager_is_blocked(camera: CameraIntrinsics) -> None:
    # A thick post in front of a wall, traced point by point: nothing between a point of the wall and the right imager.
    depth = np.full((camera.height, camera.width), 0.9)
    depth[:, 300:420] = 0.5
    measured = replace(D435, sigma=0.0, window=0.1)(depth, camera, np.random.default_rng(0))
    columns = np.arange(camera.width)
    x_wall = (columns - camera.cx) / camera.fx * 0.9
    crossing = 0.05 + (x_wall - 0.05) * 0.5 / 0.9  # where the ray to the right imager passes the post's front
    left, right = ((edge - camera.cx) / camera.fx * 0.5 for edge in (300, 420))
    blocked = (crossing > left) & (crossing < right) & (columns < 300)
    lost = measured[0] == 0
    assert np.count_nonzero(lost != blocked) <= 1


def test_background_beside_edges_is_lost_or_takes_the_foregrounds_depth_half_a_window_wide(
    camera: CameraIntrinsics, block: Array
) -> None:
    sensor = replace(D435, sigma=0.0, steps=10**6)
    measured = sensor(block, camera, np.random.default_rng(0))
    half = round(sensor.window * camera.fx / sensor.focal_length / 2)
    beside = measured[190:290, 380 : 380 + half]
    fattened = np.isclose(beside, 0.6, atol=1e-4)
    assert (fattened | (beside == 0)).all()
    assert 0.3 < fattened.mean() < 0.7
    np.testing.assert_allclose(measured[190:290, 380 + half : 400], 0.8, atol=1e-4)
    np.testing.assert_allclose(measured[190:290, 262:378], 0.6, atol=1e-4)


def test_a_table_seen_at_a_slant_loses_nothing(camera: CameraIntrinsics, plane: Callable[..., Array]) -> None:
    slanted = np.clip(plane(0.6, -60.0), 0.2, 1.9)
    assert (D435(slanted, camera, np.random.default_rng(0)) > 0).mean() > 0.99
