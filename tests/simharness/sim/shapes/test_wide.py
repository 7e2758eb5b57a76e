"""Wide things are as wide as they say."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.scene import SCALE_RANGES
from simharness.sim.shapes import wide
from simharness.sim.solids import GeneratedObject
from tesnet.geometry import PANDA
from tests.simharness.sim.meshes import corners_of, parts_of


@pytest.mark.parametrize("scales", SCALE_RANGES.values(), ids=SCALE_RANGES)
def test_wide_things_are_72_to_97_percent_of_the_opening_where_they_are_narrowest(
    scales: tuple[float, float], made: dict[str, list[GeneratedObject]]
) -> None:
    factors = np.array(scales) / np.mean(scales)
    angles = np.deg2rad(np.arange(0, 180, 2))
    turns = np.stack([np.cos(angles), np.sin(angles)])
    for generated in made["wide"]:
        corners = corners_of(parts_of(generated))
        across = np.ptp(corners[:, :2] @ turns, axis=0).min()
        narrowest = min(across, np.ptp(corners[:, 2]))
        # The section's corners stand for a circle, whose facets may lie closer by half a percent.
        assert narrowest * factors[0] >= wide.NARROWEST * 0.995, generated.name
        assert narrowest * factors[1] <= wide.WIDEST * 1.001, generated.name
    assert pytest.approx(0.72 * PANDA.max_width) == wide.NARROWEST
