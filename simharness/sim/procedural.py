"""Household-like objects made from a seed: what `procedural` and `procedural-train` hold.

Knows neither files nor physics: it returns the bytes of a URDF and its meshes, the same bytes for the same seed.

Every object is built of lofts (a stack of convex rings, skinned and capped), so that the meshes are watertight and a
convex decomposition is known by construction instead of being searched for:

- a visual mesh is one or several closed shells of one colour; shells may reach into each other;
- the collision mesh holds each convex part in an `o` group of its own.

Metres. An object stands stably upright on its lowest face with +z up. The origin is the centre of mass: the volume
centroid of the convex parts, with metal counted heavier. Sizes are those of the real things; scenes scale them.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt
from jaxtyping import Float64, Int64

Split = Literal["test", "train"]
Array = npt.NDArray[np.float64]
Colour = tuple[float, float, float]

#: Objects of each family in a split.
OBJECTS_PER_FAMILY: dict[Split, int] = {"test": 2, "train": 10}

_SPLIT_SEEDS: dict[str, int] = {"test": 1, "train": 2}
_RING = 32  # corners of a round section
_SECTORS = 16  # convex parts around a hollow wall; a divisor of _RING
_MASS = 0.5
_METAL = 3.0  # density of metal parts relative to the rest


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
        name: `procedural/<split>/<family>_<number>`.
        bodies: its shapes, origin at the centre of mass.
    """

    name: str
    bodies: tuple[Body, ...]

    def files(self) -> dict[str, bytes]:
        """File names and contents, to be put into one folder; `object.urdf` refers to the others."""
        files = {
            f"visual_{number}.obj": _obj([(f"shell_{i}", mesh) for i, mesh in enumerate(body.shells)])
            for number, body in enumerate(self.bodies)
        }
        parts = [part for body in self.bodies for part in body.parts]
        files["collision.obj"] = _obj([(f"part_{i}", mesh) for i, mesh in enumerate(parts)])
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


def object_names(split: Split) -> tuple[str, ...]:
    """Names of a split's objects, `procedural/<split>/<family>_<number>`, sorted."""
    numbers = range(OBJECTS_PER_FAMILY[split])
    return tuple(f"procedural/{split}/{family}_{number:02d}" for family in sorted(FAMILIES) for number in numbers)


def generate_object(name: str) -> GeneratedObject:
    """The object of that name (one of `object_names`); the name is its seed, so no two splits share an object."""
    _, split, last = name.split("/")
    family, _, number = last.rpartition("_")
    rng = np.random.default_rng([_SPLIT_SEEDS[split], int(number), *family.encode()])
    bodies = FAMILIES[family](rng)
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


def _obj(groups: Sequence[tuple[str, Mesh]]) -> bytes:
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


def _loft(rings: Sequence[Array], *, closed: bool = False) -> Mesh:
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


def _at(section: Array, height: float) -> Array:
    """A plane section (K, 2) as a horizontal ring (K, 3)."""
    return np.column_stack([section, np.full(len(section), height)])


def _round(x_radius: float = 1.0, y_radius: float | None = None, power: float = 2.0) -> Array:
    """Superellipse |x/a|^p + |y/b|^p = 1 as (K, 2): power 2 is an ellipse, more comes near a rectangle."""
    angles = 2.0 * np.pi * np.arange(_RING) / _RING
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    unit = np.round(unit, 12)  # exact zeros and symmetry
    unit = np.sign(unit) * np.abs(unit) ** (2.0 / power)
    section: Array = unit * (x_radius, x_radius if y_radius is None else y_radius)
    return section


def _chamfered(x_size: float, y_size: float, chamfer: float) -> Array:
    """Rectangle with its four corners cut, as (8, 2)."""
    x, y = x_size / 2, y_size / 2
    u, v = x - chamfer, y - chamfer
    return np.array([[x, -v], [x, v], [u, y], [-u, y], [-x, v], [-x, -v], [-u, -y], [u, -y]])


