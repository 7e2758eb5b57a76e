"""Household-like objects made from a seed: what `procedural` and `procedural-train` hold.

Knows neither files nor physics: it returns the bytes of a URDF and its meshes, the same bytes for the same seed.

An object stands stably upright on its lowest face with +z up. Sizes are those of the real things; scenes scale them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from simharness.sim.solids import (
    METAL,
    Body,
    GeneratedObject,
    any_colour,
    any_grey,
    at_height,
    block,
    centred,
    chain,
    chamfered,
    hollow,
    loft,
    oval,
    solid,
    stack,
)

Split = Literal["test", "train"]

#: Objects of each family in a split.
OBJECTS_PER_FAMILY: dict[Split, int] = {"test": 2, "train": 10}

_SPLIT_SEEDS: dict[str, int] = {"test": 1, "train": 2}


def object_names(split: Split) -> tuple[str, ...]:
    """Names of a split's objects, `procedural/<split>/<family>_<number>`, sorted."""
    numbers = range(OBJECTS_PER_FAMILY[split])
    return tuple(f"procedural/{split}/{family}_{number:02d}" for family in sorted(FAMILIES) for number in numbers)


def generate_object(name: str) -> GeneratedObject:
    """The object of that name (one of `object_names`); the name is its seed, so no two splits share an object."""
    _, split, last = name.split("/")
    family, _, number = last.rpartition("_")
    rng = np.random.default_rng([_SPLIT_SEEDS[split], int(number), *family.encode()])
    return centred(name, FAMILIES[family](rng))


def _box(rng: np.random.Generator) -> list[Body]:
    thin, wide, tall = rng.uniform(0.028, 0.065), rng.uniform(0.04, 0.09), rng.uniform(0.04, 0.17)
    return [solid([block((thin, max(thin, wide), tall), (0, 0), 0)], any_colour(rng))]


def _cylinder(rng: np.random.Generator) -> list[Body]:
    radius, height, edge = rng.uniform(0.016, 0.034), rng.uniform(0.05, 0.13), 0.0015
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [stack(oval(), profile, any_colour(rng))]


def _can(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.025, 0.035), rng.uniform(0.06, 0.14)
    neck = radius * rng.uniform(0.85, 0.95)
    profile = [(neck, 0), (radius, 0.007), (radius, height - 0.01), (neck, height - 0.002)]
    rim = [(neck, height - 0.0025), (neck, height)]
    return [stack(oval(), profile, any_colour(rng)), stack(oval(), rim, any_grey(rng))]


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
    return [stack(oval(), profile, any_colour(rng)), stack(oval(), cap, any_colour(rng))]


def _dispenser(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.018, 0.028), rng.uniform(0.03, 0.042), rng.uniform(0.09, 0.14)
    profile = [(0.93, 0), (1.0, 0.006), (1.0, height * 0.75), (0.85, height * 0.92), (0.5, height)]
    neck = rng.uniform(0.008, 0.012)
    rise = height + rng.uniform(0.02, 0.035)
    colour = any_colour(rng)
    stem = stack(oval(), [(neck, height - 0.002), (neck, rise)], colour)
    reach = rng.uniform(0.03, 0.045)
    spout = solid([block((0.016, reach, 0.011), (0, reach / 2 - 0.01), rise - 0.001)], colour)
    return [
        stack(oval(x, y, rng.uniform(2.0, 3.5)), profile, any_colour(rng)),
        replace(stem, shells=stem.shells + spout.shells, parts=stem.parts + spout.parts),
    ]


def _jar(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.024, 0.035), rng.uniform(0.05, 0.11)
    neck, lid = radius * rng.uniform(0.8, 0.92), rng.uniform(0.01, 0.018)
    profile = [(radius * 0.93, 0), (radius, 0.005), (radius, height * 0.8), (neck, height)]
    cap = [(neck * 1.06, height - 0.001), (neck * 1.06, height + lid - 0.002), (neck, height + lid)]
    return [stack(oval(), profile, any_colour(rng)), stack(oval(), cap, any_colour(rng))]


def _cup(rng: np.random.Generator) -> list[Body]:
    rim, height = rng.uniform(0.032, 0.042), rng.uniform(0.07, 0.12)
    base = rim * rng.uniform(0.65, 0.9)
    return [hollow([(base, 0), (rim, height)], rng.uniform(0.003, 0.0045), 0.005, any_colour(rng))]


