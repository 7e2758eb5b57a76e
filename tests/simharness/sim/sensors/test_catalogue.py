"""Every sensor by name, and sensors at random."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from simharness.sim.sensors.calibration import Calibration
from simharness.sim.sensors.catalogue import D415, D435, SENSORS, SensorName, random_sensor
from simharness.sim.sensors.stereo import Stereo
from simharness.sim.sensors.structured_light import Redwood, SimKinect
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_a_sensor_keeps_most_of_a_scene_within_a_few_percent_and_invents_nothing(
    name: SensorName, camera: CameraIntrinsics, block: Array
) -> None:
    scene = block.astype(np.float32)
    scene[:, :80] = 0.0
    measured = SENSORS[name].measure(scene, camera, np.random.default_rng(1))
    assert (measured[:, :76] == 0).all()
    seen = measured > 0
    assert seen.sum() > 0.9 * (scene > 0).sum()
    error = measured[190:290, 275:360] - 0.6
    assert np.abs(np.median(error[measured[190:290, 275:360] > 0])) < 0.06
    again = SENSORS[name].measure(scene, camera, np.random.default_rng(1))
    np.testing.assert_array_equal(measured, again)


@pytest.mark.parametrize(
    ("stereo", "width", "field_deg", "baseline"), [(D435, 848, 90.0, 0.05), (D415, 1280, 65.0, 0.055)]
)
def test_a_stereo_camera_has_the_focal_length_of_its_width_and_field_of_view(
    stereo: Stereo, width: int, field_deg: float, baseline: float
) -> None:
    assert stereo.focal_length == pytest.approx(width / 2 / np.tan(np.deg2rad(field_deg) / 2), abs=0.1)
    assert stereo.baseline == baseline


def test_training_sensors_differ_and_have_no_error_that_the_image_cannot_show() -> None:
    rng = np.random.default_rng(0)
    drawn = [random_sensor(rng) for _ in range(200)]
    assert len(set(drawn)) > 150  # the bare time of flight repeats
    for sensor in drawn:
        assert sensor.calibration == Calibration()
        assert not any(isinstance(part, SimKinect | Redwood) for part in sensor.depth)
    assert {type(part).__name__ for sensor in drawn for part in sensor.depth} == {
        "Dropout",
        "FlyingPixels",
        "PatchNoise",
        "Stereo",
        "TimeOfFlight",
    }
