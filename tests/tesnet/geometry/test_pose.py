from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tesnet.geometry import Pose, quaternions_xyzw, unit
from tests.tesnet.scenes import Array

FEW = settings(max_examples=30, deadline=None)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    """Any rotation, half turns and no turn among them, and a translation of up to 10 m."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    special: list[list[float]] = [
        [0, 0, 0, 1],
        [1, 0, 0, 0],
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [1, 1, 0, 1e-9],
        [0, 1, -1, 0],
    ]
    quaternion = draw(st.sampled_from([*special, None]))
    if quaternion is None:
        return Pose.random(rng, reach=10.0)
    return Pose.from_quaternion(quaternion, rng.uniform(-10, 10, 3))


def assert_same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.matrix, b.matrix, atol=1e-12)


@given(a=poses(), b=poses(), c=poses())
@FEW
def test_composition_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(a=poses())
@FEW
def test_the_identity_changes_nothing_and_the_inverse_undoes(a: Pose) -> None:
    assert_same(a @ Pose.identity(), a)
    assert_same(Pose.identity() @ a, a)
    assert_same(a @ a.inverse(), Pose.identity())
    assert_same(a.inverse() @ a, Pose.identity())
    assert_same(a.inverse().inverse(), a)


@given(a=poses(), b=poses(), seed=st.integers(0, 99))
@FEW
def test_applying_a_composition_is_applying_one_after_the_other(a: Pose, b: Pose, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-5, 5, (2, 7, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    np.testing.assert_allclose((a @ b).rotate(points), a.rotate(b.rotate(points)), atol=1e-12)
    np.testing.assert_allclose(a.apply(points[0]) - a.apply(points[1]), a.rotate(points[0] - points[1]), atol=1e-12)


@given(a=poses(), seed=st.integers(0, 99))
@FEW
def test_apply_is_the_homogeneous_product(a: Pose, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-5, 5, (6, 3))
    homogeneous = np.column_stack([points, np.ones(6)]) @ a.matrix.T
    np.testing.assert_allclose(a.apply(points), homogeneous[:, :3], atol=1e-12)
    np.testing.assert_allclose(homogeneous[:, 3], 1)


@given(a=poses())
@FEW
def test_matrices_and_quaternions_round_trip(a: Pose) -> None:
    assert_same(Pose.from_matrix(a.matrix), a)
    assert_same(Pose.from_quaternion(a.quaternion_xyzw, a.translation), a)
    assert_same(Pose.from_quaternion(-3 * a.quaternion_xyzw, a.translation), a)


@given(stack=st.lists(poses(), min_size=1, max_size=8))
@FEW
def test_quaternions_are_scipys(stack: list[Pose]) -> None:
    rotations = np.stack([pose.rotation for pose in stack])
    found = quaternions_xyzw(rotations)
    expected = Rotation.from_matrix(rotations).as_quat()
    assert (found[:, 3] >= 0).all()
    np.testing.assert_allclose(np.abs((found * expected).sum(axis=1)), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)


def test_quaternions_of_no_rotations_are_an_empty_stack() -> None:
    assert quaternions_xyzw(np.empty((0, 3, 3))).shape == (0, 4)


@given(seed=st.integers(0, 2**31))
@FEW
def test_look_at_puts_the_target_in_the_centre_with_up_upwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    eye, target = rng.uniform(-1, 1, (2, 3))
    T_world_camera = Pose.look_at(eye, target, [0, 0, 1])
    np.testing.assert_allclose(T_world_camera.translation, eye)
    seen = T_world_camera.inverse().apply(target)
    np.testing.assert_allclose(seen, np.array([0, 0, np.linalg.norm(target - eye)]), atol=1e-9)
    higher = T_world_camera.inverse().apply(target + np.array([0, 0, 0.1]))
    assert abs(higher[0]) < 1e-9  # +x right
    assert higher[1] < 0  # +y down


def test_a_camera_cannot_look_along_up() -> None:
    with pytest.raises(ValueError, match="length 0"):
        Pose.look_at([0, 0, 1], [0, 0, 0], [0, 0, 1])


def test_a_pose_neither_shares_nor_yields_its_arrays() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    pose = Pose(rotation, translation)
    rotation[0, 0], translation[0] = 5, 5
    assert_same(pose, Pose.identity())
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 2
    with pytest.raises(AttributeError):
        pose.rotation = np.eye(3)  # type: ignore[misc]  # the claim is that this fails


@pytest.mark.parametrize(
    ("rotation", "translation", "says"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), r"determinant -1\.000"),
        (2 * np.eye(3), np.zeros(3), "no rotation"),
        (np.eye(4), np.zeros(3), r"rotation has shape \(4, 4\)"),
        (np.eye(3), np.zeros(4), r"translation has shape \(4,\)"),
        (np.eye(3), np.array([0, np.nan, 0]), "not finite"),
    ],
)
def test_a_pose_refuses_what_is_no_rigid_transform(rotation: Array, translation: Array, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Pose(rotation, translation)


def test_a_quaternion_or_a_vector_of_length_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="length 0"):
        Pose.from_quaternion([0, 0, 0, 0], np.zeros(3))
    with pytest.raises(ValueError, match="length 0"):
        unit([[1, 0, 0], [0, 0, 0]])


def test_unit_keeps_directions() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose(np.linalg.norm(unit(vectors), axis=-1), 1)
    np.testing.assert_allclose(np.cross(unit(vectors), vectors), 0, atol=1e-12)


def test_random_rotations_are_uniform() -> None:
    """The mean of uniform rotations is zero, and every axis lands in every octant."""
    rng = np.random.default_rng(0)
    rotations = np.array([Pose.random(rng).rotation for _ in range(4000)])
    np.testing.assert_allclose(rotations.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=0.02)


def test_random_translations_fill_their_reach() -> None:
    rng = np.random.default_rng(0)
    translations = np.array([Pose.random(rng, reach=0.3).translation for _ in range(2000)])
    np.testing.assert_allclose(translations.min(axis=0), -0.3, atol=0.01)
    np.testing.assert_allclose(translations.max(axis=0), 0.3, atol=0.01)


def test_a_random_pose_that_stays_draws_four_numbers() -> None:
    """Scenes and labels rest on it: a seed must go on giving what it gave."""
    rng, twin = np.random.default_rng(7), np.random.default_rng(7)
    assert_same(Pose.random(rng), Pose.from_quaternion(twin.standard_normal(4), np.zeros(3)))
    assert rng.random() == twin.random()


@given(st.integers(0, 2**31), st.integers(3, 9))
def test_a_rounded_matrix_gives_the_rotation_that_it_was(seed: int, decimals: int) -> None:
    rng = np.random.default_rng(seed)
    pose = Pose.look_at(rng.normal(size=3), rng.normal(size=3), rng.normal(size=3))
    found = Pose.nearest(pose.matrix.round(decimals))
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=2 * 10.0**-decimals)


def test_what_is_no_rotation_stays_refused() -> None:
    for scale in (0.99, 1.003, -1.0):
        matrix = np.diag([scale, scale, scale, 1.0])
        with pytest.raises(ValueError, match="no rotation matrix"):
            Pose.nearest(matrix)


@pytest.mark.parametrize("make", [Pose.from_matrix, Pose.nearest])
def test_a_transposed_matrix_is_told_apart(make: Callable[[Any], Pose]) -> None:
    """Its rotation is one, too, and its translation would be lost."""
    matrix = Pose.look_at([0.1, 0.2, 0.6], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]).matrix
    assert_same(make(matrix), Pose.from_matrix(matrix))
    for wrong in (matrix.T, np.diag([1.0, 1.0, 1.0, 2.0])):
        with pytest.raises(ValueError, match=r"last row is \[.*\]; it must be \[0, 0, 0, 1\]"):
            make(wrong)
