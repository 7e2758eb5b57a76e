"""Pixels that are lost or wrong whatever the camera: dropout, and points that fly between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simharness.sim.sensors.images import breaks, ndimage
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Dropout:
    """Ellipses without depth, for what is dark, shiny or of glass.

    Xie et al., "Unseen Object Instance Segmentation for Robotic Environments" (T-RO 2021): their number is Poisson
    distributed, centres are any pixels that see something, both radii come from a gamma distribution, angles are any.

    Args:
        mean_number: of ellipses in an image.
        radius_shape, radius_scale: of the radii's distribution; the scale in pixels of the image.
    """

    mean_number: float = 10.0
    radius_shape: float = 5.0
    radius_scale: float = 1.0

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image with holes."""
        rows, columns = np.nonzero(depth > 0)
        measured = depth.copy()
        if not len(rows):
            return measured
        for _ in range(rng.poisson(self.mean_number)):
            chosen = rng.integers(len(rows))
            radii = np.maximum(rng.gamma(self.radius_shape, self.radius_scale, 2), 1e-3)
            cut_ellipse(measured, int(rows[chosen]), int(columns[chosen]), radii, float(rng.uniform(0.0, np.pi)))
        return measured


def cut_ellipse(image: Array, row: int, column: int, radii: Array, angle: float) -> None:
    """Set the pixels of an ellipse to 0.

    Args:
        image: changed in place.
        row: of its centre.
        column: of its centre.
        radii: (2,) pixels.
        angle: between the first radius and the direction of rows, radians.
    """
    reach = int(np.ceil(radii.max()))
    top, left = max(0, row - reach), max(0, column - reach)
    part = image[top : row + reach + 1, left : column + reach + 1]
    down, across = np.indices(part.shape, dtype=np.float64)
    down, across = down + top - row, across + left - column
    along = (across * np.cos(angle) + down * np.sin(angle)) / radii[0]
    beside = (down * np.cos(angle) - across * np.sin(angle)) / radii[1]
    part[along**2 + beside**2 <= 1.0] = 0.0


@dataclass(frozen=True, slots=True)
class FlyingPixels:
    """Points in the air between foreground and background, along the edges.

    A pixel whose field of view holds two surfaces measures a mixture of both (Sabov and Krueger, "Identification and
    Correction of Flying Pixels in Range Camera Data", SCCG 2008). A share of the pixels on both sides of a break gets a
    depth that is uniform between the nearest and the farthest of its 3 x 3 pixels.

    Args:
        share: of the pixels at breaks.
        least_step: depth between neighbours from which there is a break, metres.
    """

    share: float = 0.5
    least_step: float = 0.015

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image with flying pixels."""
        seen = depth > 0
        nearest = ndimage().minimum_filter(np.where(seen, depth, np.inf), 3, mode="nearest")
        farthest = ndimage().maximum_filter(depth, 3, mode="nearest")
        flies = breaks(depth, seen, self.least_step) & (rng.uniform(size=depth.shape) < self.share)
        between = rng.uniform(size=depth.shape)
        mixed = np.where(seen, nearest, 0.0) + between * (farthest - np.where(seen, nearest, 0.0))
        return np.where(flies, mixed, depth)
