"""Active stereo cameras such as the D400 family: noise and steps in disparity, and what two views cannot match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simharness.sim.sensors.images import breaks, correlated_normal, ndimage
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_EDGE = 1.0
"""Pixels of disparity between neighbours from which a matching window sees two surfaces."""


@dataclass(frozen=True, slots=True)
class Stereo:
    """Depth from the disparity d = f b / z of two images side by side, the left one being the reference.

    The disparity has normal noise of deviation s, alike over a matching window, and comes in steps of 1 / `steps`, so
    that depth deviates by z^2 sqrt(s^2 + 1 / (12 steps^2)) / (f b): Intel's formula for the RMS error ("Best-Known-
    Methods for Tuning Intel RealSense D400 Depth Cameras", 2018), with the rounding. No pixel has

    - more disparity than the matcher searches, which is the near limit;
    - a background that a nearer surface hides from the right imager: a band on the left of things, as wide as the
      difference of the two disparities. A matcher that keeps the order of points along a row (Ohta and Kanade,
      "Stereo by Intra- and Inter-Scanline Search", PAMI 1985) loses all that lies behind;
    - half of the time, background less than half a window beside a nearer surface. The other half has the disparity of
      that surface, which grows by so much ("foreground fattening": Scharstein and Szeliski, IJCV 2002).

    Args:
        focal_length: of the sensor, its pixels.
        baseline: metres.
        sigma: deviation of disparity, the sensor's pixels.
        window: side of the matching window, the sensor's pixels.
        steps: of disparity in a pixel.
        max_disparity: that the matcher searches, the sensor's pixels.
        occlusion: whether edges and hidden background are lost.
    """

    focal_length: float
    baseline: float
    sigma: float = 0.08
    window: float = 7.0
    steps: int = 32
    max_disparity: float = 126.0
    occlusion: bool = True

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:
        """The image as the sensor measures it."""
        seen = depth > 0
        disparity = np.divide(self._product, depth, out=np.zeros_like(depth), where=seen)
        window = self.window * camera.fx / self.focal_length  # pixels of the image
        matched = seen & (disparity <= self.max_disparity)
        if self.occlusion:
            matched &= ~_hidden(disparity * camera.fx / self.focal_length, seen)
            disparity, lost = _fattened(disparity, seen, window, rng)
            matched &= ~lost
        noisy = disparity + self.sigma * correlated_normal(depth.shape, window, rng)
        stepped = np.round(noisy * self.steps) / self.steps
        matched &= stepped > 0
        return np.divide(self._product, stepped, out=np.zeros_like(depth), where=matched)

    @property
    def _product(self) -> float:
        return self.focal_length * self.baseline


def _hidden(shift: Array, seen: Mask) -> Mask:
    """Pixels (H, W) that something to their right hides from the right imager.

    Args:
        shift: (H, W) disparity in pixels of this image.
        seen: (H, W) pixels that have one.
    """
    columns = np.where(seen, np.arange(shift.shape[1]) - shift, np.inf)  # in the right image
    leftmost = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    from_right = np.full_like(leftmost, np.inf)
    from_right[:, :-1] = leftmost[:, 1:]
    return np.asarray(seen & (from_right <= columns))


def _fattened(disparity: Array, seen: Mask, window: float, rng: np.random.Generator) -> tuple[Array, Mask]:
    """Disparity (H, W) with nearer surfaces grown by half a window where chance has it, and what is lost instead."""
    reach = 2 * round(window / 2) + 1
    nearest = ndimage().maximum_filter(disparity, reach, mode="nearest")
    near_edge = ndimage().maximum_filter(breaks(disparity, seen, _EDGE), reach, mode="nearest")
    behind = seen & near_edge & (nearest - disparity > _EDGE)
    grows = correlated_normal(disparity.shape, window, rng) > 0
    return np.where(behind & grows, nearest, disparity), behind & ~grows
