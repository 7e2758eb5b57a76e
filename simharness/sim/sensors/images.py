"""What several sensor models ask of a depth image: where it breaks off, and smooth random fields over it."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import numpy.typing as npt

from simharness.errors import from_extra

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def ndimage() -> Any:
    """SciPy's filters of images, which runs with an ideal or a Gaussian sensor do without.

    Raises:
        MissingExtra: SciPy is not installed.
    """
    with from_extra("sensors", "this sensor (--sensor, --dex-noise, camera giga) needs"):
        return importlib.import_module("scipy.ndimage")


def breaks(image: Array, seen: Mask, least: float) -> Mask:
    """Pixels (H, W) on either side of a step between neighbours of one row or column.

    A step is a second difference of at least `least`: planes, however tilted, have none. Pixels beside one that sees
    nothing are no breaks, nor are those of the image's border along it.
    """
    found = np.zeros(image.shape, dtype=np.bool_)
    for axis in (0, 1):
        second = ndimage().convolve1d(image, [1.0, -2.0, 1.0], axis=axis, mode="nearest")
        whole = ndimage().minimum_filter1d(seen, 3, axis=axis, mode="constant")
        found |= (np.abs(second) > least) & whole
    return found


def correlated_normal(shape: tuple[int, ...], window: float, rng: np.random.Generator) -> Array:
    """A normal field (H, W) of mean 0 and standard deviation 1, alike over about `window` pixels.

    White noise under a Gaussian kernel whose second moment is that of a box of this width.
    """
    sigma = window / np.sqrt(12.0)
    white = rng.standard_normal(shape)
    impulse = np.zeros(2 * int(np.ceil(4 * sigma)) + 1)
    impulse[len(impulse) // 2] = 1.0
    kernel = ndimage().gaussian_filter1d(impulse, sigma, mode="constant")
    # A weighted sum of independent numbers has the root of the summed squares as its deviation, once for each axis.
    return np.asarray(ndimage().gaussian_filter(white, sigma, mode="wrap") / (kernel**2).sum())


def interpolated_normal(
    shape: tuple[int, ...], nodes: tuple[int, int], sigma: float, rng: np.random.Generator
) -> Array:
    """Normal noise on a grid of `nodes`, cubically interpolated to an image (H, W) whose sides are their multiples."""
    coarse = rng.normal(0.0, sigma, nodes)
    zoom = (shape[0] / nodes[0], shape[1] / nodes[1])
    return np.asarray(ndimage().zoom(coarse, zoom, order=3, mode="nearest", grid_mode=True))
