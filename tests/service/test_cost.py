"""What a prediction should take: from what is asked, and from what the latest ones took."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.cost import REMEMBERED_S, SAMPLES, Costs, work
from tesnet.query import GraspQuery

PLAIN = GraspQuery(np.zeros((1000, 3), np.float32))


@pytest.mark.parametrize(
    "more",
    [
        {"points": np.zeros((100_000, 3), np.float32)},
        {"num_approach_points": 1024},
        {"max_candidates": 20_000},
        {"viewpoints": np.ones((64, 3))},
        {"viewpoints": np.ones((64, 3)), "unseen": "occupied"},
        {"up": np.array([0, 0, 1.0]), "support_height": "auto"},
        {"up": "auto"},
        {"calibrate": True, "viewpoints": np.ones((4, 3)), "view_index": np.zeros(1000, np.uint8)},
    ],
)
def test_whoever_asks_for_more_should_take_longer(more: dict[str, object]) -> None:
    asked = replace(PLAIN, **more)  # type: ignore[arg-type]
    assert work(asked) > 1.3 * work(PLAIN)
    costs = Costs()
    costs.learn([PLAIN], 4 * work(PLAIN), now=0)  # a machine of a quarter the speed
    assert costs.expected(asked, now=0) == pytest.approx(4 * work(asked))
    assert costs.measured(asked, now=0) is None


VIEWS = {"viewpoints": np.ones((4, 3)), "up": np.array([0, 0, 1.0])}


@pytest.mark.parametrize(
    ("less", "more"),
    [
        ({}, {"points": np.zeros((2000, 3), np.float32)}),
        ({}, {"num_approach_points": 64}),
        ({}, {"max_candidates": 4000}),
        ({}, {"viewpoints": np.ones((2, 3))}),
        (VIEWS, VIEWS | {"unseen": "occupied"}),
        (VIEWS, VIEWS | {"support_height": "auto"}),
        (VIEWS, VIEWS | {"calibrate": True}),
    ],
)
def test_each_thing_that_is_asked_for_costs_something_by_itself(
    less: dict[str, object], more: dict[str, object]
) -> None:
    assert work(replace(PLAIN, **more)) > work(replace(PLAIN, **less))  # type: ignore[arg-type]


@given(st.permutations([0.09, 0.1, 0.11, 0.1, 30.0]))
def test_one_stall_lifts_no_guess(seconds: list[float]) -> None:
    costs = Costs()
    for number, taken in enumerate(seconds):
        costs.learn([PLAIN], taken, now=number)
        assert costs.expected(PLAIN, now=number) < 0.12 or number == 0
    assert costs.measured(PLAIN, now=len(seconds)) == pytest.approx(0.1)


def test_a_machine_that_became_slower_is_believed_after_a_few_predictions() -> None:
    costs = Costs()
    for number in range(2 * SAMPLES):
        costs.learn([PLAIN], 0.1 if number < SAMPLES else 0.5, now=number)
    assert costs.expected(PLAIN, now=2 * SAMPLES) == pytest.approx(0.5)


def test_what_was_measured_long_ago_does_not_count() -> None:
    costs = Costs()
    costs.learn([PLAIN], 9.0, now=0)
    assert costs.expected(PLAIN, now=REMEMBERED_S) == pytest.approx(9.0)
    assert costs.expected(PLAIN, now=REMEMBERED_S + 1) == work(PLAIN)


def test_what_one_network_took_is_not_measured_of_another() -> None:
    costs = Costs()
    slow = replace(PLAIN, model="edgegrasp")
    costs.learn([slow], 9.0, now=0)
    costs.learn([PLAIN], 0.1, now=0)
    assert costs.measured(slow, now=1) == pytest.approx(9.0)
    assert costs.measured(PLAIN, now=1) == pytest.approx(0.1)


def test_the_shares_of_a_batch_add_up() -> None:
    costs = Costs()
    dear = replace(PLAIN, max_candidates=20_000)
    costs.learn([PLAIN, dear], 2.0, now=0)
    assert costs.expected(PLAIN, 0) + costs.expected(dear, 0) == pytest.approx(2.0)