def _stack(section: Array, profile: Sequence[tuple[float, float]], colour: Colour, density: float = 1.0) -> Body:
    """A solid of similar sections: profile of (scale, height), heights rising.

    Its convex parts are the longest runs along which the scale is a concave function of the height.
    """
    rings = [_at(section * scale, height) for scale, height in profile]
    scales, heights = np.array(profile).T
    slopes = np.diff(scales) / np.diff(heights)
    parts = []
    start = 0
    for end in range(1, len(rings)):
        if end == len(rings) - 1 or slopes[end] > slopes[end - 1] + 1e-9:
            parts.append(_loft(rings[start : end + 1]))
            start = end
    return Body((_loft(rings),), tuple(parts), colour, density)


def _block(size: tuple[float, float, float], centre: tuple[float, float], base: float, chamfer: float = 0.0015) -> Mesh:
    """A box standing at height `base`, its edges chamfered: convex."""
    x, y, z = size
    outer = _chamfered(x, y, chamfer) + centre
    inner = _chamfered(x - 2 * chamfer, y - 2 * chamfer, chamfer / 2) + centre
    return _loft([_at(inner, base), _at(outer, base + chamfer), _at(outer, base + z - chamfer), _at(inner, base + z)])


def _solid(parts: Sequence[Mesh], colour: Colour, density: float = 1.0) -> Body:
    """A body that is drawn as it is touched."""
    return Body(tuple(parts), tuple(parts), colour, density)


def _hollow(profile: Sequence[tuple[float, float]], wall: float, floor: float | None, colour: Colour) -> Body:
    """A round vessel: profile of (outer radius, height), heights rising from 0; without a floor it is a tube."""
    radii, heights = np.array(profile).T
    levels = heights if floor is None else np.insert(heights[heights > floor + 1e-6], 0, floor)
    circle = _round()
    outer = [_at(circle * r, z) for r, z in zip(np.interp(levels, heights, radii), levels, strict=True)]
    inner = [_at(circle * (r - wall), z) for r, z in zip(np.interp(levels, heights, radii), levels, strict=True)]
    base = [] if floor is None else [_at(circle * r, z) for r, z in profile if z < floor - 1e-6]
    shell = _loft([*base, *outer, *inner[::-1]], closed=floor is None)
    step = _RING // _SECTORS
    parts = [_loft([*base, outer[0]])] if base else []
    for low in range(len(levels) - 1):
        for first in range(0, _RING, step):
            outside = [(first + i) % _RING for i in range(step + 1)]
            inside = [outside[-1], outside[0]]
            parts.append(_loft([np.concatenate([outer[i][outside], inner[i][inside]]) for i in (low, low + 1)]))
    return Body((shell,), tuple(parts), colour)


def _chain(rings: Sequence[Array], colour: Colour, density: float = 1.0) -> Body:
    """A bent bar: one shell, a convex part between each two rings."""
    parts = tuple(_loft(pair) for pair in pairwise(rings))
    return Body((_loft(rings),), parts, colour, density)


# --- families ----------------------------------------------------------------------------------------------------


def _colour(rng: np.random.Generator) -> Colour:
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.35, 0.95), rng.uniform(0.5, 0.95))


def _grey(rng: np.random.Generator) -> Colour:
    value = rng.uniform(0.35, 0.8)
    return value, value, value


def _box(rng: np.random.Generator) -> list[Body]:
    thin, wide, tall = rng.uniform(0.028, 0.065), rng.uniform(0.04, 0.09), rng.uniform(0.04, 0.17)
    return [_solid([_block((thin, max(thin, wide), tall), (0, 0), 0)], _colour(rng))]


def _cylinder(rng: np.random.Generator) -> list[Body]:
    radius, height, edge = rng.uniform(0.016, 0.034), rng.uniform(0.05, 0.13), 0.0015
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [_stack(_round(), profile, _colour(rng))]


def _can(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.025, 0.035), rng.uniform(0.06, 0.14)
    neck = radius * rng.uniform(0.85, 0.95)
    profile = [(neck, 0), (radius, 0.007), (radius, height - 0.01), (neck, height - 0.002)]
    rim = [(neck, height - 0.0025), (neck, height)]
    return [_stack(_round(), profile, _colour(rng)), _stack(_round(), rim, _grey(rng))]


