"""Measures a network on labelled views, by the definitions of CONVENTIONS.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tesnet import networks, weights
from tesnet.networks import Network
from training import metrics
from training.labels import LabelledView, LabelsError, load_views


def evaluate(name: str, path: Path | None, data: Sequence[Path], seed: int = 0) -> dict[str, Any]:
    """Measures of the weights at `path` (those shipped for the network `name` unless given), overall and by scene.

    Raises:
        WeightsError: weights that cannot be used.
        LabelsError: folders without labels.
    """
    path = path or weights.default_weights(name)
    state_dict, header = weights.load(path)
    network = networks.build(header.network, header.configuration["network"])
    weights.verify(path, state_dict, {key: tensor.shape for key, tensor in network.state_dict().items()})
    network.load_state_dict(state_dict)
    views = list(load_views(data))
    result = {
        "weights_sha256": weights.sha256(path),
        "all": measure(score_views(network, views), seed, header.calibration),
    }
    for scene in sorted({view.scene for view in views}):
        chosen = [view for view in views if view.scene == scene]
        result[scene] = measure(score_views(network, chosen), seed, header.calibration)
    return result


@torch.inference_mode()
def score_views(network: Network, views: Sequence[LabelledView]) -> list[tuple[metrics.Logits, metrics.Success]]:
    """Logits and outcomes of every view's candidates that the observed cloud leaves free."""
    network.eval()
    scored = []
    for view in views:
        free = view.collision_free.nonzero()[:, 0]
        if len(free):
            logits = network.score(network.encode(view.cloud), view.cloud, view.candidates.select(free))
            scored.append((logits.double().numpy(), view.success[free].numpy()))
    return scored


def measure(
    scored: Sequence[tuple[metrics.Logits, metrics.Success]], seed: int, calibration: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Edge Grasp Network's metric over usable views; balanced accuracy, AUROC, AP and calibration over all candidates.

    Args:
        scored: logits and outcomes, a pair a view.
        seed: of the subsampling.
        calibration: (a, b) of the served score; fitted here when not given.
    """
    usable = [view for view in scored if metrics.usable(view[1])]
    if not usable:
        raise LabelsError(
            f"none of {len(scored)} views has {metrics.FEWEST_POSITIVES} successes and a failure; label more candidates"
        )
    accuracy, loss = metrics.edge_metric(usable, seed)
    logits = np.concatenate([view[0] for view in scored])
    success = np.concatenate([view[1] for view in scored])
    a, b = calibration or metrics.fit_calibration(logits, success)
    return {
        "views": len(scored),
        "usable_views": len(usable),
        "candidates": len(logits),
        "successes": int(success.sum()),
        "accuracy": accuracy,
        "balanced_loss": loss,
        "balanced_accuracy": metrics.balanced_accuracy(logits, success),
        "auroc": metrics.auroc(logits, success),
        "average_precision": metrics.average_precision(logits, success),
        "calibration": [a, b],
        "calibration_error": metrics.calibration_error(1 / (1 + np.exp(-(a * logits + b))), success),
        "top1": float(np.mean([view[1][view[0].argmax()] for view in scored])),
    }
