"""Pinhole cameras: a depth image becomes points in the camera frame (+x right, +y down, +z forward)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """A pinhole camera without distortion; every length in pixels.

    Raises:
        ValueError: a size or focal length that is not positive.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive, in pixels")

    def back_project(self, depth: ArrayLike) -> NDArray[np.float64]:
        """Points (M, 3) in the camera frame of a depth image (height, width), both in metres, row by row.

        Pixels without a depth (zero, negative, infinite or NaN) give no point.

        Raises:
            ValueError: the image's size is not the camera's.
        """
        image = np.asarray(depth, dtype=np.float64)
        if image.shape != (self.height, self.width):
            raise ValueError(f"depth image has shape {image.shape}; the camera's is {(self.height, self.width)}")
        rows, columns = np.nonzero(np.isfinite(image) & (image > 0))
        z = image[rows, columns]
        return np.stack([(columns - self.cx) / self.fx * z, (rows - self.cy) / self.fy * z, z], axis=1)
