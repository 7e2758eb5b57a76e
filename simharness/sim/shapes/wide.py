"""Things of 72 to 97 % of the hand's opening where they are narrowest: `wide`. Meant after all scaling."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from simharness.sim.solids import Body, any_colour, block, oval, solid, stack
from tesnet.geometry import PANDA

VERSION = 1

NARROWEST, WIDEST = 0.72 * PANDA.max_width, 0.97 * PANDA.max_width
"""Metres, of what a scene holds in the end."""


def _width(rng: np.random.Generator) -> float:
    """Drawn so that a scene's scale, 0.89 to 1.11 around its middle, keeps it within the set's limits."""
    return float(rng.uniform(NARROWEST / 0.888, WIDEST / 1.112))


def _brick(rng: np.random.Generator) -> list[Body]:
    width = _width(rng)
    return [
        solid(
            [block((width, width * rng.uniform(1.0, 1.5), width * rng.uniform(1.0, 1.6)), (0, 0), 0)], any_colour(rng)
        )
    ]


def _drum(rng: np.random.Generator) -> list[Body]:
    radius, edge = _width(rng) / 2, 0.002
    height = 2 * radius * rng.uniform(1.0, 1.5)
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [stack(oval(), profile, any_colour(rng))]


def _pillow(rng: np.random.Generator) -> list[Body]:
    """A box with round sides, its flanks bulging."""
    half = _width(rng) / 2
    long, height = half * rng.uniform(1.0, 1.4), 2 * half * rng.uniform(1.0, 1.5)
    bulge = rng.uniform(0.86, 0.97)
    profile = [(bulge, 0), (1.0, height * 0.35), (1.0, height * 0.65), (bulge, height)]
    return [stack(oval(half, long, rng.uniform(2.5, 6.0)), profile, any_colour(rng))]


def _nut(rng: np.random.Generator) -> list[Body]:
    """Six or eight sides, as wide across its flats as the set says."""
    sides = int(rng.choice([6, 8]))
    radius = _width(rng) / 2 / np.cos(np.pi / sides)
    height = 2 * radius * rng.uniform(1.0, 1.4)
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    section = np.column_stack([np.cos(angles), np.sin(angles)])
    return [stack(section, [(radius, 0), (radius, height)], any_colour(rng))]


def _keg(rng: np.random.Generator) -> list[Body]:
    """A barrel: widest half-way up."""
    radius = _width(rng) / 2
    height = 2 * radius * rng.uniform(1.05, 1.5)
    waist = rng.uniform(0.72, 0.92)
    t = np.linspace(-1, 1, 9)
    return [stack(oval(), [(radius * (1 - (1 - waist) * x**2), height * (x + 1) / 2) for x in t], any_colour(rng))]


def _globe(rng: np.random.Generator) -> list[Body]:
    """A ball on a small flat foot, stretched by what the foot takes."""
    radius = _width(rng) / 2
    angles = np.linspace(-np.pi / 2 * 0.72, np.pi / 2 * 0.94, 13)
    return [stack(oval(), [(radius * np.cos(a), 1.06 * radius * np.sin(a)) for a in angles], any_colour(rng))]


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "brick": _brick,
    "drum": _drum,
    "globe": _globe,
    "keg": _keg,
    "nut": _nut,
    "pillow": _pillow,
}
