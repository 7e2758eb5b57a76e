from __future__ import annotations

import json

import numpy as np
import pytest

from simharness.sim.camera import PRESETS, sample_camera
from simharness.sim.scene import WORKSPACE
from simharness.sim.sensors.catalogue import SENSORS
from training.viewing import SHOWS, Viewing, draw_viewing, sensor_of

pytestmark = pytest.mark.sim
MIDDLE = np.array([0.15, 0.15, 0.05])


def drawn(count: int = 400) -> list[Viewing]:
    return [draw_viewing("any", "random", np.random.default_rng(seed)) for seed in range(count)]


def test_views_come_from_everywhere() -> None:
    viewings = drawn()
    assert {len(viewing.cameras) for viewing in viewings} == {1, 2, 3, 4}
    assert {viewing.shows for viewing in viewings} == set(SHOWS)
    offsets = np.array([camera.translation - MIDDLE for viewing in viewings for camera in viewing.cameras])
    distances = np.linalg.norm(offsets, axis=1)
    assert distances.min() >= 0.35 - 1e-9
    assert distances.max() <= 1.2 + 1e-9
    polar = np.rad2deg(np.arccos(offsets[:, 2] / distances))
    assert polar.min() < 5
    assert 75 < polar.max() <= 80 + 1e-9
    quadrants = 2 * (offsets[:, 0] > 0) + (offsets[:, 1] > 0)
    assert np.bincount(quadrants, minlength=4).min() > len(offsets) / 8
    for viewing in viewings[:50]:
        for camera in viewing.cameras:
            ahead = camera.inverse().apply(MIDDLE[None])[0]
            np.testing.assert_allclose(ahead[:2], 0, atol=1e-6)
            assert WORKSPACE.contains(MIDDLE[None]).all()


def test_sensors_of_long_focus_stand_back() -> None:
    rng = np.random.default_rng(0)
    distances = [
        np.linalg.norm(camera.translation - MIDDLE)
        for _ in range(200)
        for camera in draw_viewing("any", "d415", rng).cameras
    ]
    assert min(distances) >= 0.5 - 1e-9


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_those_of_the_harness(preset: str) -> None:
    rng, same = np.random.default_rng(3), np.random.default_rng(3)
    viewing = draw_viewing(preset, None, rng)  # type: ignore[arg-type]
    assert viewing.seed == same.integers(2**32)
    expected = sample_camera(preset, same)  # type: ignore[arg-type]
    for camera, other in zip(viewing.cameras, expected, strict=True):
        np.testing.assert_array_equal(camera.matrix, other.matrix)
    assert viewing.shows == "box"


def test_a_viewing_is_told_in_json() -> None:
    viewing = draw_viewing("any", "random", np.random.default_rng(5))
    again = Viewing.described(json.loads(json.dumps(viewing.describe())))
    assert (again.sensor, again.seed, again.shows) == (viewing.sensor, viewing.seed, viewing.shows)
    for camera, other in zip(viewing.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(camera.matrix, other.matrix)


def test_a_seed_draws_one_sensor() -> None:
    assert sensor_of("d435", np.random.default_rng(0)) is SENSORS["d435"]
    one, same, other = (sensor_of("random", np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one == same != other
