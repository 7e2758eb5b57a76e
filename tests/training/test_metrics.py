from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from training import metrics
from training.metrics import Logits, Success

FEW = settings(max_examples=30, deadline=None)


@st.composite
def scored(draw: st.DrawFn) -> tuple[Logits, Success]:
    """Logits with ties, and outcomes of both kinds."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    count = draw(st.integers(2, 60))
    success = rng.random(count) < draw(st.sampled_from([0.1, 0.5, 0.9]))
    success[:2] = [True, False]
    logits = np.round(rng.normal(0, 2, count) + success, draw(st.integers(0, 4)))
    return logits, success


@given(view=scored())
@FEW
def test_auroc_is_the_share_of_pairs_in_the_right_order(view: tuple[Logits, Success]) -> None:
    logits, success = view
    wins = [
        1.0 if logits[p] > logits[n] else 0.5 if logits[p] == logits[n] else 0.0
        for p in np.flatnonzero(success)
        for n in np.flatnonzero(~success)
    ]
    assert metrics.auroc(logits, success) == pytest.approx(np.mean(wins))


@given(view=scored())
@FEW
def test_average_precision_is_the_sum_over_thresholds(view: tuple[Logits, Success]) -> None:
    logits, success = view
    total, recall_before = 0.0, 0.0
    for threshold in sorted(set(logits.tolist()), reverse=True):
        taken = logits >= threshold
        hits = int((success & taken).sum())
        recall = hits / int(success.sum())
        total += (recall - recall_before) * hits / int(taken.sum())
        recall_before = recall
    assert metrics.average_precision(logits, success) == pytest.approx(total)


@given(view=scored())
@FEW
def test_losses_and_rates_are_those_of_a_loop(view: tuple[Logits, Success]) -> None:
    logits, success = view
    probabilities = [1 / (1 + math.exp(-x)) for x in logits]
    losses = [-math.log(p if s else 1 - p) for p, s in zip(probabilities, success, strict=True)]
    assert metrics.cross_entropy(logits, success) == pytest.approx(np.mean(losses))
    rates = [
        np.mean([(x > 0) == s for x, s in zip(logits, success, strict=True) if s == kind]) for kind in (True, False)
    ]
    assert metrics.balanced_accuracy(logits, success) == pytest.approx(np.mean(rates))


@given(view=scored())
@FEW
def test_the_calibration_error_is_that_of_15_bins(view: tuple[Logits, Success]) -> None:
    logits, success = view
    probabilities = 1 / (1 + np.exp(-logits))
    error = 0.0
    for number in range(15):
        low, high = number / 15, (number + 1) / 15
        inside = (probabilities >= low) & ((probabilities < high) | (number == 14))
        if inside.any():
            error += inside.mean() * abs(success[inside].mean() - probabilities[inside].mean())
    assert metrics.calibration_error(probabilities, success) == pytest.approx(error, abs=1e-12)
    assert metrics.calibration_error(np.array([1.0, 0.0]), np.array([True, False])) == 0


def test_calibration_recovers_the_slope_and_offset_that_made_the_outcomes() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, 40_000)
    success = rng.random(40_000) < 1 / (1 + np.exp(-(0.7 * logits - 2)))
    a, b = metrics.fit_calibration(logits, success)
    assert (a, b) == pytest.approx((0.7, -2.0), abs=0.05)


def test_calibration_ends_where_the_loss_falls_no_further_however_rare_successes_are() -> None:
    rng = np.random.default_rng(1)
    logits = rng.normal(-1, 3, 5_000)
    success = rng.random(5_000) < 1 / (1 + np.exp(-(2.0 * logits - 9)))
    a, b = metrics.fit_calibration(logits, success)
    residual = 1 / (1 + np.exp(-(a * logits + b))) - success
    assert np.abs([residual @ logits, residual.sum()]).max() < 1e-3


@given(view=scored(), scale=st.sampled_from([0.01, 1.0, 30.0]))
@FEW
def test_calibration_never_makes_the_loss_worse(view: tuple[Logits, Success], scale: float) -> None:
    logits, success = view[0] * scale, view[1]
    a, b = metrics.fit_calibration(logits, success)
    assert math.isfinite(a)
    assert math.isfinite(b)
    assert metrics.cross_entropy(a * logits + b, success) <= metrics.cross_entropy(logits, success) + 1e-6


def test_views_need_ten_successes_and_a_failure() -> None:
    assert not metrics.usable(np.array([True] * 9 + [False] * 50))
    assert metrics.usable(np.array([True] * 10 + [False]))
    assert not metrics.usable(np.array([True] * 50))
    assert not metrics.usable(np.zeros(0, dtype=bool))


@given(view=scored(), seed=st.integers(0, 99))
@FEW
def test_balanced_views_hold_as_many_of_each(view: tuple[Logits, Success], seed: int) -> None:
    logits, success = view
    kept, outcomes = metrics.balanced_view(logits, success, np.random.default_rng(seed))
    assert int(outcomes.sum()) * 2 == len(outcomes) == 2 * min(int(success.sum()), int((~success).sum()))
    assert set(kept[outcomes]) <= set(logits[success])
    assert set(kept[~outcomes]) <= set(logits[~success])


def test_the_edge_metric_averages_over_views_and_repeats_for_a_seed() -> None:
    sure = (np.array([3.0, 3.0, -3.0, -3.0]), np.array([True, True, False, False]))
    wrong = (-sure[0], sure[1])
    shy = (np.full(4, 0.4), sure[1])  # below the metric's threshold of 0.5
    accuracy, loss = metrics.edge_metric([sure, wrong, shy], 0)
    assert accuracy == pytest.approx((1 + 0 + 0.5) / 3)
    one = metrics.cross_entropy
    assert loss == pytest.approx((one(*sure) + one(*wrong) + one(*shy)) / 3)
    rng = np.random.default_rng(0)
    uneven = [(rng.normal(size=50), rng.random(50) < 0.3) for _ in range(3)]
    assert metrics.edge_metric(uneven, 1) == metrics.edge_metric(uneven, 1)
    assert metrics.edge_metric(uneven, 1) != metrics.edge_metric(uneven, 2)


@given(view=scored(), seed=st.integers(0, 99))
@FEW
def test_the_edge_metric_counts_those_above_its_threshold(view: tuple[Logits, Success], seed: int) -> None:
    """A balanced view is taken whole; logits from 0 to 0.5 are called failures, though they are likelier successes."""
    logits, success = metrics.balanced_view(*view, np.random.default_rng(seed))
    logits = np.append(logits, [0.4, -0.1])
    success = np.append(success, [True, False])
    right = [(logit > 0.5) == bool(outcome) for logit, outcome in zip(logits, success, strict=True)]
    accuracy, loss = metrics.edge_metric([(logits, success)], seed)
    assert accuracy == pytest.approx(np.mean(right))
    assert loss == pytest.approx(metrics.cross_entropy(logits, success))


@given(view=scored())
@FEW
def test_served_measures_are_those_of_the_calibrated_scores(view: tuple[Logits, Success]) -> None:
    logits, success = view
    found = metrics.served(logits, success, (1.7, -0.4))
    probabilities = 1 / (1 + np.exp(-(1.7 * logits - 0.4)))
    assert found["mean_score"] == pytest.approx(probabilities.mean())
    assert found["calibration_error"] == pytest.approx(metrics.calibration_error(probabilities, success))
    assert found["served_loss"] == pytest.approx(-np.log(np.where(success, probabilities, 1 - probabilities)).mean())
    assert found["auroc"] == pytest.approx(metrics.auroc(logits, success))
    assert (found["candidates"], found["successes"]) == (len(logits), success.sum())
    assert metrics.served(logits[success], success[success], (1.0, 0.0))["auroc"] is None
