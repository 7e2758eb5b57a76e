"""Flat things are as flat as they say."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.scene import SCALE_RANGES
from simharness.sim.shapes import flat
from simharness.sim.solids import GeneratedObject
from tests.simharness.sim.meshes import corners_of, parts_of


@pytest.mark.parametrize("scales", SCALE_RANGES.values(), ids=SCALE_RANGES)
def test_flat_things_are_3_to_12_mm_thick_in_every_scene(
    scales: tuple[float, float], made: dict[str, list[GeneratedObject]]
) -> None:
    factors = np.array(scales) / np.mean(scales)
    thickness = np.array([np.ptp(corners_of(parts_of(generated))[:, 2]) for generated in made["flat"]])
    assert (thickness * factors[0]).min() >= flat.THINNEST
    assert (thickness * factors[1]).max() <= flat.THICKEST
    assert np.ptp(thickness) > 0.006
