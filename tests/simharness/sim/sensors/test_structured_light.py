"""`simkinect` and `redwood` against their formulae."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from simharness.sim.sensors.structured_light import Redwood, SimKinect, _agrees
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


def errors(sensor: SimKinect | Redwood, z: float, camera: CameraIntrinsics) -> Array:
    """Errors on frontal planes around a distance, so that the steps are met everywhere alike."""
    rng = np.random.default_rng(0)
    distances = rng.uniform(0.98 * z, 1.02 * z, 400)
    measured = np.stack([sensor(np.full((30, 40), distance), camera, rng)[4:-4, 4:-4] for distance in distances])
    return measured - distances[:, None, None]


@pytest.mark.parametrize("z", [0.5, 0.8])
def test_simkinect_deviates_by_its_two_steps_and_its_noise(z: float, camera: CameraIntrinsics) -> None:
    error = errors(SimKinect(), z, camera)
    first = z**2 / (480.0 * 0.075) / 8.0
    second = z**2 / 351.30
    expected = np.sqrt(first**2 / 12 + second**2 * (1 / 12 + 1 / 36))
    assert error.std() == pytest.approx(expected, rel=0.15)
    # Rounded down after adding a half, not rounded after it: the latter is half a step too near.
    assert abs(error.mean()) < 0.15 * second


def test_simkinect_loses_edges_and_keeps_planes(
    camera: CameraIntrinsics, block: Array, plane: Callable[..., Array]
) -> None:
    measured = SimKinect()(block, camera, np.random.default_rng(0))
    assert (measured[190:290, 258:262] == 0).mean() > 0.9
    assert (measured[190:290, 275:365] > 0).all()
    border = 4
    inside = SimKinect()(plane(0.7, 45.0), camera, np.random.default_rng(0))[border:-border, border:-border]
    assert (inside > 0).mean() > 0.95


@pytest.mark.parametrize(("z", "step", "sigma"), [(0.5, 0.00089, 0.00020), (1.0, 0.0036, 0.00079)])
def test_redwood_has_the_published_steps_and_deviation(
    z: float, step: float, sigma: float, camera: CameraIntrinsics
) -> None:
    error = errors(Redwood(), z, camera)
    assert error.std() == pytest.approx(np.sqrt(step**2 / 12 + sigma**2), rel=0.1)
    assert abs(error.mean()) < 0.1 * step
    measured = Redwood()(np.full((camera.height, camera.width), z), camera, np.random.default_rng(0))
    gaps = np.diff(np.unique(measured))
    assert gaps.min() == pytest.approx(step, rel=0.05)


def test_redwood_reads_pixels_two_by_two(camera: CameraIntrinsics) -> None:
    columns = np.indices((camera.height, camera.width))[1]
    depth = np.where(columns % 2 == 0, 0.6, 1.2)
    assert np.abs(Redwood()(depth, camera, np.random.default_rng(0)) - 0.6).max() < 0.01


@pytest.mark.parametrize("sensor", [SimKinect(), Redwood()])
def test_what_sees_nothing_stays_empty(sensor: SimKinect | Redwood, camera: CameraIntrinsics) -> None:
    depth = np.zeros((camera.height, camera.width))
    assert (sensor(depth, camera, np.random.default_rng(0)) == 0).all()
    depth[:, 320:] = 0.7
    measured = sensor(depth, camera, np.random.default_rng(0))
    assert (measured[:, :314] == 0).all()
    np.testing.assert_allclose(measured[measured > 0], 0.7, atol=0.01)


@pytest.mark.parametrize("seed", range(6))
def test_a_window_agrees_as_a_loop_over_its_pixels_has_it(seed: int) -> None:
    """The mean is that of what is seen in the window, which the border and holes cut."""
    rng = np.random.default_rng(seed)
    height, width = 24, 30
    columns = np.indices((height, width))[1]
    disparity = 40 + 0.02 * columns * (seed % 3) + rng.uniform(-0.13, 0.13, (height, width))
    disparity[:, 20:] += 0.3 * (seed % 2) * np.maximum(1, seed)
    seen = rng.random((height, width)) < (1.0, 0.95, 0.9)[seed % 3]
    seen[5:8, 3:7] = False
    disparity = np.where(seen, disparity, 0.0)
    expected = np.zeros((height, width), dtype=bool)
    for row, column in itertools.product(range(height), range(width)):
        window = [
            (r, c)
            for r in range(max(0, row - 4), min(height, row + 5))
            for c in range(max(0, column - 4), min(width, column + 5))
            if seen[r, c]
        ]
        if seen[row, column]:
            mean = sum(disparity[place] for place in window) / len(window)
            agreeing = sum(
                abs(disparity[r, c] - mean) < 0.1 * max(1.0, 1.44 * ((r - row) ** 2 + (c - column) ** 2))
                for r, c in window
            )
            expected[row, column] = agreeing > 5 / 6 * 81
    found = _agrees(disparity, seen)
    assert found[seen].tolist() == expected[seen].tolist()
    assert 20 < expected.sum() < height * width - 100


@pytest.mark.parametrize("z", [0.45, 0.9])
def test_simkinect_is_its_formula_at_another_focal_length_and_baseline(z: float, camera: CameraIntrinsics) -> None:
    """Where disparity comes in coarse steps, depth is that of a step and not of the plane."""
    sensor = SimKinect(focal_length=60.0, baseline=0.05)
    depth = np.full((40, 40), z)
    measured = sensor(depth, camera, np.random.default_rng(0))[6:-6, 6:-6]
    stepped = 60 * 0.05 / (round(8 * 60 * 0.05 / z) / 8)
    raw = 351.30 / stepped
    assert np.abs(351.30 / measured - raw).max() < 0.5 + 5 / 6
    expected = np.floor(raw + np.random.default_rng(1).normal(0.0, 1 / 6, 10_000) + 0.5).mean()
    assert (351.30 / measured).mean() == pytest.approx(expected, abs=0.08)
