"""Independent noise, Dex-Net's and the smooth distortion against their formulae."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.sensors.gaussian import DepthGaussian, GammaScale, PatchNoise, SmoothDistortion
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@pytest.mark.parametrize("z", [0.4, 1.2])
def test_independent_noise_has_its_deviation_at_every_distance(
    z: float, camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    error = DepthGaussian(0.002)(plane(z), camera, np.random.default_rng(0)) - z
    assert error.std() == pytest.approx(0.002, rel=0.01)
    assert abs(error.mean()) < 2e-5
    assert abs((error[:, 1:] * error[:, :-1]).mean()) < 0.01 * error.var()


def test_dex_noise_is_the_published_formula_draw_by_draw(camera: CameraIntrinsics, block: Array) -> None:
    measured = SENSORS["dex"].measure(block.astype(np.float32), camera, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    factor = rng.gamma(1000.0, 0.001)
    coarse = rng.normal(0.0, 0.005, (120, 160))
    patches = ndimage.zoom(coarse, 4, order=3, mode="nearest", grid_mode=True)
    expected = block.astype(np.float32).astype(np.float64) * factor + patches
    np.testing.assert_array_equal(measured, expected.astype(np.float32))


def test_a_gamma_scale_has_mean_one_and_moves_the_whole_image(camera: CameraIntrinsics, block: Array) -> None:
    rng = np.random.default_rng(0)
    ratios = np.stack([GammaScale()(block, camera, rng)[::40, ::40] / block[::40, ::40] for _ in range(400)])
    np.testing.assert_allclose(ratios, ratios[:, :1, :1] * np.ones_like(ratios), rtol=1e-12)
    assert ratios.std() == pytest.approx(1 / np.sqrt(1000.0), rel=0.1)
    assert ratios.mean() == pytest.approx(1.0, abs=0.005)


def test_patches_are_as_deep_as_published_and_alike_over_four_pixels(
    camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    error = PatchNoise()(plane(0.6), camera, np.random.default_rng(0)) - 0.6
    assert error.std() == pytest.approx(0.0044, rel=0.05)
    assert abs(error.mean()) < 1e-4
    assert (error[:, 1:] * error[:, :-1]).mean() > 0.8 * error.var()
    assert abs((error[:, 8:] * error[:, :-8]).mean()) < 0.15 * error.var()


def test_a_smooth_distortion_bends_the_whole_image_by_about_a_percent_without_noise(
    camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(0)
    wall = plane(0.7)
    ratios = np.stack([SmoothDistortion()(wall, camera, rng) / wall for _ in range(60)])
    assert ratios.std() == pytest.approx(0.0075 * 0.88, rel=0.12)
    assert abs(ratios.mean() - 1.0) < 0.001
    assert np.abs(np.diff(ratios, axis=2)).max() < 0.0006
    np.testing.assert_array_equal(SmoothDistortion()(np.zeros_like(wall), camera, rng), 0.0)
