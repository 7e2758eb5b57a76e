from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

from simharness.sim.camera import PRESETS, perception_box, sample_camera
from simharness.sim.objects import ObjectModel
from simharness.sim.scene import TABLE_HEIGHT, WORKSPACE, restore_scene
from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.world import World, data_path
from tesnet.hands import HANDS
from training.viewing import SHOWS, Camera, MoreViews, Shows, Viewing, draw_viewing, sensor_of

pytestmark = pytest.mark.sim
MIDDLE = np.array([0.15, 0.15, 0.05])


def drawn(count: int = 400) -> list[Viewing]:
    return [draw_viewing("any", "random", np.random.default_rng(seed)) for seed in range(count)]


def test_labels_are_shown_from_as_many_new_cameras_as_asked_for_and_by_default_none() -> None:
    rng = np.random.default_rng(0)
    assert MoreViews().draw(rng) == []
    assert len(MoreViews(3, "any", "random").draw(rng)) == 3


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
    displaced, exact = (sensor_of(name, np.random.default_rng(1)) for name in ("random-pose", "random"))
    assert (displaced.depth, displaced.point_sigma) == (exact.depth, exact.point_sigma)
    assert displaced.calibration.translation > 0 == exact.calibration.translation


@pytest.mark.parametrize("camera", ["any", "random"])
def test_who_fears_a_wrong_pose_shows_the_table(camera: Camera) -> None:
    shown = {draw_viewing(camera, "random-pose", np.random.default_rng(seed)).shows for seed in range(40)}
    assert shown == ({"table", "open"} if camera == "any" else {"table"})


@pytest.fixture
def world() -> Iterator[World]:
    """A table with one cube of 5 cm in its middle."""
    item = {
        "name": "cube",
        "scale": 1.0,
        "position": [0.15, 0.15, TABLE_HEIGHT + 0.025],
        "quaternion_xyzw": [0, 0, 0, 1],
    }
    cube = ObjectModel("cube", data_path() / "cube_small.urdf")
    with World() as world:
        restore_scene(world, {"kind": "packed", "objects": [item]}, {"cube": cube})
        yield world


@pytest.mark.parametrize("shows", SHOWS)
def test_what_is_shown_decides_whether_the_table_is_seen_calibrated_by_and_bounded(world: World, shows: Shows) -> None:
    """Through a camera whose depth is wrong: by the table, where that is seen, the cloud comes back to its height."""
    viewing = Viewing(sample_camera("random", np.random.default_rng(1)), "d435-uncalibrated", 5, shows)
    observation = viewing.observe(world)
    query = viewing.query(observation, 3, HANDS["rg2"].gripper)
    assert (query.seed, query.gripper) == (3, HANDS["rg2"].gripper)
    assert query.support_height == observation.table_height
    assert (query.workspace is None) == (shows == "open")
    if query.workspace is not None:
        expected = perception_box(observation.table_height)
        np.testing.assert_allclose(
            [query.workspace.minimum, query.workspace.maximum], [expected.minimum, expected.maximum]
        )
    beside = np.abs(query.points[:, :2] - 0.15).max(axis=1) > 0.2
    if shows == "box":
        assert not beside.any()
        np.testing.assert_array_equal(query.points, observation.points_world)
        return
    assert beside.sum() > 1000
    before, after = (
        abs(float(np.median(points[beside, 2])) - observation.table_height)
        for points in (observation.points_world, query.points)
    )
    assert after < 0.0005
    assert before > 4 * after
