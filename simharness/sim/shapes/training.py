"""Families to train with, wider than household things: `shapes-train`.

No family here may appear in the validation sets beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from simharness.sim.shapes.elements import any_direction, blob, rod, tube, turned
from simharness.sim.solids import (
    Array,
    Body,
    any_colour,
    any_grey,
    block,
    hollow,
    oval,
    solid,
    stack,
)
from tesnet.geometry import PANDA

VERSION = 1

_WIDEST = 0.98 * PANDA.max_width


def _superquadric(rng: np.random.Generator) -> list[Body]:
    """|x/a|^p + |y/b|^p and the like over height, flattened above and below."""
    across, along = rng.uniform(1.0, 4.0), rng.uniform(1.2, 5.0)
    x, y, half = rng.uniform(0.012, 0.036), rng.uniform(0.015, 0.045), rng.uniform(0.012, 0.06)
    heights = half * np.sin(np.linspace(-0.85, 0.9, 9) * np.pi / 2)
    profile = [((1 - abs(z / half) ** along) ** (1 / along), z) for z in heights]
    return [stack(oval(x, y, across), profile, any_colour(rng))]


def _field(rng: np.random.Generator) -> list[Body]:
    """A ball whose radius is a random smooth field over its directions."""
    size, rough = rng.uniform(0.018, 0.036), rng.uniform(0.1, 0.4)
    return [solid(blob(_random_radius(rng, size, rough), size * rng.uniform(0.5, 0.9)), any_colour(rng))]


def _sum(rng: np.random.Generator) -> list[Body]:
    """The sum of two to four bumps on a stretched ball and of a random field."""
    size = rng.uniform(0.014, 0.026)
    stretch = rng.uniform(0.7, 1.5, 3)
    bumps = [
        (any_direction(rng), rng.uniform(0.4, 1.1) * size, rng.uniform(3.0, 9.0))
        for _ in range(int(rng.integers(2, 5)))
    ]
    field = _random_radius(rng, size, rng.uniform(0.0, 0.2))

    def radius(directions: Array) -> Array:
        total = field(directions) / np.linalg.norm(directions / stretch, axis=1)
        for direction, height, narrow in bumps:
            total = total + height * np.exp(narrow * (directions @ direction - 1.0))
        return np.asarray(total)

    return [solid(blob(radius, size * rng.uniform(0.5, 0.9)), any_colour(rng))]


def _plate(rng: np.random.Generator) -> list[Body]:
    x, y, thick = rng.uniform(0.025, 0.075), rng.uniform(0.05, 0.11), rng.uniform(0.004, 0.014)
    return [solid([block((x, y, thick), (0, 0), 0, min(0.0015, thick / 4))], any_colour(rng))]


def _card(rng: np.random.Generator) -> list[Body]:
    x, y, thick = rng.uniform(0.03, 0.055), rng.uniform(0.05, 0.09), rng.uniform(0.002, 0.004)
    return [solid([block((x, y, thick), (0, 0), 0, 0.0004)], any_colour(rng))]


def _pen(rng: np.random.Generator) -> list[Body]:
    """Lies on its side."""
    radius, length = rng.uniform(0.004, 0.01), rng.uniform(0.08, 0.15)
    corners = int(rng.choice([6, 8, 12]))
    body = turned(rod((-length / 2, 0, radius), (length / 2, 0, radius), (radius, radius), corners), 0.0)
    tip = rod((length / 2, 0, radius), (length / 2 + radius * 2, 0, radius * 0.9), (radius, radius * 0.2), corners)
    return [solid([body, tip], any_colour(rng))]


def _ring(rng: np.random.Generator) -> list[Body]:
    radius, thick = rng.uniform(0.018, 0.04), rng.uniform(0.004, 0.01)
    if rng.uniform() < 0.5:
        wall = rng.uniform(0.004, min(0.014, radius * 0.6))
        return [hollow([(radius, 0), (radius, 2 * thick)], wall, None, any_grey(rng))]
    angles = 2 * np.pi * np.arange(24) / 24
    path = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(24, thick)])
    return [solid(tube(path, np.full(24, thick), closed=True), any_colour(rng))]


def _bowl(rng: np.random.Generator) -> list[Body]:
    rim, height = rng.uniform(0.028, 0.06), rng.uniform(0.015, 0.05)
    base = rim * rng.uniform(0.35, 0.75)
    bend = rng.uniform(0.5, 2.0)
    profile = [(base + (rim - base) * t**bend, height * (0.15 + 0.85 * t)) for t in (0.3, 0.65, 1.0)]
    return [hollow([(base, 0), *profile], rng.uniform(0.003, 0.006), height * 0.12, any_colour(rng))]


def _handle(rng: np.random.Generator) -> list[Body]:
    """A bent bar that stands on a base."""
    x, y, thick = rng.uniform(0.05, 0.08), rng.uniform(0.025, 0.06), rng.uniform(0.006, 0.03)
    base = block((x, y, thick), (0, 0), 0)
    reach, radius = x * rng.uniform(0.3, 0.42), rng.uniform(0.004, 0.008)
    rise = min(rng.uniform(0.02, 0.045), reach**2 / (1.5 * radius))  # bent no closer than the bar is thick
    angles = np.linspace(0.08, np.pi - 0.08, 9)  # a tube may be vertical nowhere
    path = np.column_stack([reach * np.cos(angles), np.zeros(9), thick - radius / 2 + rise * np.sin(angles)])
    turn = rng.uniform(0, np.pi)
    return [
        solid([base], any_colour(rng)),
        solid([turned(part, turn) for part in tube(path, np.full(9, radius))], any_colour(rng)),
    ]


def _box(rng: np.random.Generator) -> list[Body]:
    """Of any width that fits into the hand when it is not scaled up."""
    width = rng.uniform(0.02, _WIDEST)
    y, z = rng.uniform(0.6, 1.6) * width, rng.uniform(0.4, 2.0) * width
    return [solid([block((width, min(y, 0.11), min(z, 0.14)), (0, 0), 0)], any_colour(rng))]


def _cylinder(rng: np.random.Generator) -> list[Body]:
    """Of any width that fits into the hand when it is not scaled up."""
    radius, height, edge = rng.uniform(0.01, _WIDEST / 2), rng.uniform(0.02, 0.13), 0.0015
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [stack(oval(), profile, any_colour(rng))]


def _assembly(rng: np.random.Generator) -> list[Body]:
    """Blocks and bars joined to a block, none of them convex together."""
    core = rng.uniform(0.015, 0.04, 3)
    bodies = [solid([block((core[0], core[1], core[2]), (0, 0), 0)], any_colour(rng))]
    for _ in range(int(rng.integers(1, 5))):
        angle = rng.uniform(0, 2 * np.pi)
        base = rng.uniform(0, core[2] * 0.7)
        if rng.uniform() < 0.5:
            length, wide, high = rng.uniform(0.02, 0.06), rng.uniform(0.008, 0.025), rng.uniform(0.008, 0.03)
            part = turned(block((length, wide, high), (length / 2, 0), base), angle)
        else:
            length, radius = rng.uniform(0.02, 0.06), rng.uniform(0.004, 0.012)
            part = turned(
                rod((0, 0, base + radius), (length, 0, base + radius + rng.uniform(0, 0.04)), (radius, radius)), angle
            )
        bodies.append(solid([part], any_colour(rng)))
    return bodies


def _random_radius(rng: np.random.Generator, size: float, rough: float) -> Callable[[Array], Array]:
    """A field over directions: waves of random direction and phase, of mean `size` and deviation `rough` of it."""
    waves = rng.standard_normal((8, 3)) * 2.2
    phases = rng.uniform(0, 2 * np.pi, 8)

    def radius(directions: Array) -> Array:
        total = np.cos(directions @ waves.T + phases).sum(axis=1) / 2.0
        return np.asarray(size * np.clip(1.0 + rough * total, 0.4, 1.9))

    return radius


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "assembly": _assembly,
    "bowl": _bowl,
    "box": _box,
    "card": _card,
    "cylinder": _cylinder,
    "field": _field,
    "handle": _handle,
    "pen": _pen,
    "plate": _plate,
    "ring": _ring,
    "sum": _sum,
    "superquadric": _superquadric,
}
