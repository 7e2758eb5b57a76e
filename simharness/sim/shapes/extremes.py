"""Things to train with at the ends of what a hand can do: thin, nearly as wide as it opens, or held in few places.

`extremes-train`. Outlines are drawn corner by corner, so that no family repeats one of the validation sets. Sizes are
meant after all scaling, for the Panda.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from simharness.sim.shapes.elements import any_direction, ball, blob, rod, star, turned
from simharness.sim.solids import Array, Body, any_colour, any_grey, at_height, block, loft, solid
from tesnet.geometry import PANDA

VERSION = 1

_THICKNESS = (0.0025, 0.014)
_WIDTH = (0.5 * PANDA.max_width, 0.98 * PANDA.max_width)


def _slab(rng: np.random.Generator) -> list[Body]:
    """A thin thing of any round outline, bays and lobes included."""
    outline = _lobed(rng, rng.uniform(0.012, 0.036), rng.uniform(0.0, 0.25))
    return [solid(star(outline, [(1.0, 0.0), (1.0, rng.uniform(*_THICKNESS))]), any_colour(rng))]


def _step(rng: np.random.Generator) -> list[Body]:
    """A slab with a lower one beside it."""
    low, high = np.sort(rng.uniform(*_THICKNESS, 2))
    size = rng.uniform(0.014, 0.03)
    aside = size * rng.uniform(0.6, 1.2)
    lower = [
        turned(part, 0.0, (aside, 0.0, 0.0))
        for part in star(_lobed(rng, size * rng.uniform(0.6, 1.2), 0.15), [(1.0, 0.0), (1.0, low)])
    ]
    return [
        solid(star(_lobed(rng, size, 0.15), [(1.0, 0.0), (1.0, high)]), any_colour(rng)),
        solid(lower, any_colour(rng)),
    ]


def _strip(rng: np.random.Generator) -> list[Body]:
    """A thin bar of two to five straight pieces: hooks, letters, zigzags."""
    thick, wide = rng.uniform(*_THICKNESS), rng.uniform(0.005, 0.02)
    corner, angle, parts = np.zeros(2), 0.0, []
    for _ in range(int(rng.integers(2, 6))):
        long = rng.uniform(0.02, 0.05)
        ahead = np.array([np.cos(angle), np.sin(angle)])
        middle = corner + ahead * long / 2
        piece = block((long + wide * 0.6, wide, thick), (0, 0), 0, min(0.001, thick / 4, wide / 6))
        parts.append(turned(piece, angle, (middle[0], middle[1], 0.0)))
        corner, angle = corner + ahead * long, angle + rng.choice([-1, 1]) * rng.uniform(0.3, 1.7)
    return [solid(parts, any_grey(rng))]


def _frame(rng: np.random.Generator) -> list[Body]:
    """Four thin bars around a hole."""
    x, y, thick = rng.uniform(0.03, 0.08), rng.uniform(0.04, 0.1), rng.uniform(*_THICKNESS)
    parts = []
    for along, across, side in ((x, y, 1), (x, y, -1), (y, x, 1), (y, x, -1)):
        wide = rng.uniform(0.004, 0.012)
        bar = block((along, wide, thick), (0, side * (across - wide) / 2), 0, min(0.001, thick / 4, wide / 6))
        parts.append(turned(bar, 0.0 if along is x else np.pi / 2))
    return [solid(parts, any_colour(rng))]


def _trunk(rng: np.random.Generator) -> list[Body]:
    """A wide thing of any convex outline, its flanks straight, leaning out or leaning in."""
    outline = _convex(rng)
    width = rng.uniform(*_WIDTH)
    outline *= width / _narrowest(outline)
    height = width * rng.uniform(0.5, 1.6)
    foot, top = rng.uniform(0.75, 1.0, 2)
    rings = [at_height(outline * scale, z) for scale, z in ((foot, 0.0), (1.0, height * 0.5), (top, height))]
    return [solid([loft(rings)], any_colour(rng))]


def _boulder(rng: np.random.Generator) -> list[Body]:
    """A wide ball with dents and bumps, cut off below."""
    waves, phases = rng.standard_normal((6, 3)) * 1.6, rng.uniform(0, 2 * np.pi, 6)
    rough, stretch = rng.uniform(0.0, 0.12), rng.uniform(0.8, 1.3, 3)
    size = rng.uniform(*_WIDTH) / 2 / stretch[:2].min()

    def radius(directions: Array) -> Array:
        field = 1.0 + rough * np.cos(directions @ waves.T + phases).sum(axis=1) / 2.0
        return np.asarray(size * np.clip(field, 0.6, 1.3) / np.linalg.norm(directions / stretch, axis=1))

    return [solid(blob(radius, size * rng.uniform(0.5, 0.9)), any_colour(rng))]


def _jack(rng: np.random.Generator) -> list[Body]:
    """Three to seven arms, straight or tapered, from one middle."""
    core = rng.uniform(0.008, 0.02)
    arms = []
    for _ in range(int(rng.integers(3, 8))):
        direction = any_direction(rng)
        thick = rng.uniform(0.004, 0.014)
        arms.append(
            rod((0, 0, 0), (direction * rng.uniform(0.025, 0.065)).tolist(), (thick, thick * rng.uniform(0.3, 1.2)), 8)
        )
    return [solid([ball(core)], any_colour(rng)), solid(arms, any_colour(rng))]


def _totem(rng: np.random.Generator) -> list[Body]:
    """Two to four frusta of different outlines and widths, one upon another and not quite above each other."""
    parts, base, widest = [], 0.0, 0.06
    for _ in range(int(rng.integers(2, 5))):
        outline = _convex(rng) * rng.uniform(0.012, widest) + rng.uniform(-0.006, 0.006, 2)
        height, top = rng.uniform(0.01, 0.045), rng.uniform(0.5, 1.0)
        parts.append(loft([at_height(outline, base), at_height(outline * top, base + height)]))
        base += height - 0.001
        widest = max(0.02, widest * rng.uniform(0.5, 1.1))
    return [solid([part], any_colour(rng)) for part in parts]


def _gutter(rng: np.random.Generator) -> list[Body]:
    """A bent plate, its hollow below."""
    radius, thick, half = rng.uniform(0.02, 0.055), rng.uniform(0.003, 0.008), rng.uniform(0.5, 1.5)
    ends = rng.uniform(0.02, 0.055) * np.array([-1.0, 1.0, 1.0, -1.0])
    radii = np.array([radius, radius, radius + thick, radius + thick])
    sections = [
        np.column_stack([ends, radii * np.sin(angle), radii * np.cos(angle)]) for angle in np.linspace(-half, half, 13)
    ]
    return [solid([loft(pair) for pair in pairwise(sections)], any_colour(rng))]


def _lobed(rng: np.random.Generator, size: float, rough: float) -> Array:
    """An outline (24, 2) around the origin, counter-clockwise, of mean radius `size`, stretched and lobed."""
    angles = 2 * np.pi * np.arange(24) / 24
    numbers, phases = np.arange(2, 6), rng.uniform(0, 2 * np.pi, 4)
    waves = (rng.standard_normal(4) * rough / np.sqrt(numbers / 2)) @ np.cos(
        numbers[:, None] * angles + phases[:, None]
    )
    radii = size * np.clip(1.0 + waves, 0.4, 1.8)
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles) * rng.uniform(0.5, 1.0)])


def _convex(rng: np.random.Generator) -> Array:
    """A convex outline (K, 2) around the origin, counter-clockwise, its corners on an oval of half width 1."""
    angles = np.sort(2 * np.pi * (np.arange(12) + rng.uniform(0.0, 0.9, 12)) / 12)
    kept = angles[np.sort(rng.choice(12, int(rng.integers(4, 13)), replace=False))]
    if np.diff([*kept, kept[0] + 2 * np.pi]).max() > 2.6:  # else the origin is outside, or nearly
        kept = angles[::3]
    return np.column_stack([np.cos(kept), np.sin(kept) * rng.uniform(0.6, 1.0)])


def _narrowest(outline: Array) -> float:
    angles = np.linspace(0.0, np.pi, 180, endpoint=False)
    return float(np.ptp(outline @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min())


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "boulder": _boulder,
    "frame": _frame,
    "gutter": _gutter,
    "jack": _jack,
    "slab": _slab,
    "step": _step,
    "strip": _strip,
    "totem": _totem,
    "trunk": _trunk,
}
