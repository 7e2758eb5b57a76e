"""Solids made of lofts, and the files that describe one to a simulator.

Knows neither which objects there are nor physics.

A loft is a stack of convex rings, skinned and capped, so that meshes are watertight and a convex decomposition is known
by construction instead of being searched for:

- a visual mesh is one or several closed shells of one colour; shells may reach into each other;
- the collision mesh holds each convex part in an `o` group of its own.

Metres. The origin is the centre of mass: the volume centroid of the convex parts, with metal counted heavier.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from jaxtyping import Float64, Int64

Array = npt.NDArray[np.float64]
Colour = tuple[float, float, float]

METAL = 3.0
"""Density of metal parts relative to the rest."""

_RING = 32  # corners of a round section
_SECTORS = 16  # convex parts around a hollow wall; a divisor of _RING
_MASS = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A closed triangle mesh, its faces counter-clockwise seen from outside.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3) indices of vertices.
    """

    vertices: Float64[np.ndarray, "vertices 3"]
    faces: Int64[np.ndarray, "faces 3"]

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float64), ("faces", np.int64)):
            array = np.array(getattr(self, name), dtype=dtype)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def volume(self) -> float:
        """Enclosed volume in cubic metres: the sum of the signed tetrahedra between the faces and the origin."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    @property
    def centroid(self) -> Float64[np.ndarray, " 3"]:
        """Centre (3,) of the enclosed volume."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        centre: Array = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volumes.sum())
        return centre

    def moved(self, offset: Float64[np.ndarray, " 3"]) -> Mesh:
        """The mesh at another place."""
        return Mesh(self.vertices + offset, self.faces)


@dataclass(frozen=True, slots=True)
class Body:
    """One material of an object: closed shells to look at, convex parts to touch.

    Args:
        shells: what is drawn, in one colour.
        parts: convex meshes that fill the same space.
        colour: red, green, blue between 0 and 1.
        density: weight in the centre of mass, relative to the object's other bodies.
    """

    shells: tuple[Mesh, ...]
    parts: tuple[Mesh, ...]
    colour: Colour
    density: float = 1.0


@dataclass(frozen=True, slots=True)
class GeneratedObject:
    """An object and the files that describe it to a simulator.

    Args:
        name: unique among all generated objects.
        bodies: its shapes, origin at the centre of mass.
    """

    name: str
    bodies: tuple[Body, ...]

    def files(self) -> dict[str, bytes]:
        """File names and contents, to be put into one folder; `object.urdf` refers to the others."""
        files = {
            f"visual_{number}.obj": obj_file([(f"shell_{i}", mesh) for i, mesh in enumerate(body.shells)])
            for number, body in enumerate(self.bodies)
        }
        parts = [part for body in self.bodies for part in body.parts]
        files["collision.obj"] = obj_file([(f"part_{i}", mesh) for i, mesh in enumerate(parts)])
        files["object.urdf"] = self._urdf()
        return files

    def _urdf(self) -> bytes:
        visuals = "".join(
            f'    <visual><geometry><mesh filename="visual_{number}.obj"/></geometry>'
            f'<material name="colour_{number}"><color rgba="{red:.3f} {green:.3f} {blue:.3f} 1"/></material></visual>\n'
            for number, (red, green, blue) in enumerate(body.colour for body in self.bodies)
        )
        return (
            '<?xml version="1.0"?>\n'
            f'<robot name="{self.name.rpartition("/")[2]}">\n'
            '  <link name="base_link">\n'
            '    <contact><lateral_friction value="1.0"/></contact>\n'
            f'    <inertial><origin xyz="0 0 0"/><mass value="{_MASS}"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>\n'
            f"{visuals}"
            '    <collision><geometry><mesh filename="collision.obj"/></geometry></collision>\n'
            "  </link>\n"
            "</robot>\n"
        ).encode()


def centred(name: str, bodies: Sequence[Body]) -> GeneratedObject:
    """An object of some bodies, its origin moved to their centre of mass."""
    parts = [(part, body.density) for body in bodies for part in body.parts]
    weights = np.array([part.volume * density for part, density in parts])
    centre = weights @ np.stack([part.centroid for part, _ in parts]) / weights.sum()
    return GeneratedObject(
        name,
        tuple(
            replace(
                body,
                shells=tuple(mesh.moved(-centre) for mesh in body.shells),
                parts=tuple(mesh.moved(-centre) for mesh in body.parts),
            )
            for body in bodies
        ),
    )


def obj_file(groups: Sequence[tuple[str, Mesh]]) -> bytes:
    """The text of an OBJ file of named meshes, to the micrometre."""
    lines = []
    first = 1
    for name, mesh in groups:
        lines.append(f"o {name}")
        rounded = np.round(mesh.vertices, 6) + 0.0  # micrometres; + 0.0 turns -0 into 0
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in rounded.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + first).tolist()]
        first += len(mesh.vertices)
    return ("\n".join(lines) + "\n").encode()


# --- lofts -------------------------------------------------------------------------------------------------------