def _bottle(rng: np.random.Generator) -> list[Body]:
    radius, body = rng.uniform(0.025, 0.036), rng.uniform(0.07, 0.11)
    neck, shoulder, top = radius * rng.uniform(0.35, 0.5), rng.uniform(0.02, 0.04), rng.uniform(0.015, 0.03)
    swell = radius * rng.uniform(0.94, 1.0)  # a waist that a hand finds
    profile = [
        (radius * 0.94, 0),
        (radius, 0.005),
        (swell, body * 0.5),
        (radius, body),
        (0.55 * radius + 0.45 * neck, body + shoulder * 0.6),
        (neck, body + shoulder),
        (neck, body + shoulder + top),
    ]
    height = body + shoulder + top
    cap = [(neck * 1.25, height - 0.002), (neck * 1.25, height + rng.uniform(0.01, 0.018))]
    return [_stack(_round(), profile, _colour(rng)), _stack(_round(), cap, _colour(rng))]


def _dispenser(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.018, 0.028), rng.uniform(0.03, 0.042), rng.uniform(0.09, 0.14)
    profile = [(0.93, 0), (1.0, 0.006), (1.0, height * 0.75), (0.85, height * 0.92), (0.5, height)]
    neck = rng.uniform(0.008, 0.012)
    rise = height + rng.uniform(0.02, 0.035)
    colour = _colour(rng)
    stem = _stack(_round(), [(neck, height - 0.002), (neck, rise)], colour)
    reach = rng.uniform(0.03, 0.045)
    spout = _solid([_block((0.016, reach, 0.011), (0, reach / 2 - 0.01), rise - 0.001)], colour)
    return [
        _stack(_round(x, y, rng.uniform(2.0, 3.5)), profile, _colour(rng)),
        replace(stem, shells=stem.shells + spout.shells, parts=stem.parts + spout.parts),
    ]


def _jar(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.024, 0.035), rng.uniform(0.05, 0.11)
    neck, lid = radius * rng.uniform(0.8, 0.92), rng.uniform(0.01, 0.018)
    profile = [(radius * 0.93, 0), (radius, 0.005), (radius, height * 0.8), (neck, height)]
    cap = [(neck * 1.06, height - 0.001), (neck * 1.06, height + lid - 0.002), (neck, height + lid)]
    return [_stack(_round(), profile, _colour(rng)), _stack(_round(), cap, _colour(rng))]


def _cup(rng: np.random.Generator) -> list[Body]:
    rim, height = rng.uniform(0.032, 0.042), rng.uniform(0.07, 0.12)
    base = rim * rng.uniform(0.65, 0.9)
    return [_hollow([(base, 0), (rim, height)], rng.uniform(0.003, 0.0045), 0.005, _colour(rng))]


def _mug(rng: np.random.Generator) -> list[Body]:
    radius, height, wall = rng.uniform(0.032, 0.04), rng.uniform(0.075, 0.105), rng.uniform(0.0035, 0.005)
    body = _hollow([(radius * 0.97, 0), (radius, 0.012), (radius, height)], wall, 0.006, _colour(rng))
    out, up = rng.uniform(0.024, 0.034), height * rng.uniform(0.26, 0.34)
    thick, wide = rng.uniform(0.007, 0.01), rng.uniform(0.01, 0.015)
    rings = []
    for angle in np.linspace(-np.pi / 2, np.pi / 2, 9):
        point = np.array([radius - wall / 2 + out * np.cos(angle), 0.0, height / 2 + up * np.sin(angle)])
        normal = np.array([np.cos(angle) / out, 0.0, np.sin(angle) / up])
        normal *= thick / 2 / np.linalg.norm(normal)
        side = np.array([0.0, wide / 2, 0.0])
        rings.append(point + np.stack([-normal - side, normal - side, normal + side, -normal + side]))
    return [body, _chain(rings, body.colour)]


def _bowl(rng: np.random.Generator) -> list[Body]:
    rim, height = rng.uniform(0.045, 0.062), rng.uniform(0.035, 0.06)
    base = rim * rng.uniform(0.45, 0.6)
    profile = [(base + (rim - base) * np.sin(t * np.pi / 2), height * (0.12 + 0.88 * t)) for t in (0.25, 0.55, 1.0)]
    return [_hollow([(base, 0), *profile], rng.uniform(0.0035, 0.005), 0.006, _colour(rng))]


