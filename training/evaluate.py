"""Measures a network on labelled views, by the definitions of CONVENTIONS.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tesnet import networks, weights
from tesnet.cloud import PreparationConfig
from tesnet.networks import Network
from training import metrics
from training.views import LabelledView, LabelsError, load_views, moved

WIDTH_BIN_MM = 20


def evaluate(name: str, path: Path | None, data: Sequence[Path], seed: int = 0) -> dict[str, Any]:
    """Measures of the weights at `path` (those shipped for the network `name` unless given), overall and by scene.

    Also, by hand, sensor and opening (`by_group`), whether scores are what they say.

    They are of candidates that the observed cloud leaves free, which the service ranks; under `with_blocked`, of all
    candidates, as published tests have them. For the latter the labels must be drawn from all candidates alike.

    Raises:
        WeightsError: weights that cannot be used.
        LabelsError: folders without labels.
    """
    path = path or weights.default_weights(name)
    network, header = networks.load(path)
    views = list(load_views(data, PreparationConfig(**header.configuration["preparation"])))
    groups = {"all": views} | {
        scene: [view for view in views if view.scene == scene] for scene in sorted({view.scene for view in views})
    }

    def measures(*, blocked: bool) -> dict[str, Any]:
        return {
            group: measure(score_views(network, chosen, blocked=blocked), seed, header.calibration)
            for group, chosen in groups.items()
        }

    result: dict[str, Any] = {"weights_sha256": weights.sha256(path), **measures(blocked=False)}
    result |= by_group(network, views, header.calibration)
    if not all(bool(view.collision_free.all()) for view in views):
        result["with_blocked"] = measures(blocked=True)
    return result


def by_group(
    network: Network, views: Sequence[LabelledView], calibration: tuple[float, float]
) -> dict[str, dict[str, Any]]:
    """`metrics.served` of the free candidates of each group: `by_hand`, `by_sensor` and `by_width`.

    Hands without a name are `other`; a sensor without one is the camera's own, `camera`. Openings are in bins of
    `WIDTH_BIN_MM`, named by their limits in millimetres.
    """
    shown = [view for view in views if view.collision_free.any()]
    logits, success = _joined(score_views(network, shown))
    counts = [int(view.collision_free.sum()) for view in shown]
    found = [view.candidates for view in shown]
    widths_mm = np.concatenate([(1000 * c.widths[v.collision_free]).numpy() for c, v in zip(found, shown, strict=True)])
    # Half a micrometre of rounding, so that a hand's own opening is within its bin.
    low = WIDTH_BIN_MM * np.ceil((widths_mm - 5e-4) / WIDTH_BIN_MM - 1).astype(int)
    labels = {
        "by_hand": np.repeat([one.gripper.name or "other" for one in found], counts),
        "by_sensor": np.repeat([view.sensor or "camera" for view in shown], counts),
        "by_width": np.array([f"{mm}-{mm + WIDTH_BIN_MM} mm" for mm in low]),
    }
    return {
        name: {
            str(group): metrics.served(logits[of == group], success[of == group], calibration)
            for group in np.unique(of)
        }
        for name, of in labels.items()
    }


def validate(
    network: Network, views: Sequence[LabelledView], seed: int, calibration_views: Sequence[LabelledView] = ()
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Measures on the candidates that the observed cloud leaves free, and on all.

    The calibration is fitted to the free candidates of `calibration_views` or, without any, to those of `views`.
    """
    scored = score_views(network, views, blocked=True)
    shown = [view for view in views if len(view.outcomes)]
    masks = [view.collision_free.numpy() for view in shown]
    free = [(logits[mask], success[mask]) for (logits, success), mask in zip(scored, masks, strict=True) if mask.any()]
    scored_apart = score_views(network, calibration_views)
    of_free = measure(free, seed, metrics.fit_calibration(*_joined(scored_apart)) if scored_apart else None)
    return of_free, measure(scored, seed, tuple(of_free["calibration"]))


@torch.inference_mode()
def score_views(
    network: Network, views: Sequence[LabelledView], *, blocked: bool = False
) -> list[tuple[metrics.Logits, metrics.Success]]:
    """Logits and outcomes of every view's candidates that the observed cloud leaves free, or, if asked for, of all."""
    network.eval()
    device = networks.device_of(network)
    scored = []
    for view in views:
        which = torch.arange(len(view.outcomes)) if blocked else view.collision_free.nonzero()[:, 0]
        if len(which):
            cloud, candidates = moved(view.cloud, device), moved(view.candidates.select(which), device)
            logits = network.score(networks.encode(network, cloud), cloud, candidates)
            scored.append((logits.cpu().double().numpy(), view.success[which].numpy()))
    return scored


def measure(
    scored: Sequence[tuple[metrics.Logits, metrics.Success]], seed: int, calibration: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Edge Grasp Network's metric over usable views; balanced accuracy, AUROC, AP and calibration over all candidates.

    Args:
        scored: logits and outcomes, a pair a view.
        seed: of the subsampling.
        calibration: (a, b) of the served score. When not given, it is fitted to every other view, and the served
            score's error and loss are those on the remaining ones.
    """
    usable = [view for view in scored if metrics.usable(view[1])]
    if not usable:
        raise LabelsError(
            f"none of {len(scored)} views has {metrics.FEWEST_POSITIVES} successes and a failure; label more candidates"
        )
    accuracy, loss = metrics.edge_metric(usable, seed)
    logits, success = _joined(scored)
    judged = scored if calibration or len(scored) == 1 else scored[1::2]
    a, b = calibration or metrics.fit_calibration(*_joined(scored[::2]))
    judged_logits, judged_success = _joined(judged)
    served = a * judged_logits + b
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
        "calibration_error": metrics.calibration_error(1 / (1 + np.exp(-served)), judged_success),
        "served_loss": metrics.cross_entropy(served, judged_success),
        "top1": float(np.mean([view[1][view[0].argmax()] for view in scored])),
    }


def _joined(scored: Sequence[tuple[metrics.Logits, metrics.Success]]) -> tuple[metrics.Logits, metrics.Success]:
    return np.concatenate([view[0] for view in scored]), np.concatenate([view[1] for view in scored])
