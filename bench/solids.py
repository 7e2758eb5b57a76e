"""Solids that rays are cast at: made-up scenes that need no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry import Pose

Array = NDArray[np.float64]


class Solid(Protocol):
    """What a ray can hit, in a frame of its own."""

    @property
    def radius_about_origin(self) -> float:
        """Of a sphere about the origin that holds it."""

    def distances(self, origins: Array, directions: Array) -> Array:
        """(R,) how many directions (R, 3) it is from the origins (R, 3) to the first hit; inf for a miss."""


Placed = tuple[Solid, Pose]
"""A solid and T_world_solid."""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """A box about the origin."""

    half_extents: Array

    @property
    def radius_about_origin(self) -> float:
        """As `Solid.radius_about_origin`."""
        return float(np.linalg.norm(self.half_extents))

    def distances(self, origins: Array, directions: Array) -> Array:
        """As `Solid.distances`."""
        inverse = 1.0 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        crossings = np.stack([-self.half_extents - origins, self.half_extents - origins]) * inverse
        entry, leave = crossings.min(axis=0).max(axis=1), crossings.max(axis=0).min(axis=1)
        return np.where((entry <= leave) & (entry > 0), entry, np.inf)


@dataclass(frozen=True, eq=False, slots=True)
class Cylinder:
    """A closed cylinder about z."""

    radius: float
    half_height: float

    @property
    def radius_about_origin(self) -> float:
        """As `Solid.radius_about_origin`."""
        return float(np.hypot(self.radius, self.half_height))

    def distances(self, origins: Array, directions: Array) -> Array:
        """As `Solid.distances`."""
        a = np.maximum((directions[:, :2] ** 2).sum(axis=1), 1e-12)
        b = (origins[:, :2] * directions[:, :2]).sum(axis=1)
        c = (origins[:, :2] ** 2).sum(axis=1) - self.radius**2
        discriminant = b**2 - a * c
        side = (-b - np.sqrt(np.maximum(discriminant, 0.0))) / a
        hits_side = (discriminant >= 0) & (np.abs(origins[:, 2] + side * directions[:, 2]) <= self.half_height)
        slope = np.where(np.abs(directions[:, 2]) < 1e-12, 1e-12, directions[:, 2])
        cap = (self.half_height - origins[:, 2]) / slope
        radii = np.linalg.norm(origins[:, :2] + cap[:, None] * directions[:, :2], axis=1)
        hits_cap = (radii <= self.radius) & (cap > 0)
        return np.minimum(np.where(hits_side & (side > 0), side, np.inf), np.where(hits_cap, cap, np.inf))


@dataclass(frozen=True, eq=False, slots=True)
class Trough:
    """The inside of a pipe about y, cut at `half_width` to both sides of its lowest line, which lies at z = 0."""

    radius: float
    half_width: float
    half_length: float

    @property
    def radius_about_origin(self) -> float:
        """As `Solid.radius_about_origin`."""
        return float(np.hypot(2 * self.radius, self.half_length))

    def distances(self, origins: Array, directions: Array) -> Array:
        """As `Solid.distances`, from above."""
        across, along = origins - [0, 0, self.radius], directions
        a = np.maximum(along[:, 0] ** 2 + along[:, 2] ** 2, 1e-12)
        b = across[:, 0] * along[:, 0] + across[:, 2] * along[:, 2]
        c = across[:, 0] ** 2 + across[:, 2] ** 2 - self.radius**2
        discriminant = b**2 - a * c
        far = (-b + np.sqrt(np.maximum(discriminant, 0.0))) / a
        places = across + far[:, None] * along
        hit = (np.abs(places[:, 0]) <= self.half_width) & (np.abs(places[:, 1]) <= self.half_length)
        return np.where((discriminant >= 0) & (far > 0) & hit & (places[:, 2] < 0), far, np.inf)


def standing(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """A pose at a place, turned about z."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return Pose(np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, z]))


def cast(solids: tuple[Placed, ...], eye: Array, rays_world: Array) -> Array:
    """(R,) how many rays (R, 3) it is from the eye (3,) to the first solid; inf where there is none."""
    nearest = np.full(len(rays_world), np.inf)
    squares = (rays_world**2).sum(axis=1)
    for solid, T_world_solid in solids:
        T_solid_world = T_world_solid.inverse()
        offset = T_world_solid.translation - eye
        missed_by = offset @ offset - (rays_world @ offset) ** 2 / squares
        rows = np.flatnonzero(missed_by <= 1.001 * solid.radius_about_origin**2)
        origins = np.broadcast_to(T_solid_world.apply(eye), (len(rows), 3))
        nearest[rows] = np.minimum(nearest[rows], solid.distances(origins, T_solid_world.rotate(rays_world[rows])))
    return nearest