def loft(rings: Sequence[Array], *, closed: bool = False) -> Mesh:
    """Skin over rings of equally many corners; capped at both ends, or closed from the last ring to the first."""
    stack = np.stack(rings)
    count, corners = stack.shape[:2]
    index = np.arange(count * corners).reshape(count, corners)
    low, high = (index, np.roll(index, -1, axis=0)) if closed else (index[:-1], index[1:])
    a, d = low.ravel(), high.ravel()
    b, c = np.roll(low, -1, axis=1).ravel(), np.roll(high, -1, axis=1).ravel()
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    if not closed:
        fan = np.arange(1, corners - 1)
        faces.append(np.stack([np.zeros_like(fan), fan + 1, fan], axis=1))
        faces.append(np.stack([np.zeros_like(fan), fan, fan + 1], axis=1) + index[-1, 0])
    mesh = Mesh(stack.reshape(-1, 3), np.concatenate(faces))
    return mesh if mesh.volume > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def at_height(section: Array, height: float) -> Array:
    """A plane section (K, 2) as a horizontal ring (K, 3)."""
    return np.column_stack([section, np.full(len(section), height)])


def oval(x_radius: float = 1.0, y_radius: float | None = None, power: float = 2.0) -> Array:
    """Superellipse |x/a|^p + |y/b|^p = 1 as (K, 2): power 2 is an ellipse, more comes near a rectangle."""
    angles = 2.0 * np.pi * np.arange(_RING) / _RING
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    unit = np.round(unit, 12)  # exact zeros and symmetry
    unit = np.sign(unit) * np.abs(unit) ** (2.0 / power)
    section: Array = unit * (x_radius, x_radius if y_radius is None else y_radius)
    return section


def chamfered(x_size: float, y_size: float, chamfer: float) -> Array:
    """Rectangle with its four corners cut, as (8, 2)."""
    x, y = x_size / 2, y_size / 2
    u, v = x - chamfer, y - chamfer
    return np.array([[x, -v], [x, v], [u, y], [-u, y], [-x, v], [-x, -v], [-u, -y], [u, -y]])


def stack(section: Array, profile: Sequence[tuple[float, float]], colour: Colour, density: float = 1.0) -> Body:
    """A solid of similar sections: profile of (scale, height), heights rising.

    Its convex parts are the longest runs along which the scale is a concave function of the height.
    """
    rings = [at_height(section * scale, height) for scale, height in profile]
    scales, heights = np.array(profile).T
    slopes = np.diff(scales) / np.diff(heights)
    parts = []
    start = 0
    for end in range(1, len(rings)):
        if end == len(rings) - 1 or slopes[end] > slopes[end - 1] + 1e-9:
            parts.append(loft(rings[start : end + 1]))
            start = end
    return Body((loft(rings),), tuple(parts), colour, density)


def block(size: tuple[float, float, float], centre: tuple[float, float], base: float, chamfer: float = 0.0015) -> Mesh:
    """A box standing at height `base`, its edges chamfered: convex."""
    x, y, z = size
    outer = chamfered(x, y, chamfer) + centre
    inner = chamfered(x - 2 * chamfer, y - 2 * chamfer, chamfer / 2) + centre
    return loft(
        [
            at_height(inner, base),
            at_height(outer, base + chamfer),
            at_height(outer, base + z - chamfer),
            at_height(inner, base + z),
        ]
    )


def solid(parts: Sequence[Mesh], colour: Colour, density: float = 1.0) -> Body:
    """A body that is drawn as it is touched."""
    return Body(tuple(parts), tuple(parts), colour, density)


def hollow(profile: Sequence[tuple[float, float]], wall: float, floor: float | None, colour: Colour) -> Body:
    """A round vessel: profile of (outer radius, height), heights rising from 0; without a floor it is a tube."""
    radii, heights = np.array(profile).T
    levels = heights if floor is None else np.insert(heights[heights > floor + 1e-6], 0, floor)
    circle = oval()
    outer = [at_height(circle * r, z) for r, z in zip(np.interp(levels, heights, radii), levels, strict=True)]
    inner = [at_height(circle * (r - wall), z) for r, z in zip(np.interp(levels, heights, radii), levels, strict=True)]
    base = [] if floor is None else [at_height(circle * r, z) for r, z in profile if z < floor - 1e-6]
    shell = loft([*base, *outer, *inner[::-1]], closed=floor is None)
    step = _RING // _SECTORS
    parts = [loft([*base, outer[0]])] if base else []
    for low in range(len(levels) - 1):
        for first in range(0, _RING, step):
            outside = [(first + i) % _RING for i in range(step + 1)]
            inside = [outside[-1], outside[0]]
            parts.append(loft([np.concatenate([outer[i][outside], inner[i][inside]]) for i in (low, low + 1)]))
    return Body((shell,), tuple(parts), colour)


def chain(rings: Sequence[Array], colour: Colour, density: float = 1.0) -> Body:
    """A bent bar: one shell, a convex part between each two rings."""
    parts = tuple(loft(pair) for pair in pairwise(rings))
    return Body((loft(rings),), parts, colour, density)


def any_colour(rng: np.random.Generator) -> Colour:
    """A colour of a thing that is painted or dyed."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.35, 0.95), rng.uniform(0.5, 0.95))


def any_grey(rng: np.random.Generator) -> Colour:
    """A colour of bare metal."""
    value = rng.uniform(0.35, 0.8)
    return value, value, value