def _mug(rng: np.random.Generator) -> list[Body]:
    radius, height, wall = rng.uniform(0.032, 0.04), rng.uniform(0.075, 0.105), rng.uniform(0.0035, 0.005)
    body = hollow([(radius * 0.97, 0), (radius, 0.012), (radius, height)], wall, 0.006, any_colour(rng))
    out, up = rng.uniform(0.024, 0.034), height * rng.uniform(0.26, 0.34)
    thick, wide = rng.uniform(0.007, 0.01), rng.uniform(0.01, 0.015)
    rings = []
    for angle in np.linspace(-np.pi / 2, np.pi / 2, 9):
        point = np.array([radius - wall / 2 + out * np.cos(angle), 0.0, height / 2 + up * np.sin(angle)])
        normal = np.array([np.cos(angle) / out, 0.0, np.sin(angle) / up])
        normal *= thick / 2 / np.linalg.norm(normal)
        side = np.array([0.0, wide / 2, 0.0])
        rings.append(point + np.stack([-normal - side, normal - side, normal + side, -normal + side]))
    return [body, chain(rings, body.colour)]


def _bowl(rng: np.random.Generator) -> list[Body]:
    rim, height = rng.uniform(0.045, 0.062), rng.uniform(0.035, 0.06)
    base = rim * rng.uniform(0.45, 0.6)
    profile = [(base + (rim - base) * np.sin(t * np.pi / 2), height * (0.12 + 0.88 * t)) for t in (0.25, 0.55, 1.0)]
    return [hollow([(base, 0), *profile], rng.uniform(0.0035, 0.005), 0.006, any_colour(rng))]


def _tube(rng: np.random.Generator) -> list[Body]:
    radius, height = rng.uniform(0.018, 0.035), rng.uniform(0.05, 0.14)
    return [hollow([(radius, 0), (radius, height)], rng.uniform(0.003, 0.006), None, any_colour(rng))]


def _carton(rng: np.random.Generator) -> list[Body]:
    x, y, body = rng.uniform(0.04, 0.065), rng.uniform(0.04, 0.07), rng.uniform(0.07, 0.13)
    roof, fin = rng.uniform(0.02, 0.032), rng.uniform(0.01, 0.016)
    edge, ridge = 0.001, 0.004
    lower, upper = chamfered(x, y, edge), chamfered(ridge, y, edge)
    shape = loft([at_height(lower, 0), at_height(lower, body), at_height(upper, body + roof)])
    top = block((ridge, y, fin), (0, 0), body + roof - 0.001, 0.0005)
    return [solid([shape], any_colour(rng)), solid([top], any_grey(rng))]


def _fruit(rng: np.random.Generator) -> list[Body]:
    radius = rng.uniform(0.022, 0.037)
    tall, pear = radius * rng.uniform(0.85, 1.25), rng.choice([0.0, rng.uniform(0.1, 0.3)])
    angles = np.linspace(-np.pi / 2 * 0.68, np.pi / 2 * 0.94, 14)
    profile = [(radius * np.cos(a) * (1 - pear * (1 + np.sin(a)) / 2), tall * (1 + pear) * np.sin(a)) for a in angles]
    return [stack(oval(), profile, any_colour(rng))]


def _wedge(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.03, 0.06), rng.uniform(0.04, 0.08), rng.uniform(0.035, 0.08)
    edge, top = 0.001, rng.uniform(0.15, 0.5)
    lean = rng.uniform(-1, 1) * x * (1 - top) / 2
    lower, upper = chamfered(x, y, edge), chamfered(x * top, y * rng.uniform(0.7, 1.0), edge) + np.array([lean, 0.0])
    return [solid([loft([at_height(lower, 0), at_height(upper, height)])], any_colour(rng))]


def _prism(rng: np.random.Generator) -> list[Body]:
    sides, radius, height = int(rng.choice([3, 5, 6, 8])), rng.uniform(0.02, 0.036), rng.uniform(0.04, 0.14)
    angles = 2 * np.pi * np.arange(sides) / sides
    section = np.column_stack([np.cos(angles), np.sin(angles)])
    edge = 0.0015
    profile = [(radius - edge, 0), (radius, edge), (radius, height - edge), (radius - edge, height)]
    return [stack(section, profile, any_colour(rng))]


