"""A depth camera as a value: what it does to depth images, to points, and how wrong its calibration is.

Knows neither where cameras stand nor what they look at.

A depth image is metres along the optical axis, 0 where nothing is seen, rows from the top. The camera that renders it
keeps its intrinsics; a sensor's own focal length and baseline say how large its errors are.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from jaxtyping import Float32

from simharness.sim.sensors.calibration import Calibration
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]

_LEAST_DEPTH = 1e-3


class DepthPart(Protocol):
    """One step of what happens to a depth image between the scene and the reader."""

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:
        """The image (H, W) after this step, metres, 0 where nothing is seen.

        Args:
            depth: (H, W) metres, 0 where nothing is seen; not changed.
            camera: of the image.
            rng: source of the errors.
        """
        ...


@dataclass(frozen=True, slots=True)
class Sensor:
    """A depth camera; without arguments an ideal one.

    Args:
        depth: what happens to each image, in this order.
        point_sigma: standard deviation of noise on each coordinate of each point, metres.
        calibration: how wrong pose, depth scale and table height are believed to be.
    """

    depth: tuple[DepthPart, ...] = ()
    point_sigma: float = 0.0
    calibration: Calibration = field(default_factory=Calibration)

    def measure(
        self, depth: Float32[np.ndarray, "height width"], camera: CameraIntrinsics, rng: np.random.Generator
    ) -> Float32[np.ndarray, "height width"]:
        """A depth image as this sensor gives it, metres; what is not seen stays 0."""
        if not self.depth:
            return depth
        measured = depth.astype(np.float64)
        for part in self.depth:
            measured = part(measured, camera, rng)
        return np.where(measured != 0, np.maximum(measured, _LEAST_DEPTH), 0.0).astype(np.float32)

    def with_part(self, part: DepthPart) -> Sensor:
        """This sensor with a last step more."""
        return replace(self, depth=(*self.depth, part))

    def without(self, kind: type) -> Sensor:
        """This sensor without the steps of a kind."""
        return replace(self, depth=tuple(part for part in self.depth if not isinstance(part, kind)))
