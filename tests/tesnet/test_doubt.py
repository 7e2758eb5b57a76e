"""Hands keep away from what may stand elsewhere: distances by a twin, what is lost by its limits."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from tesnet import cloud
from tesnet.candidates import CandidateConfig, Candidates, generate
from tesnet.doubt import LEAST_DOUBT, LOG_ODDS, MOST_DOUBT, distance_of_fingers, doubted
from tesnet.hands import HANDS
from tests.tesnet.scenes import prepared, tabletop_query

Array = npt.NDArray[np.float64]


def example(hand: str = "franka") -> tuple[cloud.PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=60, gripper=HANDS[hand].gripper)
    ready = prepared(query)
    found = generate(ready, query, CandidateConfig())[0]
    return ready, replace(found, widths=found.widths * torch.linspace(0.6, 1.0, len(found)))


def distance(point: Array, low: Array, high: Array) -> float:
    """From a box with these corners."""
    return float(np.linalg.norm(point - point.clip(low, high)))


@pytest.mark.parametrize("hand", ["franka", "rg2"])
def test_distances_are_those_of_each_point_from_each_finger(hand: str) -> None:
    ready, found = example(hand)
    left = found.gripper.parts[0]
    measured = distance_of_fingers(ready, found)
    for number in range(0, len(found), 7):
        pose, half = found.Ts_canonical_grasp[number].double().numpy(), float(found.widths[number]) / 2
        low = np.array([-left.breadth.full / 2, half, left.back])
        high = np.array([left.breadth.full / 2, half + left.thickness.full, left.front])
        points = (ready.points.double().numpy() - pose[:3, 3]) @ pose[:3, :3]
        nearest = min(distance(point * [1, side, 1], low, high) for point, side in itertools.product(points, (-1, 1)))
        assert float(measured[number]) == pytest.approx(nearest, abs=1e-5)


def log_odds(scores: torch.Tensor) -> torch.Tensor:
    return torch.logit(scores.double())


@pytest.mark.parametrize("doubt", [LEAST_DOUBT, 0.004, MOST_DOUBT, 0.05])
def test_who_touches_loses_all_and_who_keeps_away_as_far_as_is_doubted_nothing(doubt: float) -> None:
    ready, found = example()
    scores = torch.linspace(0.02, 0.98, len(found))
    lost = log_odds(scores) - log_odds(doubted(scores, ready, found, doubt))
    away, counted = distance_of_fingers(ready, found).double(), min(doubt, MOST_DOUBT)
    expected = LOG_ODDS * (1 - (away / counted).clamp(max=1))
    torch.testing.assert_close(lost, expected, atol=1e-4, rtol=0)
    assert (expected > 1).any()


def test_what_is_no_more_than_noise_changes_no_bit_and_certain_scores_stay_within_their_limits() -> None:
    ready, found = example()
    scores = torch.linspace(0.0, 1.0, len(found))
    assert torch.equal(doubted(scores, ready, found, LEAST_DOUBT * 0.99), scores)
    after = doubted(scores, ready, found, 0.01)
    assert after[[0, -1]].tolist() == [0.0, 1.0]
    assert (after <= scores).all()