def _soap(rng: np.random.Generator) -> list[Body]:
    x, y, height = rng.uniform(0.02, 0.032), rng.uniform(0.03, 0.048), rng.uniform(0.03, 0.045)
    profile = [(0.8, 0), (0.94, height * 0.15), (1.0, height * 0.45), (0.94, height * 0.8), (0.75, height)]
    return [stack(oval(x, y, rng.uniform(2.0, 4.0)), profile, any_colour(rng))]


def _l_shape(rng: np.random.Generator) -> list[Body]:
    thick, long, short = rng.uniform(0.018, 0.03), rng.uniform(0.06, 0.1), rng.uniform(0.045, 0.07)
    depth = rng.uniform(0.03, 0.055)
    if rng.uniform() < 0.5:  # lying: the letter seen from above
        parts = [
            block((long, thick, depth), (0, 0), 0),
            block((thick, short - thick / 2, depth), ((thick - long) / 2, short / 2 - thick / 4), 0),
        ]
    else:  # standing on its foot
        parts = [
            block((short, depth, thick), (0, 0), 0),
            block((thick, depth, long - thick / 2), ((thick - short) / 2, 0), thick / 2),
        ]
    return [solid(parts, any_colour(rng))]


def _t_shape(rng: np.random.Generator) -> list[Body]:
    thick, bar, stem = rng.uniform(0.018, 0.028), rng.uniform(0.055, 0.09), rng.uniform(0.05, 0.09)
    depth = rng.uniform(0.03, 0.05)
    if rng.uniform() < 0.5:  # lying: the letter seen from above
        parts = [
            block((bar, thick, depth), (0, 0), 0),
            block((thick, stem, depth), (0, (stem - thick) / 2), 0),
        ]
    else:  # upside down
        parts = [block((bar, depth, thick), (0, 0), 0), block((thick, depth, stem), (0, 0), thick / 2)]
    return [solid(parts, any_colour(rng))]


def _hammer(rng: np.random.Generator) -> list[Body]:
    """Stands on the side of its head, the handle up."""
    wide, high, long = rng.uniform(0.03, 0.038), rng.uniform(0.026, 0.034), rng.uniform(0.075, 0.1)
    head = block((long * 0.6, wide, high), (0, 0), 0)
    nose = block((long * 0.22, wide * 0.9, high), (long * 0.4, 0), 0)
    tip = np.array([[-long * 0.28, 0.0], [-long * 0.62, 0.0]])
    claw = loft(
        [
            np.array([[x, -h, 0.0], [x, h, 0.0], [x, h, high], [x, -h, high]])
            for (x, _), h in zip(tip, (wide * 0.42, wide * 0.12), strict=True)
        ]
    )
    handle = stack(
        oval(rng.uniform(0.012, 0.015), rng.uniform(0.009, 0.012)),
        [(0.8, high - 0.003), (0.8, high + 0.03), (1.0, high + 0.06), (1.0, high + rng.uniform(0.09, 0.13))],
        any_colour(rng),
    )
    return [solid([head, nose, claw], any_grey(rng), METAL), handle]


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
    return [stack(oval(), profile, any_colour(rng)), stack(oval(), steel, any_grey(rng))]


def _wrench(rng: np.random.Generator) -> list[Body]:
    """Lies flat: a bar, an open jaw at one end and a ring at the other."""
    thick, wide, long = rng.uniform(0.02, 0.026), rng.uniform(0.016, 0.024), rng.uniform(0.08, 0.11)
    jaw = wide * rng.uniform(1.5, 1.8)
    prong, reach = jaw * 0.3, jaw * 0.75
    end = long / 2
    parts = [
        block((long, wide, thick), (0, 0), 0),
        block((jaw * 0.5, jaw, thick), (end, 0), 0),
        block((reach, prong, thick), (end + reach / 2, (jaw - prong) / 2), 0),
        block((reach, prong, thick), (end + reach / 2, -(jaw - prong) / 2), 0),
    ]
    colour = any_grey(rng)
    radius = wide * rng.uniform(0.75, 0.95)
    ring = hollow([(radius, 0), (radius, thick)], radius * 0.45, None, colour)
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
