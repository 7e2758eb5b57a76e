"""The first Kinect as two papers simulate it: `simkinect` and `redwood`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simharness.sim.sensors.images import ndimage
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_KINECT_DISPARITY_CM = 35130.0
"""Centimetres times steps of disparity: the Kinect's depth of z cm has the raw disparity 35130 / z (Barron 2013)."""

_REDWOOD_DISPARITY_M = 35.130
_REDWOOD_DECIMATION = 2


@dataclass(frozen=True, slots=True)
class SimKinect:
    """Depth of a Kinect after Handa et al. (ICRA 2014), Barron and Malik (CVPR 2013) and Bohg et al. (ICRA 2014).

    z is read bilinearly at (u + N(0, 1/2), v + N(0, 1/2)) and gives d = f b / z, in steps of 1/8. A pixel survives
    where more than 5/6 of its 9 x 9 window agree with the window's mean within 0.1, a tolerance that grows with 1.44
    times the squared distance in pixels; the others become holes along edges. Then z' = 35130 / floor(35130 / z +
    N(0, 1/6) + 1/2) with z in centimetres, not rounded before. The pattern of dots is left out.

    Args:
        focal_length: pixels.
        baseline: metres.
    """

    focal_length: float = 480.0
    baseline: float = 0.075

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image as the sensor measures it."""
        rows, columns = np.indices(depth.shape, dtype=np.float64)
        where = (rows + rng.normal(0.0, 0.5, depth.shape), columns + rng.normal(0.0, 0.5, depth.shape))
        read = ndimage().map_coordinates(depth, where, order=1, mode="nearest")
        whole = ndimage().map_coordinates((depth > 0).astype(np.float64), where, order=1, mode="nearest") > 1.0 - 1e-9
        product = self.focal_length * self.baseline
        disparity = np.divide(product, read, out=np.zeros_like(depth), where=whole)
        stepped = np.round(8.0 * disparity) / 8.0
        kept = whole & _agrees(disparity, whole) & (stepped > 0)
        centimetres = 100.0 * np.divide(product, stepped, out=np.ones_like(depth), where=kept)
        raw = np.floor(_KINECT_DISPARITY_CM / centimetres + rng.normal(0.0, 1.0 / 6.0, depth.shape) + 0.5)
        return np.where(kept, _KINECT_DISPARITY_CM / raw / 100.0, 0.0)


def _agrees(disparity: Array, seen: Mask) -> Mask:
    """Pixels (H, W) whose window holds one surface."""
    reach, tolerance, growth, share = 4, 0.1, 1.44, 5.0 / 6.0
    side = 2 * reach + 1
    valid = ndimage().uniform_filter(seen.astype(np.float64), side, mode="constant")
    mean = np.divide(
        ndimage().uniform_filter(disparity, side, mode="constant"), valid, where=seen, out=disparity.copy()
    )
    padded = np.pad(np.where(seen, disparity, np.inf), reach, constant_values=np.inf)
    height, width = disparity.shape
    agreeing = np.zeros(disparity.shape, dtype=np.int64)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            other = padded[reach + down : reach + down + height, reach + across : reach + across + width]
            agreeing += np.abs(other - mean) < tolerance * max(1.0, growth * (down**2 + across**2))
    return np.asarray(agreeing > share * side**2)


@dataclass(frozen=True, slots=True)
class Redwood:
    """Depth of a Kinect after Choi et al., "Robust Reconstruction of Indoor Scenes" (CVPR 2015), without distortion.

    A pixel reads the first of 2 x 2 pixels where N(0, 1/4) pixels of jitter take it; d = round(8 (35.130 / z + N(0,
    1/36))) / 8, z' = 35.130 / d, z in metres. `SmoothDistortion` adds what the paper multiplies it with.
    """

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image as the sensor measures it."""
        places = []
        for pixels, size in zip(np.indices(depth.shape), depth.shape, strict=True):
            jittered = np.rint(pixels + rng.normal(0.0, 0.25, depth.shape)).astype(np.int64)
            jittered = np.clip(jittered, 0, size - 1)
            places.append(jittered - jittered % _REDWOOD_DECIMATION)
        read = depth[places[0], places[1]]
        seen = read > 0
        true = np.divide(_REDWOOD_DISPARITY_M, read, out=np.zeros_like(depth), where=seen)
        stepped = np.round(8.0 * (true + rng.normal(0.0, 1.0 / 36.0, depth.shape))) / 8.0
        measured: Array = np.divide(_REDWOOD_DISPARITY_M, stepped, out=np.zeros_like(depth), where=seen & (stepped > 0))
        return measured