def _tube(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.018, 0.035), rng.uniform(0.05, 0.14)
    return [_hollow([(radius, 0), (radius, height)], rng.uniform(0.003, 0.006), None, _colour(rng))]


def _carton(rng: np.random.Generator) -> list[Body]:
    x, y, body = rng.uniform(0.04, 0.065), rng.uniform(0.04, 0.07), rng.uniform(0.07, 0.13)
    roof, fin = rng.uniform(0.02, 0.032), rng.uniform(0.01, 0.016)
    edge, ridge = 0.001, 0.004
    lower, upper = _chamfered(x, y, edge), _chamfered(ridge, y, edge)
    shape = _loft([_at(lower, 0), _at(lower, body), _at(upper, body + roof)])
    top = _block((ridge, y, fin), (0, 0), body + roof - 0.001, 0.0005)
    return [_solid([shape], _colour(rng)), _solid([top], _grey(rng))]


def _fruit(rng: np.random.Generator) -> list[Body]:
    radius = rng.uniform(0.022, 0.037)
    tall, pear = radius * rng.uniform(0.85, 1.25), rng.choice([0.0, rng.uniform(0.1, 0.3)])
    angles = np.linspace(-np.pi / 2 * 0.68, np.pi / 2 * 0.94, 14)
    profile = [(radius * np.cos(a) * (1 - pear * (1 + np.sin(a)) / 2), tall * (1 + pear) * np.sin(a)) for a in angles]
    return [_stack(_round(), profile, _colour(rng))]


def _wedge(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.03, 0.06), rng.uniform(0.04, 0.08), rng.uniform(0.035, 0.08)
    edge, top = 0.001, rng.uniform(0.15, 0.5)
    lean = rng.uniform(-1, 1) * x * (1 - top) / 2
    lower, upper = _chamfered(x, y, edge), _chamfered(x * top, y * rng.uniform(0.7, 1.0), edge) + np.array([lean, 0.0])
    return [_solid([_loft([_at(lower, 0), _at(upper, height)])], _colour(rng))]


def _prism(rng: np.random.Generator) -> list[Body]:
    sides, radius, height = int(rng.choice([3, 5, 6, 8])), rng.uniform(0.02, 0.036), rng.uniform(0.04, 0.14)
    angles = 2 * np.pi * np.arange(sides) / sides
    section = np.column_stack([np.cos(angles), np.sin(angles)])
    edge = 0.0015
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [_stack(section, profile, _colour(rng))]


def _soap(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.02, 0.032), rng.uniform(0.03, 0.048), rng.uniform(0.03, 0.045)
    profile = [(0.8, 0), (0.94, height * 0.15), (1.0, height * 0.45), (0.94, height * 0.8), (0.75, height)]
    return [_stack(_round(x, y, rng.uniform(2.0, 4.0)), profile, _colour(rng))]


def _l_shape(rng: np.random.Generator) -> list[Body]:
    thick, long, short = rng.uniform(0.018, 0.03), rng.uniform(0.06, 0.1), rng.uniform(0.045, 0.07)
    depth = rng.uniform(0.03, 0.055)
    if rng.uniform() < 0.5:  # lying: the letter seen from above
        parts = [
            _block((long, thick, depth), (0, 0), 0),
            _block((thick, short - thick / 2, depth), ((thick - long) / 2, short / 2 - thick / 4), 0),
        ]
    else:  # standing on its foot
        parts = [
            _block((short, depth, thick), (0, 0), 0),
            _block((thick, depth, long - thick / 2), ((thick - short) / 2, 0), thick / 2),
        ]
    return [_solid(parts, _colour(rng))]


def _t_shape(rng: np.random.Generator) -> list[Body]:
    thick, bar, stem = rng.uniform(0.018, 0.028), rng.uniform(0.055, 0.09), rng.uniform(0.05, 0.09)
    depth = rng.uniform(0.03, 0.05)
    if rng.uniform() < 0.5:  # lying: the letter seen from above
        parts = [
            _block((bar, thick, depth), (0, 0), 0),
            _block((thick, stem, depth), (0, (stem - thick) / 2), 0),
        ]
    else:  # upside down
        parts = [_block((bar, depth, thick), (0, 0), 0), _block((thick, depth, stem), (0, 0), thick / 2)]
    return [_solid(parts, _colour(rng))]


