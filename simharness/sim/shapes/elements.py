"""What the families of shapes are put together from: rods, tubes, cones, stars and blobs, each of convex parts.

Knows no family. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from simharness.sim.solids import Array, Mesh, loft

_TUBE_CORNERS = 8
_GOLDEN = (1.0 + np.sqrt(5.0)) / 2.0
_ICOSAHEDRON = np.array(
    [
        *((0.0, a, b * _GOLDEN) for a in (-1, 1) for b in (-1, 1)),
        *((a, b * _GOLDEN, 0.0) for a in (-1, 1) for b in (-1, 1)),
        *((b * _GOLDEN, 0.0, a) for a in (-1, 1) for b in (-1, 1)),
    ]
) / np.hypot(1.0, _GOLDEN)


def rod(start: Sequence[float], end: Sequence[float], radii: tuple[float, float], corners: int = 10) -> Mesh:
    """A straight round bar, or with two radii the frustum of a cone: convex."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    across, beside = _across(b - a)
    angles = 2 * np.pi * np.arange(corners) / corners
    circle = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * beside
    return loft([a + radii[0] * circle, b + radii[1] * circle])


def tube(path: Array, radii: Array, *, closed: bool = False) -> tuple[Mesh, ...]:
    """The convex parts of a bar bent along a path that is nowhere vertical.

    Args:
        path: (N, 3) points of its middle line.
        radii: (N,) there.
        closed: whether the last point is followed by the first.
    """
    ahead = np.roll(path, -1, axis=0) if closed else np.concatenate([path[1:], 2 * path[-1:] - path[-2:-1]])
    behind = np.roll(path, 1, axis=0) if closed else np.concatenate([2 * path[:1] - path[1:2], path[:-1]])
    directions = ahead - behind
    sideways = np.cross([0.0, 0.0, 1.0], directions)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    upwards = np.cross(directions, sideways)
    upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
    angles = 2 * np.pi * (np.arange(_TUBE_CORNERS) + 0.5) / _TUBE_CORNERS
    rings = [
        point + radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up)
        for point, radius, side, up in zip(path, radii, sideways, upwards, strict=True)
    ]
    following = [*rings[1:], rings[0]] if closed else rings[1:]
    return tuple(loft(pair) for pair in zip(rings, following, strict=False))


def star(outline: Array, profile: Sequence[tuple[float, float]]) -> tuple[Mesh, ...]:
    """The convex parts of a stack of similar sections, each of which is seen whole from its middle.

    Args:
        outline: (K, 2) corners of a section around the origin, counter-clockwise.
        profile: of (scale, height), heights rising.
    """
    parts = []
    for (low, bottom), (high, top) in pairwise(profile):
        for corner, following in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            wedge = np.stack([np.zeros(2), corner, following])
            parts.append(
                loft([np.column_stack([wedge * scale, np.full(3, z)]) for scale, z in ((low, bottom), (high, top))])
            )
    return tuple(parts)


def ball(radius: float, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A ball of 80 faces: convex."""
    directions, faces = _sphere()
    return Mesh(np.asarray(centre) + radius * directions, faces)


def blob(radius: Callable[[Array], Array], floor: float) -> tuple[Mesh, ...]:
    """The convex parts of a solid whose whole surface is seen from its middle, flattened below: tetrahedra, exactly.

    Args:
        radius: of unit directions (N, 3), metres.
        floor: depth under the middle where it is cut off, metres.
    """
    directions, faces = _sphere()
    reach = np.maximum(radius(directions), 1e-3)
    down = -directions[:, 2]
    reach = np.where(down * reach > floor, floor / np.maximum(down, 1e-9), reach)
    corners = directions * reach[:, None]
    tetrahedron = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    parts = []
    for a, b, c in faces:
        part = Mesh(np.stack([np.zeros(3), corners[a], corners[b], corners[c]]), tetrahedron)
        parts.append(part if part.volume > 0 else Mesh(part.vertices, tetrahedron[:, ::-1]))
    return tuple(parts)


def turned(mesh: Mesh, angle: float, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A mesh turned about +z and then moved."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return Mesh(mesh.vertices @ turn.T + np.asarray(offset), mesh.faces)


def any_direction(rng: np.random.Generator) -> Array:
    """A unit vector (3,), all directions alike."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with a direction."""
    along = direction / np.linalg.norm(direction)
    least = np.eye(3)[int(np.argmin(np.abs(along)))]
    across = np.cross(along, least)
    across /= np.linalg.norm(across)
    return across, np.cross(along, across)


def _sphere() -> tuple[Array, np.ndarray[tuple[int, int], np.dtype[np.int64]]]:
    """Directions (42, 3) and faces (80, 3) of an icosahedron whose faces are each cut into four."""
    gaps = np.linalg.norm(_ICOSAHEDRON[:, None] - _ICOSAHEDRON[None], axis=2)
    near = np.isclose(gaps, gaps[gaps > 1e-9].min())
    corners = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    directions = [*_ICOSAHEDRON]
    middles: dict[tuple[int, int], int] = {}
    for pair in sorted({pair for a, b, c in corners for pair in ((a, b), (b, c), (a, c))}):
        middles[pair] = len(directions)
        middle = _ICOSAHEDRON[pair[0]] + _ICOSAHEDRON[pair[1]]
        directions.append(middle / np.linalg.norm(middle))
    points = np.stack(directions)
    faces = []
    for a, b, c in corners:
        ab, bc, ac = middles[a, b], middles[b, c], middles[a, c]
        faces += [(a, ab, ac), (ab, b, bc), (ac, bc, c), (ab, bc, ac)]
    outward = [
        (a, b, c) if np.linalg.det(points[[a, b, c]]) > 0 else (a, c, b) for a, b, c in faces
    ]  # counter-clockwise from outside
    return points, np.array(outward, dtype=np.int64)
