"""Rigid transforms. `T_a_b` maps coordinates in frame b to coordinates in frame a, so inner names cancel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_ORTHONORMAL_TOLERANCE = 1e-5

ROUNDED_TOLERANCE = 0.005
"""By how much R R^T of a matrix that `Pose.nearest` takes may differ from the identity."""


def frozen(values: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """A read-only float64 copy of `values`.

    Raises:
        ValueError: the shape differs from `shape` (-1 matches any length) or a value is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a value that is not finite; remove NaN and infinities")
    array.setflags(write=False)
    return array


def unit(vectors: ArrayLike) -> Array:
    """Vectors (..., 3) scaled to length 1.

    Raises:
        ValueError: a vector is shorter than 1e-12.
    """
    array = np.asarray(vectors, dtype=np.float64)
    lengths = np.linalg.norm(array, axis=-1, keepdims=True)
    if (lengths < 1e-12).any():
        raise ValueError("a vector of length 0 has no direction; give a vector of any positive length")
    return np.asarray(array / lengths)


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """Rigid transform from one frame to another, in metres.

    Args:
        rotation: (3, 3) rotation matrix, orthonormal with determinant +1 to 1e-5.
        translation: (3,) metres.

    Raises:
        ValueError: wrong shapes, values that are not finite, or a matrix that is no rotation.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen(self.rotation, (3, 3), "rotation"))
        object.__setattr__(self, "translation", frozen(self.translation, (3,), "translation"))
        deviation = float(np.abs(self.rotation @ self.rotation.T - np.eye(3)).max())
        if deviation > _ORTHONORMAL_TOLERANCE or np.linalg.det(self.rotation) < 0:
            raise ValueError(
                f"rotation is no rotation matrix: R R^T differs from the identity by {deviation:.2e} "
                f"(limit {_ORTHONORMAL_TOLERANCE:g}; {ROUNDED_TOLERANCE:g} for a rounded matrix), determinant "
                f"{np.linalg.det(self.rotation):.3f} (must be +1); give its numbers with more decimals"
            )

    # Factories

    @classmethod
    def identity(cls) -> Pose:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """From a homogeneous (4, 4) matrix."""
        array = _homogeneous(matrix)
        return cls(array[:3, :3], array[:3, 3])

    @classmethod
    def nearest(cls, matrix: ArrayLike) -> Pose:
        """From a homogeneous (4, 4) matrix whose numbers were rounded: the rotation nearest to its upper left part.

        Raises:
            ValueError: also where R R^T differs from the identity by more than 0.005; three decimals leave 0.002.
        """
        array = _homogeneous(matrix)
        deviation = float(np.abs(array[:3, :3] @ array[:3, :3].T - np.eye(3)).max())
        if not _ORTHONORMAL_TOLERANCE < deviation <= ROUNDED_TOLERANCE:
            return cls(array[:3, :3], array[:3, 3])
        left, _, right = np.linalg.svd(array[:3, :3])
        return cls(left @ right, array[:3, 3])

    @classmethod
    def from_quaternion(cls, quaternion_xyzw: ArrayLike, translation: ArrayLike) -> Pose:
        """From a quaternion (x, y, z, w) of any positive length and a translation (3,)."""
        x, y, z, w = unit(frozen(quaternion_xyzw, (4,), "quaternion_xyzw"))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(rotation, np.asarray(translation, dtype=np.float64))

    @classmethod
    def look_at(cls, eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Pose:
        """T_world_camera of a camera at `eye` that sees `target` in its centre (+x right, +y down, +z forward)."""
        forward = unit(np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64))
        right = unit(np.cross(forward, unit(up)))
        return cls(np.stack([right, np.cross(forward, right), forward], axis=1), np.asarray(eye, dtype=np.float64))

    @classmethod
    def random(cls, rng: np.random.Generator, reach: float = 0.0) -> Pose:
        """A rotation drawn uniformly and a translation of up to `reach` metres either way along each axis.

        Four normal variates point in every direction alike, hence so does their unit quaternion (Muller 1959). No
        translation is drawn for a reach of 0.
        """
        quaternion_xyzw = rng.standard_normal(4)
        return cls.from_quaternion(quaternion_xyzw, rng.uniform(-reach, reach, 3) if reach else np.zeros(3))

    # Accessors

    @property
    def matrix(self) -> Array:
        """Homogeneous (4, 4) matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    @property
    def quaternion_xyzw(self) -> Array:
        """(4,) unit quaternion (x, y, z, w) with w >= 0."""
        return np.asarray(quaternions_xyzw(self.rotation[None])[0])

    # Operations

    def inverse(self) -> Pose:
        """T_b_a of a T_a_b."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """T_a_b @ T_b_c = T_a_c."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: ArrayLike) -> Array:
        """Points (..., 3) in b, in metres, as points in a."""
        return np.asarray(np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def rotate(self, directions: ArrayLike) -> Array:
        """Directions (..., 3) in b as directions in a."""
        return np.asarray(np.asarray(directions, dtype=np.float64) @ self.rotation.T)


def _homogeneous(matrix: ArrayLike) -> Array:
    array = frozen(matrix, (4, 4), "matrix")
    if np.abs(array[3] - [0.0, 0.0, 0.0, 1.0]).max() > _ORTHONORMAL_TOLERANCE:
        given = ", ".join(f"{value:g}" for value in array[3])
        raise ValueError(
            f"its last row is [{given}]; it must be [0, 0, 0, 1]: row by row, the translation in the last column"
        )
    return array


def quaternions_xyzw(rotations: ArrayLike) -> Array:
    """Unit quaternions (N, 4), order x, y, z, w with w >= 0, of rotation matrices (N, 3, 3).

    The component of largest magnitude is found first and divides the others, which stays exact near half turns
    (Shepperd 1978).
    """
    r = np.asarray(rotations, dtype=np.float64)
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    trace = diagonal.sum(axis=1)
    # Four times the square of each component, in the order x, y, z, w.
    squares = np.concatenate([1 + 2 * diagonal - trace[:, None], 1 + trace[:, None]], axis=1)
    xy, xz, yz = r[:, 1, 0] + r[:, 0, 1], r[:, 0, 2] + r[:, 2, 0], r[:, 2, 1] + r[:, 1, 2]
    wx, wy, wz = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    # Row i holds four times (component i) times every component.
    products = np.stack(
        [
            np.stack([squares[:, 0], xy, xz, wx], axis=1),
            np.stack([xy, squares[:, 1], yz, wy], axis=1),
            np.stack([xz, yz, squares[:, 2], wz], axis=1),
            np.stack([wx, wy, wz, squares[:, 3]], axis=1),
        ],
        axis=1,
    )
    quaternions = products[np.arange(len(r)), squares.argmax(axis=1)]
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.asarray(np.where(quaternions[:, 3:] < 0, -quaternions, quaternions))
