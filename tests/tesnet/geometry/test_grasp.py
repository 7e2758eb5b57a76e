from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet.geometry import FRAME_CONVENTIONS, GraspSet, Pose


def grasp_set(count: int, seed: int = 0) -> GraspSet:
    rng = np.random.default_rng(seed)
    Ts = np.array([Pose.random(rng, reach=0.5).matrix for _ in range(count)]).reshape(count, 4, 4)
    return GraspSet(
        rng.random(count), Ts, np.full(count, 0.08), rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    )


@given(count=st.integers(0, 6), seed=st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_every_convention_names_the_same_hand(count: int, seed: int) -> None:
    grasps = grasp_set(count, seed)
    panda, graspnet, contact = (grasps.in_convention(name) for name in ("panda", "graspnet", "contact_graspnet"))
    for T, T_graspnet, T_contact in zip(panda, graspnet, contact, strict=True):
        x, y, z = T[:3, :3].T
        np.testing.assert_array_equal(T_graspnet[:3, :3], np.column_stack([z, y, -x]))
        np.testing.assert_array_equal(T_graspnet[:3, 3], T[:3, 3])
        np.testing.assert_array_equal(T_contact[:3, :3], np.column_stack([y, -x, z]))
        np.testing.assert_allclose(T_contact[:3, 3], T[:3, 3] - 0.1034 * z, atol=1e-12)
    for poses in (panda, graspnet, contact):
        assert poses.shape == (count, 4, 4)
        for T in poses:
            Pose.from_matrix(T)  # proper rotations, all of them


def test_the_conventions_are_listed_where_an_unknown_one_is_refused() -> None:
    assert FRAME_CONVENTIONS == ("panda", "graspnet", "contact_graspnet")
    unknown: Any = "gpd"
    with pytest.raises(ValueError, match="'gpd'; valid: panda, graspnet, contact_graspnet"):
        grasp_set(1).in_convention(unknown)


def test_hand_and_pregrasp_lie_behind_the_tcp_along_z() -> None:
    grasps = grasp_set(5)
    z = grasps.Ts_cloud_grasp[:, :3, 2]
    tcp = grasps.Ts_cloud_grasp[:, :3, 3]
    np.testing.assert_allclose(grasps.hand_poses[:, :3, 3], tcp - 0.1034 * z, atol=1e-15)
    np.testing.assert_allclose(grasps.pregrasps(0.05)[:, :3, 3], tcp - 0.05 * z, atol=1e-15)
    np.testing.assert_array_equal(grasps.pregrasps(0.05)[:, :3, :3], grasps.Ts_cloud_grasp[:, :3, :3])
    np.testing.assert_array_equal(grasps.pregrasps(0.0), grasps.Ts_cloud_grasp)


def test_derived_poses_leave_the_grasps_alone() -> None:
    grasps = grasp_set(3)
    before = grasps.Ts_cloud_grasp.copy()
    for poses in (grasps.hand_poses, grasps.pregrasps(1), *map(grasps.in_convention, FRAME_CONVENTIONS)):
        poses[:] = 0
    np.testing.assert_array_equal(grasps.Ts_cloud_grasp, before)
    with pytest.raises(ValueError, match="read-only"):
        grasps.scores[0] = 1


def test_no_grasps_are_a_grasp_set_too() -> None:
    empty = GraspSet.empty()
    assert len(empty) == 0
    assert empty.hand_poses.shape == empty.in_convention("graspnet").shape == (0, 4, 4)


@pytest.mark.parametrize("name", ["Ts_cloud_grasp", "widths", "approach_points", "contact_points"])
def test_arrays_that_do_not_agree_are_refused(name: str) -> None:
    good = grasp_set(3)
    values: dict[str, Any] = {field: getattr(good, field) for field in GraspSet.__slots__}
    with pytest.raises(ValueError, match=f"{name} has shape"):
        GraspSet(**{**values, name: values[name][:2]})
    with pytest.raises(ValueError, match=f"{name} holds a value that is not finite"):
        GraspSet(**{**values, name: values[name] * np.nan})