def _hammer(rng: np.random.Generator) -> list[Body]:
    """Stands on the side of its head, the handle up."""
    wide, high, long = rng.uniform(0.03, 0.038), rng.uniform(0.026, 0.034), rng.uniform(0.075, 0.1)
    head = _block((long * 0.6, wide, high), (0, 0), 0)
    nose = _block((long * 0.22, wide * 0.9, high), (long * 0.4, 0), 0)
    tip = np.array([[-long * 0.28, 0.0], [-long * 0.62, 0.0]])
    claw = _loft(
        [
            np.array([[x, -h, 0.0], [x, h, 0.0], [x, h, high], [x, -h, high]])
            for (x, _), h in zip(tip, (wide * 0.42, wide * 0.12), strict=True)
        ]
    )
    handle = _stack(
        _round(rng.uniform(0.012, 0.015), rng.uniform(0.009, 0.012)),
        [(0.8, high - 0.003), (0.8, high + 0.03), (1.0, high + 0.06), (1.0, high + rng.uniform(0.09, 0.13))],
        _colour(rng),
    )
    return [_solid([head, nose, claw], _grey(rng), _METAL), handle]


def _screwdriver(rng: np.random.Generator) -> list[Body]:
    """Stands on the end of its handle, the shaft up."""
    radius, handle, shaft = rng.uniform(0.014, 0.018), rng.uniform(0.075, 0.095), rng.uniform(0.05, 0.08)
    profile = [
        (radius * 0.95, 0),
        (radius, 0.004),
        (radius, handle * 0.6),
        (radius * 0.7, handle * 0.85),
        (radius * 0.8, handle),
    ]
    thin = rng.uniform(0.003, 0.0045)
    steel = [(thin, handle - 0.002), (thin, handle + shaft - 0.008), (thin * 0.6, handle + shaft)]
    return [_stack(_round(), profile, _colour(rng)), _stack(_round(), steel, _grey(rng))]


def _wrench(rng: np.random.Generator) -> list[Body]:
    """Lies flat: a bar, an open jaw at one end and a ring at the other."""
    thick, wide, long = rng.uniform(0.02, 0.026), rng.uniform(0.016, 0.024), rng.uniform(0.08, 0.11)
    jaw = wide * rng.uniform(1.5, 1.8)
    prong, reach = jaw * 0.3, jaw * 0.75
    end = long / 2
    parts = [
        _block((long, wide, thick), (0, 0), 0),
        _block((jaw * 0.5, jaw, thick), (end, 0), 0),
        _block((reach, prong, thick), (end + reach / 2, (jaw - prong) / 2), 0),
        _block((reach, prong, thick), (end + reach / 2, -(jaw - prong) / 2), 0),
    ]
    colour = _grey(rng)
    radius = wide * rng.uniform(0.75, 0.95)
    ring = _hollow([(radius, 0), (radius, thick)], radius * 0.45, None, colour)
    offset = np.array([-end - radius * 0.7, 0.0, 0.0])
    moved = [tuple(mesh.moved(offset) for mesh in meshes) for meshes in (ring.shells, ring.parts)]
    return [Body((*parts, *moved[0]), (*parts, *moved[1]), colour)]


FAMILIES: dict[str, Callable[[np.random.Generator], list[Body]]] = {
    "bottle": _bottle,
    "bowl": _bowl,
    "box": _box,
    "can": _can,
    "carton": _carton,
    "cup": _cup,
    "cylinder": _cylinder,
    "dispenser": _dispenser,
    "fruit": _fruit,
    "hammer": _hammer,
    "jar": _jar,
    "l_shape": _l_shape,
    "mug": _mug,
    "prism": _prism,
    "screwdriver": _screwdriver,
    "soap": _soap,
    "t_shape": _t_shape,
    "tube": _tube,
    "wedge": _wedge,
    "wrench": _wrench,
}
