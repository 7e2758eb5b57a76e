"""Wrong calibration has the size that it says."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.sensors.calibration import Calibration
from tesnet.geometry import Pose

CAMERA = Pose.look_at([0.3, -0.2, 0.6], [0.15, 0.15, 0.05], [0.0, 0.0, 1.0])


def angle_deg(pose: Pose) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(pose.rotation) - 1) / 2, -1, 1))))


def test_an_exact_pose_error_has_its_size_and_any_direction() -> None:
    rng = np.random.default_rng(0)
    wrong = Calibration(translation=0.005, rotation_deg=1.0, exact=True)
    errors = [CAMERA.inverse() @ wrong.believed_pose(CAMERA, rng) for _ in range(400)]
    np.testing.assert_allclose([np.linalg.norm(error.translation) for error in errors], 0.005, rtol=1e-9)
    np.testing.assert_allclose([angle_deg(error) for error in errors], 1.0, rtol=1e-6)
    directions = np.array([error.translation for error in errors]) / 0.005
    assert np.abs(directions.mean(axis=0)).max() < 0.12
    np.testing.assert_allclose(directions.T @ directions / len(errors), np.eye(3) / 3, atol=0.08)


def test_other_errors_are_uniform_up_to_their_size() -> None:
    rng = np.random.default_rng(0)
    wrong = Calibration(translation=0.005, rotation_deg=1.0, depth_scale=0.02, table_height=0.004)
    errors = [CAMERA.inverse() @ wrong.believed_pose(CAMERA, rng) for _ in range(400)]
    for sizes, limit in (
        ([np.linalg.norm(error.translation) for error in errors], 0.005),
        ([angle_deg(error) for error in errors], 1.0),
    ):
        assert max(sizes) <= limit * (1 + 1e-6)
        assert np.mean(sizes) == pytest.approx(limit / 2, rel=0.1)
    for values, limit in (
        ([wrong.scale_error(rng) - 1.0 for _ in range(400)], 0.02),
        ([wrong.height_error(rng) for _ in range(400)], 0.004),
    ):
        assert np.std(values) == pytest.approx(limit / np.sqrt(3), rel=0.1)
        assert abs(np.mean(values)) < 0.1 * limit


def test_a_right_calibration_draws_nothing() -> None:
    rng, untouched = np.random.default_rng(0), np.random.default_rng(0)
    right = Calibration()
    assert right.believed_pose(CAMERA, rng) is CAMERA
    assert (right.scale_error(rng), right.height_error(rng)) == (1.0, 0.0)
    assert rng.uniform() == untouched.uniform()
