"""How good a scorer is on labelled candidates: pure functions of logits and outcomes (CONVENTIONS.md, "Metrics")."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FEWEST_POSITIVES = 10
"""Views with fewer positives, or without negatives, are left out, as the paper does."""

CALIBRATION_BINS = 15

Logits = NDArray[np.float64]
Success = NDArray[np.bool_]


def usable(success: Success) -> bool:
    """Whether a view has enough positives, and negatives at all."""
    return int(success.sum()) >= FEWEST_POSITIVES and not bool(success.all())


def balanced_view(logits: Logits, success: Success, rng: np.random.Generator) -> tuple[Logits, Success]:
    """As many positives as negatives of one view, the more frequent class subsampled."""
    positives, negatives = np.flatnonzero(success), np.flatnonzero(~success)
    count = min(len(positives), len(negatives))
    chosen = np.concatenate([rng.choice(positives, count, replace=False), rng.choice(negatives, count, replace=False)])
    return logits[chosen], success[chosen]


def cross_entropy(logits: Logits, success: Success) -> float:
    """Mean binary cross-entropy, nats."""
    return float(np.mean(np.logaddexp(0.0, np.where(success, -logits, logits))))


def edge_metric(views: Sequence[tuple[Logits, Success]], seed: int) -> tuple[float, float]:
    """Accuracy (logit > 0.5) and loss on balanced views, averaged over views: Edge Grasp Network's test metric."""
    rng = np.random.default_rng(seed)
    accuracies, losses = [], []
    for view in views:
        logits, success = balanced_view(*view, rng)
        accuracies.append(float(np.mean((logits > 0.5) == success)))
        losses.append(cross_entropy(logits, success))
    return float(np.mean(accuracies)), float(np.mean(losses))


def balanced_accuracy(logits: Logits, success: Success) -> float:
    """Mean of the true-positive and the true-negative rate at probability 0.5."""
    return float((np.mean(logits[success] > 0) + np.mean(logits[~success] <= 0)) / 2)


def auroc(logits: Logits, success: Success) -> float:
    """Area under the ROC curve: the chance that a success outscores a failure, ties counting half (Mann-Whitney U)."""
    _, rank, counts = np.unique(logits, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    mean_rank = (last - (counts - 1) / 2)[rank]
    positives, negatives = int(success.sum()), int((~success).sum())
    return float((mean_rank[success].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def average_precision(logits: Logits, success: Success) -> float:
    """Sum over thresholds of precision times the gain in recall; equal logits are one threshold."""
    order = np.argsort(-logits, kind="stable")
    hits = np.cumsum(success[order])
    last_of_tie = np.append(np.diff(logits[order]) != 0, True)
    precision = (hits / np.arange(1, len(hits) + 1))[last_of_tie]
    recall = hits[last_of_tie] / hits[-1]
    return float(np.sum(precision * np.diff(recall, prepend=0.0)))


def calibration_error(probabilities: Logits, success: Success) -> float:
    """Expected calibration error: |frequency - mean probability| over 15 equal-width bins, weighted by their counts."""
    bins = np.minimum((probabilities * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    gap = np.bincount(bins, weights=success - probabilities, minlength=CALIBRATION_BINS)
    return float(np.abs(gap).sum() / len(success))


def served(logits: Logits, success: Success, calibration: tuple[float, float]) -> dict[str, float | None]:
    """How well candidates are judged by their served score, sigmoid(a * logit + b); without an AUROC for one class.

    Args:
        logits: of the candidates.
        success: their outcomes.
        calibration: (a, b).
    """
    a, b = calibration
    scores = a * logits + b
    both = bool(success.any()) and not bool(success.all())
    probabilities = 1 / (1 + np.exp(-scores))
    return {
        "candidates": len(logits),
        "successes": int(success.sum()),
        "mean_score": float(probabilities.mean()),
        "calibration_error": calibration_error(probabilities, success),
        "served_loss": cross_entropy(scores, success),
        "auroc": auroc(logits, success) if both else None,
    }


def fit_calibration(logits: Logits, success: Success) -> tuple[float, float]:
    """(a, b) that minimise the cross-entropy of sigmoid(a * logit + b) (Platt scaling), by damped Newton steps."""
    design = np.stack([logits, np.ones_like(logits)], axis=1)
    weights = np.array([1.0, 0.0])
    for _ in range(50):
        probability = 1 / (1 + np.exp(-np.clip(design @ weights, -50, 50)))
        gradient = design.T @ (probability - success)
        curvature = (design * (probability * (1 - probability))[:, None]).T @ design + 1e-6 * np.eye(2)
        step = np.linalg.solve(curvature, gradient)
        loss = cross_entropy(design @ weights, success)
        while cross_entropy(design @ (weights - step), success) > loss and float(np.abs(step).max()) >= 1e-10:
            step /= 2
        weights -= step
        if float(np.abs(step).max()) < 1e-10:
            break
    return float(weights[0]), float(weights[1])
