"""Training things at the ends of what a hand can do: thin ones are thin, wide ones fit into the hand."""

from __future__ import annotations

import numpy as np

from simharness.sim.solids import GeneratedObject
from tesnet.geometry import PANDA
from tests.simharness.sim.meshes import corners_of, parts_of


def of(family: str, made: dict[str, list[GeneratedObject]]) -> list[np.ndarray]:
    return [corners_of(parts_of(one)) for one in made["extremes-train"] if f"/{family}_" in one.name]


def test_thin_things_are_of_every_thickness_from_3_to_14_mm(made: dict[str, list[GeneratedObject]]) -> None:
    for family in ("frame", "slab", "step", "strip"):
        thick = np.array([np.ptp(corners[:, 2]) for corners in of(family, made)])
        assert 0.0025 <= thick.min() < 0.006
        assert 0.011 < thick.max() <= 0.014


def test_trunks_are_half_to_98_percent_of_the_opening_where_they_are_narrowest(
    made: dict[str, list[GeneratedObject]],
) -> None:
    angles = np.deg2rad(np.arange(180))
    turns = np.stack([np.cos(angles), np.sin(angles)])
    across = np.array([np.ptp(corners[:, :2] @ turns, axis=0).min() for corners in of("trunk", made)])
    assert 0.499 * PANDA.max_width <= across.min() < 0.6 * PANDA.max_width
    assert 0.9 * PANDA.max_width < across.max() <= 0.9801 * PANDA.max_width


def test_no_thing_leaves_the_workspace(made: dict[str, list[GeneratedObject]]) -> None:
    for generated in made["extremes-train"]:
        assert np.ptp(corners_of(parts_of(generated)), axis=0).max() < 0.3, generated.name


def test_every_part_of_a_thing_touches_another(made: dict[str, list[GeneratedObject]]) -> None:
    for family in ("frame", "step", "strip", "totem"):
        for generated in (one for one in made["extremes-train"] if f"/{family}_" in one.name):
            boxes = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in parts_of(generated)])
            low, high = boxes[:, 0], boxes[:, 1]
            meet = np.all((low[:, None] <= high[None] + 1e-6) & (low[None] <= high[:, None] + 1e-6), axis=2)
            reached: set[int] = {0}
            for _ in boxes:
                reached |= set(np.flatnonzero(np.any(meet[sorted(reached)], axis=0)).tolist())
            assert len(reached) == len(boxes), generated.name
