"""Depth images whose true surface is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="session")
def camera() -> CameraIntrinsics:
    return CameraIntrinsics(width=640, height=480, fx=540.0, fy=540.0, cx=320.0, cy=240.0)


@pytest.fixture(scope="session")
def plane(camera: CameraIntrinsics) -> Callable[..., Array]:
    """Depth (H, W) of a plane whose normal is so many degrees off the optical axis, `z` metres away on that axis."""

    def make(z: float, tilt_deg: float = 0.0) -> Array:
        tilt = np.deg2rad(tilt_deg)
        rows, _ = np.indices((camera.height, camera.width))
        return np.asarray(z * np.cos(tilt) / (np.cos(tilt) + (rows - camera.cy) / camera.fy * np.sin(tilt)))

    return make


@pytest.fixture(scope="session")
def block(camera: CameraIntrinsics) -> Array:
    """Depth (H, W) of a wall at 0.8 m with a square at 0.6 m, rows 180-299, columns 260-379, in front of it."""
    depth = np.full((camera.height, camera.width), 0.8)
    depth[180:300, 260:380] = 0.6
    depth.setflags(write=False)  # all tests share it
    return depth
