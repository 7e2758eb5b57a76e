"""Errors that grow with distance and slant, as measured on time-of-flight and structured-light cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]

_STEEP = np.deg2rad(60.0)
_STEEPEST = np.deg2rad(85.0)
"""Angle of incidence beyond which the formulae, which grow without bound, were never measured."""


@dataclass(frozen=True, slots=True)
class TimeOfFlight:
    """Noise by distance z and angle of incidence t after Nguyen, Izadi and Lovell (3DIMPVT 2012).

    Across the image 0.8 + 0.035 t / (pi/2 - t) pixels, along the axis 1.2 mm + 1.9 mm (z - 0.4)^2, and beyond 60
    degrees 0.1 mm t^2 / (sqrt(z) (pi/2 - t)^2) more, z in metres. A pixel is lost with the probability 1 - cos t.
    Angles beyond 85 degrees count as 85.

    Args:
        focal_length: of the sensor, its pixels.
    """

    focal_length: float = 585.0

    def __call__(self, depth: Array, camera: CameraIntrinsics, rng: np.random.Generator) -> Array:
        """The image as the sensor measures it."""
        slant = incidence(depth, camera)
        across = lateral_sigma(slant) * camera.fx / self.focal_length
        places = []
        for pixels, size in zip(np.indices(depth.shape), depth.shape, strict=True):
            moved = np.rint(pixels + across * rng.standard_normal(depth.shape)).astype(np.int64)
            places.append(np.clip(moved, 0, size - 1))
        read = depth[places[0], places[1]]
        kept = (read > 0) & (depth > 0) & (rng.uniform(size=depth.shape) < np.cos(slant))
        along = axial_sigma(np.where(kept, read, 1.0), slant) * rng.standard_normal(depth.shape)
        return np.where(kept, read + along, 0.0)


def incidence(depth: Array, camera: CameraIntrinsics) -> Array:
    """Angle (H, W) in radians between a pixel's ray and its surface's normal, 0 to 85 degrees.

    The surface is taken from the neighbouring pixels, so that it is steep where they belong to two.
    """
    rows, columns = np.indices(depth.shape, dtype=np.float64)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)], axis=2)
    points = rays * np.where(depth > 0, depth, np.nan)[:, :, None]
    down, across = np.gradient(points, axis=(0, 1))
    normals = np.cross(across, down)
    lengths = np.linalg.norm(normals, axis=2) * np.linalg.norm(rays, axis=2)
    cosine = np.abs(np.einsum("hwi,hwi->hw", normals, rays)) / np.where(lengths > 0, lengths, np.nan)
    angle = np.arccos(np.clip(np.nan_to_num(cosine, nan=0.0), 0.0, 1.0))
    return np.asarray(np.minimum(angle, _STEEPEST))


def lateral_sigma(slant: Array) -> Array:
    """Deviation across the image, the sensor's pixels, at angles of incidence in radians."""
    return np.asarray(0.8 + 0.035 * slant / (np.pi / 2 - slant))


def axial_sigma(depth: Array, slant: Array) -> Array:
    """Deviation along the optical axis, metres, at depths in metres and angles of incidence in radians."""
    frontal = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    steep = 0.0001 / np.sqrt(depth) * slant**2 / (np.pi / 2 - slant) ** 2
    return np.asarray(frontal + np.where(slant > _STEEP, steep, 0.0))
