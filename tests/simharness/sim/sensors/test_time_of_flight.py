"""Noise by distance and slant against its formulae."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from simharness.sim.sensors import time_of_flight
from simharness.sim.sensors.time_of_flight import TimeOfFlight, axial_sigma, incidence, lateral_sigma
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]

MIDDLE = np.s_[220:260, 300:340]


@pytest.mark.parametrize("z", [0.4, 0.7, 1.2])
def test_a_frontal_plane_deviates_with_the_square_of_the_distance(
    z: float, camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    error = (TimeOfFlight()(plane(z), camera, np.random.default_rng(0)) - z)[MIDDLE]
    error = error[error > -z]
    assert error.std() == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2, rel=0.06)
    assert abs(error.mean()) < 0.05 * error.std()


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 75.0])
def test_pixels_are_lost_by_the_cosine_of_the_angle_of_incidence(
    tilt: float, camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    depth = plane(0.7, tilt)
    assert incidence(depth, camera)[240, 320] == pytest.approx(np.deg2rad(tilt), abs=2e-3)
    lost = np.mean([TimeOfFlight()(depth, camera, np.random.default_rng(seed))[MIDDLE] == 0 for seed in range(12)])
    assert lost == pytest.approx(1 - np.cos(incidence(depth, camera)[MIDDLE]).mean(), abs=0.015)


def test_a_slanted_plane_has_the_noise_across_the_image_too(
    camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    depth = plane(0.7, 45.0)
    slope = np.gradient(depth, axis=0)[240, 320]
    measured = np.stack([TimeOfFlight()(depth, camera, np.random.default_rng(seed)) for seed in range(20)])[
        :, 240, 300:340
    ]
    error = (measured - depth[240, 320])[measured > 0]
    across = lateral_sigma(np.array(np.pi / 4)) * camera.fx / 585.0
    expected = np.hypot(axial_sigma(np.array(0.7), np.array(np.pi / 4)), np.sqrt(across**2 + 1 / 12) * slope)
    assert error.std() == pytest.approx(expected, rel=0.12)


def test_beyond_sixty_degrees_the_noise_along_the_axis_grows_with_the_slant() -> None:
    at = np.array(0.64)
    assert axial_sigma(at, np.deg2rad(59.0)) == axial_sigma(at, np.array(0.0))
    angle = np.deg2rad(70.0)
    expected = 0.0012 + 0.0019 * 0.24**2 + 0.0001 / 0.8 * angle**2 / (np.pi / 2 - angle) ** 2
    assert float(axial_sigma(at, np.array(angle))) == pytest.approx(expected)


def test_edges_are_as_good_as_lost(camera: CameraIntrinsics, block: Array) -> None:
    measured = TimeOfFlight()(block, camera, np.random.default_rng(0))
    assert (measured[190:290, 259:261] == 0).mean() > 0.8


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("coarseness", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("focal_length", [585.0, 300.0])
def test_a_pixel_reads_another_as_far_away_as_the_formula_says_in_pixels_of_the_sensor(
    axis: int, coarseness: float, focal_length: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wall whose depth, by micrometres, tells the row or column; an image with fewer pixels moves by fewer."""
    monkeypatch.setattr(time_of_flight, "axial_sigma", lambda depth, slant: np.zeros_like(depth))
    monkeypatch.setattr(time_of_flight, "incidence", lambda depth, camera: np.zeros_like(depth))
    fx = focal_length / coarseness
    camera = CameraIntrinsics(width=200, height=160, fx=fx, fy=fx, cx=100.0, cy=80.0)
    place = np.indices((160, 200))[axis]
    depth = 0.7 + 1e-7 * place
    measured = TimeOfFlight(focal_length)(depth, camera, np.random.default_rng(0))[20:-20, 20:-20]
    moved = np.rint((measured - 0.7) / 1e-7) - place[20:-20, 20:-20]
    moved = moved[measured > 0]
    sigma = 0.8 / coarseness
    steps = np.arange(-20, 21)
    shares = np.array(
        [math.erf((step + 0.5) / sigma / 2**0.5) - math.erf((step - 0.5) / sigma / 2**0.5) for step in steps]
    )
    assert moved.std() == pytest.approx(np.sqrt(shares / 2 @ steps**2), rel=0.08, abs=0.004)
    assert abs(moved.mean()) < 0.03


def test_at_the_border_what_would_be_read_beyond_is_the_border() -> None:
    camera = CameraIntrinsics(width=9, height=7, fx=5850.0, fy=5850.0, cx=4.0, cy=3.0)
    depth = np.full((7, 9), 0.7)
    measured = TimeOfFlight()(depth, camera, np.random.default_rng(0))
    assert (measured > 0.69).all()


def test_beyond_85_degrees_nothing_gets_worse() -> None:
    camera = CameraIntrinsics(width=41, height=41, fx=40.0, fy=40.0, cx=20.0, cy=20.0)
    step = np.where(np.arange(41) < 20, 0.5, 5.0)[:, None] * np.ones(41)
    assert incidence(step, camera).max() == np.deg2rad(85.0)
    assert incidence(np.zeros((5, 5)), camera).max() == np.deg2rad(85.0)
