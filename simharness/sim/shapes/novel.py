"""Families that no training scene holds: `novel`. Odd enough to be hard; each can be grasped somewhere.

Each stands on a face, on its troughs or on three legs. Most are wider than the hand and have a place that it reaches
around: a point, a neck, a spike, a crest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from simharness.sim.shapes.elements import ball, rod, star
from simharness.sim.solids import Array, Body, any_colour, loft, oval, solid, stack

VERSION = 1


def _spool(rng: np.random.Generator) -> list[Body]:
    """Two flanges wider than the hand and a neck between them."""
    low, high = rng.uniform(0.046, 0.06, 2)
    neck, gap = rng.uniform(0.016, 0.03), rng.uniform(0.028, 0.038)
    thick, cone = rng.uniform(0.008, 0.016, 2), rng.uniform(0.0, 0.02, 2)
    section = oval() if rng.uniform() < 0.5 else _polygon(int(rng.integers(3, 7)))
    levels = np.cumsum([0.0, thick[0], cone[0] + 0.001, gap, cone[1] + 0.001, thick[1]])
    radii = (low, low, neck, neck, high, high)
    return [stack(section, list(zip(radii, levels.tolist(), strict=True)), any_colour(rng))]


def _polygon(corners: int) -> Array:
    angles = 2 * np.pi * np.arange(corners) / corners
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _star(rng: np.random.Generator) -> list[Body]:
    """A prism or a pyramid over a star."""
    points = int(rng.integers(3, 9))
    outer = rng.uniform(0.055, 0.072)
    inner = outer * rng.uniform(0.55, 0.82)
    angles = np.pi * np.arange(2 * points) / points
    radii = np.where(np.arange(2 * points) % 2 == 0, outer, inner)
    outline = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    height, top = rng.uniform(0.045, 0.075), rng.uniform(0.15, 0.5)
    return [solid(star(outline, [(1.0, 0.0), (top, height)]), any_colour(rng))]


def _spire(rng: np.random.Generator) -> list[Body]:
    """Cones upon cones: tops, obelisks, bicones. Few of its faces are parallel."""
    corners = int(rng.choice([3, 4, 5, 32]))
    widest, tip = rng.uniform(0.042, 0.062), rng.uniform(0.001, 0.006)
    low = rng.uniform(0.015, 0.045)
    high = min((widest - tip) / np.tan(rng.uniform(0.42, 0.62)), 0.1)
    foot = widest * rng.uniform(0.3, 0.75)
    section = oval() if corners == 32 else _polygon(corners)
    profile = [(foot, 0.0), (widest, low), (tip, low + high)]
    if rng.uniform() < 0.4:
        neck = widest * rng.uniform(0.15, 0.3)
        profile = [
            (foot, 0.0),
            (widest, low),
            (neck, low + high * 0.6),
            (neck * 2.2, low + high * 0.8),
            (tip, low + high),
        ]
    return [stack(section, profile, any_colour(rng))]


def _spiky(rng: np.random.Generator) -> list[Body]:
    """A ball with cones, three of which are its legs."""
    radius, spike = rng.uniform(0.03, 0.04), rng.uniform(0.014, 0.028)
    foot, tip = rng.uniform(0.011, 0.017), rng.uniform(0.0015, 0.003)
    legs, others = 2 * np.pi * np.arange(3) / 3, int(rng.integers(8, 16))
    directions = [np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), -0.714]) for angle in legs]
    start = rng.uniform(0, 2 * np.pi)
    for number in range(others):
        z = 0.95 - 1.2 * number / max(others - 1, 1)
        angle = start + number * 2.4
        directions.append(np.array([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z]))
    cones = [rod((d * radius * 0.6).tolist(), (d * (radius + spike)).tolist(), (foot, tip), 8) for d in directions]
    return [solid([ball(radius)], any_colour(rng)), solid(cones, any_colour(rng))]


def _wave(rng: np.random.Generator) -> list[Body]:
    """A corrugated sheet that lies on its troughs."""
    long, wide, thick = rng.uniform(0.09, 0.14), rng.uniform(0.06, 0.1), rng.uniform(0.004, 0.008)
    high, waves = rng.uniform(0.012, 0.026), int(rng.integers(1, 4))
    t = np.linspace(0, 1, 19)  # every trough is one of them
    x, heights = long * (t - 0.5), high * (1 - np.cos(2 * np.pi * waves * t)) / 2
    taper = 1.0 - rng.uniform(0.0, 0.5) * t
    rings = []
    for along, up, share in zip(x, heights, taper, strict=True):
        half = wide * share / 2
        corners = ((-half, up), (half, up), (half, up + thick), (-half, up + thick))
        rings.append(np.array([[along, y, z] for y, z in corners]))
    return [solid([loft(pair) for pair in pairwise(rings)], any_colour(rng))]


FAMILIES: Mapping[str, Callable[[np.random.Generator], list[Body]]] = {
    "spiky": _spiky,
    "spire": _spire,
    "spool": _spool,
    "star": _star,
    "wave": _wave,
}
