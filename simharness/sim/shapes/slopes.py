"""Families whose faces lean, so that fingers slide off them or hold them, as it happens: `slopes-train`.

Few of their faces are parallel. Most are wider than the hand and have an edge or an end that it reaches around.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from simharness.sim.shapes.elements import any_direction, rod, turned
from simharness.sim.solids import Array, Body, Mesh, any_colour, at_height, loft, solid

VERSION = 1


def _wedge(rng: np.random.Generator) -> list[Body]:
    """A bar of three or four faces that narrows along its length: roofs, keels, axe heads."""
    return [solid([_bar(rng, rng.uniform(0.06, 0.14), rng.uniform(0.018, 0.055))], any_colour(rng))]


def _shard(rng: np.random.Generator) -> list[Body]:
    """An oblique pyramid over any convex outline, its tip cut off or nearly whole."""
    return [solid([_pyramid(rng, rng.uniform(0.028, 0.065), rng.uniform(0.035, 0.11))], any_colour(rng))]


def _rock(rng: np.random.Generator) -> list[Body]:
    """A ball cut into few faces, its layers pushed aside."""
    return [solid([_pebble(rng, rng.uniform(0.025, 0.06))], any_colour(rng))]


def _bundle(rng: np.random.Generator) -> list[Body]:
    """Two or three wedges, shards and rocks that have grown into each other."""
    bodies = []
    for number in range(int(rng.integers(2, 4))):
        size = rng.uniform(0.016, 0.042)
        kind = int(rng.integers(3))
        if kind == 0:
            part = _bar(rng, size * rng.uniform(2.0, 4.0), size * 0.8)
        else:
            part = _pyramid(rng, size, size * rng.uniform(1.2, 2.4)) if kind == 1 else _pebble(rng, size)
        offset = any_direction(rng) * size * rng.uniform(0.5, 0.9) if number else np.zeros(3)
        bodies.append(solid([_tumbled(rng, part, offset)], any_colour(rng)))
    return bodies


def _ridge(rng: np.random.Generator) -> list[Body]:
    """A plate that carries one to three blades."""
    outline, thick = _outline(rng, 4, 8) * rng.uniform(0.04, 0.065), rng.uniform(0.006, 0.02)
    bodies = [solid([loft([at_height(outline, 0.0), at_height(outline * 0.96, thick)])], any_colour(rng))]
    for _ in range(int(rng.integers(1, 4))):
        foot, length, height = rng.uniform(0.006, 0.022), rng.uniform(0.012, 0.036), rng.uniform(0.018, 0.06)
        base = np.array([(-length, -foot), (length, -foot), (length, foot), (-length, foot)])
        lean = rng.uniform(-0.5, 0.5, 2) * (length, foot)
        top = base * (rng.uniform(0.4, 1.0), rng.uniform(0.05, 0.6)) + lean
        blade = loft([at_height(base, thick - 0.001), at_height(top, thick + height)])
        place = rng.uniform(-0.02, 0.02, 2)
        bodies.append(solid([turned(blade, rng.uniform(0, np.pi), (*place, 0.0))], any_colour(rng)))
    return bodies


def _vane(rng: np.random.Generator) -> list[Body]:
    """A core from which three to six plates stand out, thinner towards their ends."""
    core = _pebble(rng, rng.uniform(0.014, 0.026))
    bodies = [solid([core], any_colour(rng))]
    for _ in range(int(rng.integers(3, 7))):
        reach, wide, thick = rng.uniform(0.04, 0.075), rng.uniform(0.012, 0.03), rng.uniform(0.005, 0.011)
        root = np.array([(-wide, -thick), (wide, -thick), (wide, thick), (-wide, thick)])
        end = root * (rng.uniform(0.3, 1.1), rng.uniform(0.2, 0.7))
        blade = loft([at_height(root, 0.0), at_height(end, reach)])
        bodies.append(solid([_placed(blade, _rotation(rng), core.centroid)], any_colour(rng)))
    return bodies


def _knuckle(rng: np.random.Generator) -> list[Body]:
    """Three to five rocks in a bent row."""
    place, heading, bodies = np.zeros(3), any_direction(rng), []
    for _ in range(int(rng.integers(3, 6))):
        size = rng.uniform(0.014, 0.03)
        bodies.append(solid([_tumbled(rng, _pebble(rng, size), place)], any_colour(rng)))
        heading = heading + 0.6 * any_direction(rng)
        heading /= np.linalg.norm(heading)
        place = place + heading * size * rng.uniform(0.6, 0.9)
    return bodies


def _elbow(rng: np.random.Generator) -> list[Body]:
    """Two narrowing bars that meet at an angle."""
    size = rng.uniform(0.016, 0.036)
    parts = [_bar(rng, rng.uniform(0.05, 0.1), size * rng.uniform(0.8, 1.2)) for _ in range(2)]
    turn = rng.uniform(0.7, 2.5)
    return [solid([part], any_colour(rng)) for part in (parts[0], turned(parts[1], turn))]


def _twist(rng: np.random.Generator) -> list[Body]:
    """A prism of three to five faces whose section turns, shrinks and drifts along its length."""
    section, length = _outline(rng, 3, 5) * rng.uniform(0.018, 0.05), rng.uniform(0.05, 0.12)
    turn, shrink, drift = -rng.uniform(0.4, 2.4), rng.uniform(0.3, 1.1), rng.uniform(-0.02, 0.02, 2)
    rings, mirrored = [], rng.choice([-1.0, 1.0])
    for share in np.linspace(0.0, 1.0, 9):
        c, s = np.cos(turn * share), np.sin(turn * share)
        ring = section @ np.array([[c, s], [-s, c]]) * (1.0 + (shrink - 1.0) * share) + drift * share
        rings.append(at_height(ring * (1.0, mirrored), length * share))
    return [solid([loft(pair) for pair in pairwise(rings)], any_colour(rng))]


def _horn(rng: np.random.Generator) -> list[Body]:
    """A round bar that bends and thins."""
    return [solid(_bent(rng, rng.uniform(0.05, 0.13), rng.uniform(0.014, 0.034)), any_colour(rng))]


def _claw(rng: np.random.Generator) -> list[Body]:
    """A rock with two to four horns."""
    core = _pebble(rng, rng.uniform(0.018, 0.034))
    bodies = [solid([core], any_colour(rng))]
    for _ in range(int(rng.integers(2, 5))):
        horn, turn = _bent(rng, rng.uniform(0.04, 0.08), rng.uniform(0.009, 0.018)), _rotation(rng)
        bodies.append(solid([_placed(part, turn, core.centroid) for part in horn], any_colour(rng)))
    return bodies


def _sail(rng: np.random.Generator) -> list[Body]:
    """Two to four plates that meet in one edge, narrower and thinner away from it."""
    wide, thick, bodies = rng.uniform(0.02, 0.05), rng.uniform(0.004, 0.009), []
    angles = 2 * np.pi * (np.arange(number := int(rng.integers(2, 5))) + rng.uniform(-0.3, 0.3, number)) / number
    for angle in angles:
        root = np.array([(-thick, -wide), (thick, -wide), (thick, wide), (-thick, wide)])
        end = root * (rng.uniform(0.3, 1.0), rng.uniform(0.05, 0.8)) + (0.0, rng.uniform(-0.5, 0.5) * wide)
        rings = [np.column_stack([np.full(4, x), ring]) for x, ring in ((0.0, root), (rng.uniform(0.03, 0.075), end))]
        bodies.append(solid([turned(loft(rings), angle)], any_colour(rng)))
    return bodies


def _bent(rng: np.random.Generator, length: float, radius: float) -> list[Mesh]:
    """A bar from the origin on, its middle line an arc, of straight pieces whose outer sides meet."""
    pieces = 7
    bend, thinnest = min(rng.uniform(0.4, 3.0), length / (1.2 * radius)), rng.uniform(0.15, 0.8)
    turns, radii = bend * np.arange(pieces) / pieces, radius * np.linspace(1.0, thinnest, pieces + 1)
    directions = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(pieces)])
    ends = np.concatenate([np.zeros((1, 3)), np.cumsum(length / pieces * directions, axis=0)])
    beyond = directions * np.tan(bend / pieces / 2)
    return [
        rod(start - r * more, end + following * more, (r, following))
        for start, end, more, r, following in zip(ends[:-1], ends[1:], beyond, radii[:-1], radii[1:], strict=True)
    ]


def _bar(rng: np.random.Generator, length: float, size: float) -> Mesh:
    section = _outline(rng, 3, 4) * size
    far = section * rng.uniform(0.25, 1.0) + rng.uniform(-0.4, 0.4, 2) * size
    return loft([np.column_stack([np.full(len(ring), x), ring]) for x, ring in ((0.0, section), (length, far))])


def _pyramid(rng: np.random.Generator, size: float, height: float) -> Mesh:
    outline = _outline(rng, 3, 7) * size
    top = outline * rng.uniform(0.05, 0.75) + rng.uniform(-0.5, 0.5, 2) * size
    return loft([at_height(outline, 0.0), at_height(top, height)])


def _pebble(rng: np.random.Generator, size: float) -> Mesh:
    outline, lean = _outline(rng, 4, 8), rng.uniform(-0.5, 0.5, 2)
    turns = np.sort(rng.uniform(-1.3, 1.3, 5)) + np.linspace(-0.1, 0.1, 5)
    high = size * rng.uniform(0.5, 1.2)
    rings = [outline * size * np.cos(turn) + lean * high * np.sin(turn) for turn in turns]
    return loft([at_height(ring, high * np.sin(turn)) for ring, turn in zip(rings, turns, strict=True)])


def _outline(rng: np.random.Generator, fewest: int, most: int) -> Array:
    """A convex outline (K, 2) around the origin, counter-clockwise, its corners on an oval of half width 1."""
    corners = int(rng.integers(fewest, most + 1))
    angles = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.2, 0.2, corners)) / corners
    turn = rng.uniform(0, 2 * np.pi)
    return np.column_stack([np.cos(angles + turn), np.sin(angles + turn) * rng.uniform(0.5, 1.0)])


def _tumbled(rng: np.random.Generator, mesh: Mesh, offset: Array) -> Mesh:
    """A mesh turned anyhow about its centroid, which then lies at the offset."""
    return _placed(mesh.moved(-mesh.centroid), _rotation(rng), offset)


def _placed(mesh: Mesh, turn: Array, offset: Array) -> Mesh:
    """A mesh turned about the origin by a rotation (3, 3) and then moved."""
    return Mesh(mesh.vertices @ turn.T + offset, mesh.faces)


def _rotation(rng: np.random.Generator) -> Array:
    """Any rotation (3, 3)."""
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(turn * np.sign(np.linalg.det(turn)))


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "bundle": _bundle,
    "claw": _claw,
    "elbow": _elbow,
    "horn": _horn,
    "knuckle": _knuckle,
    "ridge": _ridge,
    "rock": _rock,
    "sail": _sail,
    "shard": _shard,
    "twist": _twist,
    "vane": _vane,
    "wedge": _wedge,
}
