from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet.geometry import PANDA, Pose
from tesnet.obstacles import Obstacles
from tests.tesnet.test_collision import ROUNDING, depths, penetration


def scattered(rng: np.random.Generator, points: int, poses: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in a cube of 0.4 m and poses in its middle."""
    cloud = rng.uniform(-0.2, 0.2, (points, 3)).astype(np.float32)
    Ts = np.stack([Pose.random(rng, reach=0.1).matrix for _ in range(poses)])
    return cloud, Ts


def count(cloud: np.ndarray, Ts: np.ndarray, width: float, **options: Any) -> np.ndarray:
    found: np.ndarray = (
        Obstacles.of(torch.from_numpy(cloud))
        .count_in_hands(torch.from_numpy(Ts).float(), PANDA, width, **options)
        .numpy()
    )
    return found


@given(seed=st.integers(0, 2**32 - 1), width=st.sampled_from([0.02, 0.08]))
@settings(max_examples=20, deadline=None)
def test_as_many_points_lie_in_the_hand_as_one_by_one(seed: int, width: float) -> None:
    cloud, Ts = scattered(np.random.default_rng(seed), 3000, 12)
    deep = np.stack([depths(cloud, T, width) for T in Ts])
    found = count(cloud, Ts, width)
    assert (found >= (deep > ROUNDING).sum(axis=1)).all()
    assert (found <= (deep > -ROUNDING).sum(axis=1)).all()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_a_point_on_the_way_counts(seed: int) -> None:
    cloud, Ts = scattered(np.random.default_rng(seed), 150, 12)
    deepest = penetration(cloud, Ts, 0.08, 0.05)
    met = count(cloud, Ts, 0.08, distance=0.05) > 0
    sure = np.abs(deepest) > 0.001  # the twin goes in steps of a millimetre
    np.testing.assert_array_equal(met[sure], deepest[sure] > 0)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_no_point_is_deep_in_the_hand_that_does_not_count_as_deep(seed: int) -> None:
    cloud, Ts = scattered(np.random.default_rng(seed), 3000, 12)
    deep = np.stack([depths(cloud, T, 0.08) for T in Ts])
    found = count(cloud, Ts, 0.08, depth=0.004)
    assert (found >= (deep > 0.004 + ROUNDING).sum(axis=1)).all()
    assert (found <= (deep > 0.003).sum(axis=1)).all()  # depth across a taper is a little less than along an axis


@pytest.mark.parametrize("pairs", [1, 500])
def test_the_size_of_a_block_of_work_changes_nothing(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, Ts = scattered(np.random.default_rng(0), 2000, 9)
    whole = count(cloud, Ts, 0.08)
    assert whole.any()
    monkeypatch.setattr("tesnet.obstacles._PAIRS_AT_ONCE", pairs)
    monkeypatch.setattr("tesnet.obstacles._POSES_AT_ONCE", 2)
    between = Mock()
    found = Obstacles.of(torch.from_numpy(cloud)).count_in_hands(
        torch.from_numpy(Ts).float(), PANDA, 0.08, between=between
    )
    np.testing.assert_array_equal(found.numpy(), whole)
    assert between.call_count > 5


def test_no_points_and_no_hands_are_met_by_nothing() -> None:
    none = torch.zeros(0, 3)
    assert count(none.numpy(), np.eye(4)[None], 0.08).tolist() == [0]
    assert count(np.zeros((1, 3), np.float32), np.zeros((0, 4, 4)), 0.08).tolist() == []
