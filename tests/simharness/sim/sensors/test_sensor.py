"""A sensor is what its parts do, one after the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from simharness.sim.sensors.gaussian import DepthGaussian, PatchNoise
from simharness.sim.sensors.losses import Dropout
from simharness.sim.sensors.sensor import Sensor
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


def test_parts_act_in_their_order_with_one_generator(camera: CameraIntrinsics, block: Array) -> None:
    measured = Sensor((PatchNoise(), Dropout())).measure(block.astype(np.float32), camera, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    noisy = PatchNoise()(block.astype(np.float32).astype(np.float64), camera, rng)
    np.testing.assert_array_equal(measured, Dropout()(noisy, camera, rng).astype(np.float32))
    assert measured.dtype == np.float32


def test_a_sensor_without_parts_gives_the_image_and_draws_nothing(camera: CameraIntrinsics, block: Array) -> None:
    image = block.astype(np.float32)
    rng, untouched = np.random.default_rng(0), np.random.default_rng(0)
    np.testing.assert_array_equal(Sensor(point_sigma=0.001).measure(image, camera, rng), image)
    assert rng.uniform() == untouched.uniform()


def test_a_pixel_that_is_seen_never_becomes_empty_or_negative_by_noise(camera: CameraIntrinsics) -> None:
    image = np.full((camera.height, camera.width), 0.001, dtype=np.float32)
    image[:, :100] = 0.0
    measured = Sensor((DepthGaussian(0.01),)).measure(image, camera, np.random.default_rng(0))
    assert (measured[:, :100] == 0).all()
    assert (measured[:, 100:] > 0).all()


def test_parts_are_added_and_taken_away_by_kind() -> None:
    sensor = Sensor((PatchNoise(),)).with_part(Dropout())
    assert sensor.depth == (PatchNoise(), Dropout())
    assert sensor.without(PatchNoise) == Sensor((Dropout(),))
