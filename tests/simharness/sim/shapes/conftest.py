"""Every made shape, made once."""

from __future__ import annotations

import pytest

from simharness.sim.shapes.sets import SETS
from simharness.sim.solids import GeneratedObject


@pytest.fixture(scope="session")
def made() -> dict[str, list[GeneratedObject]]:
    return {name: [shapes.make(shape) for shape in shapes.names()] for name, shapes in SETS.items()}
