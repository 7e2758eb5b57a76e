"""Things of 3 to 12 mm that lie on a table: `flat`. Thickness is meant after all scaling, for the Panda."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from simharness.sim.shapes.elements import turned
from simharness.sim.solids import Body, Mesh, any_colour, any_grey, at_height, block, hollow, loft, oval, solid, stack

VERSION = 1

THINNEST, THICKEST = 0.003, 0.012
"""Metres, of what a scene holds in the end."""


def _thickness(rng: np.random.Generator) -> float:
    """Drawn so that a scene's scale, 0.89 to 1.11 around its middle, keeps it within the set's limits."""
    return float(rng.uniform(THINNEST / 0.88, THICKEST / 1.12))


def _edge(thick: float) -> float:
    return min(0.001, thick / 4)


def _slab(section: Sequence[Sequence[float]], thick: float) -> Mesh:
    """A convex outline as a slab."""
    outline = np.array(section, dtype=np.float64)
    return loft([at_height(outline, 0.0), at_height(outline, thick)])


def _coin(rng: np.random.Generator) -> list[Body]:
    radius, thick = rng.uniform(0.011, 0.034), _thickness(rng)
    edge = _edge(thick)
    profile = [(radius - edge, 0), (radius, edge), (radius, thick - edge), (radius - edge, thick)]
    return [stack(oval(), profile, any_grey(rng))]


def _washer(rng: np.random.Generator) -> list[Body]:
    radius, thick = rng.uniform(0.014, 0.034), _thickness(rng)
    return [hollow([(radius, 0), (radius, thick)], radius * rng.uniform(0.3, 0.55), None, any_grey(rng))]


def _tile(rng: np.random.Generator) -> list[Body]:
    corners, radius, thick = int(rng.integers(3, 8)), rng.uniform(0.016, 0.036), _thickness(rng)
    angles = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) / corners
    return [
        solid(
            [_slab(np.column_stack([radius * np.cos(angles), radius * np.sin(angles)]).tolist(), thick)],
            any_colour(rng),
        )
    ]


def _key(rng: np.random.Generator) -> list[Body]:
    """A round head, a blade and teeth."""
    head, thick, long = rng.uniform(0.012, 0.02), _thickness(rng), rng.uniform(0.035, 0.06)
    wide = rng.uniform(0.007, 0.012)
    grip = hollow([(head, 0), (head, thick)], head * rng.uniform(0.45, 0.7), None, any_grey(rng))
    blade = block((long, wide, thick), (head + long / 2 - 0.002, 0), 0, _edge(thick))
    teeth = [
        block((0.004, rng.uniform(0.003, 0.009), thick), (head + long * at, wide / 2), 0, _edge(thick))
        for at in (0.5, 0.65, 0.8, 0.93)
    ]
    parts = (blade, *teeth)
    return [Body((*grip.shells, *parts), (*grip.parts, *parts), grip.colour)]


def _comb(rng: np.random.Generator) -> list[Body]:
    count, thick = int(rng.integers(5, 10)), _thickness(rng)
    gap, tooth, long = rng.uniform(0.007, 0.01), rng.uniform(0.003, 0.0045), rng.uniform(0.015, 0.035)
    back = rng.uniform(0.008, 0.016)
    wide = gap * (count - 1) + tooth
    spine = block((wide, back, thick), (0, 0), 0, _edge(thick))
    teeth = [
        block((tooth, long, thick), (gap * (number - (count - 1) / 2), back / 2 + long / 2 - 0.001), 0, _edge(thick))
        for number in range(count)
    ]
    return [solid([spine, *teeth], any_colour(rng))]


def _bracket(rng: np.random.Generator) -> list[Body]:
    """Arms from one point, seen from above an L, a T, a Y or a cross."""
    thick, wide = _thickness(rng), rng.uniform(0.01, 0.02)
    angles = [0.0, *rng.uniform(0.9, 1.8, int(rng.integers(1, 4))).cumsum()]
    arms = []
    for angle in angles:
        long = rng.uniform(0.022, 0.05)
        arms.append(turned(block((long, wide, thick), (long / 2 - wide / 2, 0), 0, _edge(thick)), angle))
    return [solid(arms, any_grey(rng))]


def _blade(rng: np.random.Generator) -> list[Body]:
    """A handle and a pointed blade, thinner than it."""
    thick, wide = _thickness(rng), rng.uniform(0.011, 0.02)
    grip, long = rng.uniform(0.035, 0.055), rng.uniform(0.035, 0.055)
    thin = max(thick * 0.6, 0.003)
    handle = block((grip, wide, thick), (-grip / 2, 0), 0, _edge(thick))
    half = wide * 0.45
    outline = [(-0.002, -half), (long * 0.7, -half), (long, half * 0.5), (long, half), (-0.002, half)]
    return [solid([handle], any_colour(rng)), solid([_slab(outline, thin)], any_grey(rng))]


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "blade": _blade,
    "bracket": _bracket,
    "coin": _coin,
    "comb": _comb,
    "key": _key,
    "tile": _tile,
    "washer": _washer,
}
