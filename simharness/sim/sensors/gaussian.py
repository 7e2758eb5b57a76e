"""Depth errors that do not ask what is seen: independent noise, the two of Dex-Net, and a smooth distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simharness.sim.sensors.images import interpolated_normal
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DepthGaussian:
    """Independent normal noise on the depth of each pixel.

    Args:
        sigma: metres.
    """

    sigma: float

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image with noise."""
        return np.where(depth > 0, depth + rng.normal(0.0, self.sigma, depth.shape), 0.0)


@dataclass(frozen=True, slots=True)
class GammaScale:
    """All depth of an image times one factor: the a of z' = a z + e in Mahler et al., "Dex-Net 2.0" (RSS 2017).

    a ~ Gamma(shape, 1 / shape): mean 1, deviation 1 / sqrt(shape).

    Args:
        shape: of the distribution.
    """

    shape: float = 1000.0

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The scaled image."""
        return np.asarray(depth * rng.gamma(self.shape, 1.0 / self.shape))


@dataclass(frozen=True, slots=True)
class PatchNoise:
    """Noise in patches: the e of z' = a z + e in Mahler et al., "Dex-Net 2.0" (RSS 2017).

    Normal on a grid `step` times coarser than the image and interpolated cubically, which leaves 0.88 of its deviation.
    Here it is always added; some of the published harnesses after GIGA (RSS 2021) add it to every second image only.

    Args:
        sigma: deviation on the coarse grid, metres.
        step: pixels between the nodes of the coarse grid.
    """

    sigma: float = 0.005
    step: int = 4

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The image with noise."""
        nodes = (depth.shape[0] // self.step, depth.shape[1] // self.step)
        return np.where(depth > 0, depth + interpolated_normal(depth.shape, nodes, self.sigma, rng), 0.0)


@dataclass(frozen=True, slots=True)
class SmoothDistortion:
    """Depth times a field that is smooth over the image, drawn for each image.

    Stands for the distortion that Choi et al., "Robust Reconstruction of Indoor Scenes" (CVPR 2015), measured on a real
    camera: about half a percent to one percent.

    Args:
        sigma: deviation of the field from 1 at its nodes.
        nodes: of the field, down and across.
    """

    sigma: float = 0.0075
    nodes: tuple[int, int] = (4, 5)

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:  # noqa: ARG002
        """The distorted image."""
        return np.asarray(depth * (1.0 + interpolated_normal(depth.shape, self.nodes, self.sigma, rng)))
