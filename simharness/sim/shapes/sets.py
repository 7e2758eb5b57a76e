"""The sets of made shapes by name.

A shape's name is its set, the set's version, its family and its seed: `novel-1/knot_07`. Whoever changes what a name
gives raises the version, since labels and rates are useless without their objects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from simharness.sim.shapes import extremes, flat, novel, slopes, training, wide
from simharness.sim.solids import Body, GeneratedObject, centred


@dataclass(frozen=True, slots=True)
class MadeSet:
    """A set of shapes.

    Args:
        name: what users call it.
        version: of the program that makes its shapes.
        families: shapes from a generator of random numbers.
        shapes: of each family.
        sized: whether its sizes are those on the table, so that a scene's scale only varies them around its middle.
    """

    name: str
    version: int
    families: Mapping[str, Callable[[np.random.Generator], list[Body]]]
    shapes: int
    sized: bool = False

    def names(self) -> tuple[str, ...]:
        """Names of its shapes, sorted."""
        numbers = range(self.shapes)
        return tuple(
            f"{self.name}-{self.version}/{family}_{number:02d}"
            for family in sorted(self.families)
            for number in numbers
        )

    def make(self, name: str) -> GeneratedObject:
        """The shape of one of `names`; the name is its seed."""
        family, _, number = name.rpartition("/")[2].rpartition("_")
        rng = np.random.default_rng([int(number), *name.rpartition("/")[0].encode(), *family.encode()])
        return centred(name, self.families[family](rng))


SETS: Mapping[str, MadeSet] = {
    made.name: made
    for made in (
        MadeSet("shapes-train", training.VERSION, training.FAMILIES, 40),
        MadeSet("extremes-train", extremes.VERSION, extremes.FAMILIES, 40, sized=True),
        MadeSet("slopes-train", slopes.VERSION, slopes.FAMILIES, 60),
        MadeSet("novel", novel.VERSION, novel.FAMILIES, 21),
        MadeSet("flat", flat.VERSION, flat.FAMILIES, 10, sized=True),
        MadeSet("wide", wide.VERSION, wide.FAMILIES, 10, sized=True),
    )
}
