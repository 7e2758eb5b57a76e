"""Breaks and random fields."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from simharness.sim.sensors.images import breaks, correlated_normal, interpolated_normal

Array = npt.NDArray[np.float64]


def test_a_step_is_a_break_on_both_sides_and_a_tilted_plane_is_none(block: Array, plane: Callable[..., Array]) -> None:
    found = breaks(block, block > 0, 0.015)
    row = found[240]
    assert np.flatnonzero(row).tolist() == [259, 260, 379, 380]
    steep = plane(0.7, 60.0)
    assert np.abs(np.diff(steep, axis=0)).max() > 0.015
    assert not breaks(steep, steep > 0, 0.015).any()


def test_the_border_of_what_is_seen_is_no_break(block: Array) -> None:
    hole = block.copy()
    hole[:, 100:110] = 0.0
    assert not breaks(hole, hole > 0, 0.015)[:, 90:120].any()


@pytest.mark.parametrize("window", [4.0, 9.0])
def test_a_correlated_field_has_unit_deviation_and_the_windows_reach(window: float) -> None:
    field = correlated_normal((480, 640), window, np.random.default_rng(0))
    assert field.std() == pytest.approx(1.0, abs=0.05)
    assert abs(field.mean()) < 0.05

    def alike(pixels: int) -> float:
        return float((field[:, :-pixels] * field[:, pixels:]).mean())

    assert alike(1) > 0.5
    assert abs(alike(round(2 * window))) < 0.05


def test_an_interpolated_field_meets_the_image_and_keeps_most_of_its_deviation() -> None:
    field = interpolated_normal((480, 640), (120, 160), 0.005, np.random.default_rng(0))
    assert field.shape == (480, 640)
    assert field.std() == pytest.approx(0.0044, rel=0.03)


def test_a_correlated_field_is_as_strong_at_the_border_and_goes_on_at_the_other_one() -> None:
    fields = np.stack([correlated_normal((12, 16), 4.0, np.random.default_rng(seed)) for seed in range(2000)])
    assert fields.std(axis=0) == pytest.approx(np.ones((12, 16)), abs=0.08)
    beside = (fields[:, :, 0] * fields[:, :, 1]).mean()
    assert beside > 0.5
    assert (fields[:, :, 0] * fields[:, :, -1]).mean() == pytest.approx(beside, abs=0.05)
    assert (fields[:, 0] * fields[:, -1]).mean() == pytest.approx(beside, abs=0.05)
