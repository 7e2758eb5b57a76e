"""`support_height="auto"`: the height of tables that are there, and none where there is no table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tesnet import support
from tesnet.geometry import Box, Pose
from tesnet.query import GraspQuery
from tests.tesnet.scenes import CAMERA, CPU, UP, ask, fresh_predictor, tabletop

Array = NDArray[np.float64]


def table(size: float = 0.3, height: float = 0.0, count: int = 30_000) -> Array:
    across = np.random.default_rng(3).uniform(-size, size, (count, 2))
    return np.column_stack([across, np.full(count, height)])


def auto(points: Array, **options: Any) -> GraspQuery:
    return ask(points, **{"viewpoints": CAMERA, "up": UP, "support_height": "auto", "max_candidates": 300, **options})


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.003])
def test_the_table_under_objects_is_found_to_a_millimetre_wherever_the_frame_lies(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate([tabletop(seed), table()])
    points += rng.normal(0, noise, points.shape)
    motion = Pose.random(rng, reach=0.5) if seed else Pose.identity()
    found = support.dominant_plane(auto(motion.apply(points), up=motion.rotate(UP)), CPU)
    assert found is not None
    expected = float(motion.translation @ motion.rotate(UP))
    assert abs(found.height - expected) < 0.001
    assert found.share > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_tops_and_walls_of_objects_are_no_support(seed: int) -> None:
    assert support.dominant_plane(auto(tabletop(seed)), CPU) is None
    above = Box(np.array([-1.0, -1.0, 0.03]), np.array([1.0, 1.0, 1.0]))
    assert support.dominant_plane(auto(np.concatenate([tabletop(seed), table()]), workspace=above), CPU) is None


def test_a_plane_that_is_not_across_up_is_no_support() -> None:
    tilted = np.array([np.sin(np.radians(4)), 0, np.cos(np.radians(4))])
    assert support.dominant_plane(auto(np.concatenate([tabletop(0), table()]), up=tilted), CPU) is None


def test_the_workspace_chooses_between_table_and_floor() -> None:
    floor = table(1.2, height=-0.7, count=60_000)
    floor = floor[(np.abs(floor[:, :2]) > 0.5).any(axis=1)]
    points = np.concatenate([tabletop(0), table(), floor])
    everywhere = support.dominant_plane(auto(points), CPU)
    near = Box(np.array([-0.4, -0.4, -0.2]), np.array([0.4, 0.4, 0.5]))
    above = support.dominant_plane(auto(points, workspace=near), CPU)
    assert everywhere is not None
    assert above is not None
    assert (round(everywhere.height, 3), round(above.height, 3)) == (-0.7, 0.0)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_hardly_any_points_have_no_support_and_are_no_error(count: int) -> None:
    assert support.dominant_plane(auto(np.zeros((count, 3))), CPU) is None


def test_grasps_with_auto_are_those_with_the_height_that_the_warning_names() -> None:
    points = np.concatenate([tabletop(0), table(0.2)])
    predictor = fresh_predictor()
    found = predictor.predict(auto(points))
    (note,) = [note for note in found.warnings if "support_height auto" in note]
    height = float(note.split(" m along up")[0].rpartition(" ")[2])
    given = predictor.predict(auto(points, support_height=height))
    np.testing.assert_allclose(found.grasps.Ts_cloud_grasp, given.grasps.Ts_cloud_grasp, atol=1e-5)
    assert len(found.grasps) == 10
    assert not [note for note in given.warnings if "support" in note]


def test_without_a_table_grasps_are_those_without_a_support_and_a_warning_says_so() -> None:
    predictor = fresh_predictor()
    found, none = predictor.predict(auto(tabletop(0))), predictor.predict(auto(tabletop(0), support_height=None))
    np.testing.assert_array_equal(found.grasps.Ts_cloud_grasp, none.grasps.Ts_cloud_grasp)
    assert any("no plane across up was found" in note for note in found.warnings)
