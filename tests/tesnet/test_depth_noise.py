"""The noise of a plane is measured as it was made, at every distance, whatever stands on the plane."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tesnet.depth_noise import NEAR, DepthNoise

Array = NDArray[np.float64]
EYE = np.array([[0.0, -0.6, 0.7]])


def seen(base: float, growth: float, count: int = 40_000, off: float = 0.0) -> tuple[Array, Array]:
    """Points (count, 3) of a plane of 3 m and their heights (count,) over where it is said to be, `off` beside it."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), np.zeros(count)])
    sd = base + growth * np.linalg.norm(points - EYE[0], axis=1)
    points[:, 2] = off + sd * rng.standard_normal(count)
    return points, points[:, 2]


@pytest.mark.parametrize(("base", "growth"), [(0.0008, 0.0), (0.0, 0.001), (0.0005, 0.002), (0.003, 0.0)])
@pytest.mark.parametrize("things", [0.0, 0.4])
def test_it_is_what_was_made_at_every_distance(base: float, growth: float, things: float) -> None:
    """Things on 40 % of the plane and more noise than that of a normal distribution change little."""
    points, over = seen(base, growth)
    rng = np.random.default_rng(1)
    raised = rng.random(len(points)) < things
    over = np.where(raised, rng.uniform(0.0, NEAR, len(over)), over)
    noise = DepthNoise.of(points, over, EYE)
    assert noise is not None
    distances = np.array([0.8, 1.2, 1.8])
    places = EYE[0] + distances[:, None] * np.array([[0.0, 0.6, -0.8]])
    np.testing.assert_allclose(noise.at(places), base + growth * distances, rtol=0.12 if things else 0.06)


def test_a_plane_that_is_taken_to_be_too_high_looks_little_noisier() -> None:
    noise = DepthNoise.of(*seen(0.001, 0.0, off=-0.005), EYE)
    assert noise is not None
    assert float(noise.at(np.zeros((1, 3)))[0]) == pytest.approx(0.001, rel=0.1)


def test_things_alone_are_no_plane() -> None:
    points, over = seen(0.001, 0.0)
    assert DepthNoise.of(points, np.abs(over), EYE) is None
    assert DepthNoise.of(points[:10], over[:10], EYE) is None


def test_nearer_than_where_noise_begins_there_is_none() -> None:
    noise = DepthNoise(EYE, -0.001, 0.002)
    places = EYE[0] + np.array([0.0, 0.4, 0.5, 0.6, 1.0])[:, None] * np.array([0.0, 0.6, -0.8])
    np.testing.assert_allclose(noise.at(places), [0.0, 0.0, 0.0, 0.0002, 0.001], atol=1e-12)


def test_of_several_viewpoints_the_nearest_counts() -> None:
    noise = DepthNoise(np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0]]), 0.0, 0.001)
    np.testing.assert_allclose(noise.at(np.array([[0.0, 0, 0], [3.0, 0, 0], [3.0, 0, 3.0]])), [0.001, 0.001, 0.002])
