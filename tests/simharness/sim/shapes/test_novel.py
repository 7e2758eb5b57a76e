"""Novel shapes are of families that nobody trained with, and their parts are where their names say."""

from __future__ import annotations

import numpy as np

from simharness.sim import procedural
from simharness.sim.shapes.sets import SETS
from simharness.sim.solids import GeneratedObject
from tesnet.geometry import PANDA
from tests.simharness.sim.meshes import corners_of, parts_of

VALIDATION = ("flat", "novel", "wide")


def test_validation_families_are_in_no_training_set() -> None:
    made = (SETS[name].families for name in SETS if name.endswith("-train"))
    trained = set(procedural.FAMILIES).union(*made)
    for name in VALIDATION:
        assert not trained & set(SETS[name].families)
    novel = SETS["novel"]
    assert len(novel.families) >= 5
    assert len(novel.names()) >= 100
    everything = [name for shapes in SETS.values() for name in shapes.names()]
    assert len(set(everything)) == len(everything)


def test_most_novel_shapes_are_wider_than_the_hand_and_none_leaves_the_workspace(
    made: dict[str, list[GeneratedObject]],
) -> None:
    extents = np.array([np.sort(np.ptp(corners_of(parts_of(generated)), axis=0)) for generated in made["novel"]])
    assert np.mean(extents[:, 1] > PANDA.max_width) > 0.8
    assert extents[:, 2].max() < 0.18


def test_a_spool_is_narrow_between_its_flanges(made: dict[str, list[GeneratedObject]]) -> None:
    for generated in made["novel"]:
        if "/spool_" not in generated.name:
            continue
        corners = corners_of(parts_of(generated))
        levels = np.unique(corners[:, 2].round(6))
        across = [
            np.linalg.norm(corners[np.isclose(corners[:, 2], level, atol=1e-5), :2], axis=1).max() for level in levels
        ]
        assert min(across) < 0.75 * PANDA.max_width / 2 < min(across[0], across[-1])
