"""Fits a network to labelled views. Resumes from its checkpoint; the schedule looks at validation only."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from tesnet import networks, weights
from tesnet.networks import Network
from tesnet.predictor import configuration_of
from tesnet.whole_file import write_whole
from training import metrics
from training.augment import augment
from training.evaluate import measure, score_views
from training.views import LabelledView, LabelsError, load_views, scene_files


@dataclass(frozen=True, slots=True)
class Recipe:
    """How to train.

    Args:
        optimiser: `adam` or `adamw`.
        learning_rate: at the start.
        weight_decay: of AdamW.
        patience: epochs without a better validation loss after which the learning rate is halved.
        smallest_learning_rate: training ends below it.
        max_epochs: training ends after so many.
        cosine: instead of halving, let the learning rate fall to zero over `max_epochs` along a cosine.
        views_per_step: views whose gradients make one step.
        candidates_per_view: at most so many of a view's candidates in an epoch.
        blocked_per_view: at most so many more that collide with the observed cloud; the service never scores such, but
            their labels, too, tell what a hand hits.
    """

    optimiser: Literal["adam", "adamw"] = "adamw"
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    patience: int = 2
    smallest_learning_rate: float = 5e-5
    max_epochs: int = 10
    cosine: bool = True
    views_per_step: int = 4
    candidates_per_view: int = 120
    blocked_per_view: int = 60


PRESETS = {
    "default": Recipe(),
    # For weights that are good already (`start`), on many more views than they saw.
    "refine": Recipe(learning_rate=1e-3, weight_decay=0.02, max_epochs=3),
    # Section 5.1: Adam, the rate halved after 6 stagnant epochs; the rate itself is Edge Grasp Network's.
    "paper": Recipe(
        optimiser="adam", learning_rate=1e-4, weight_decay=0.0, patience=6, smallest_learning_rate=1e-6,
        max_epochs=200, cosine=False, views_per_step=1, candidates_per_view=2000, blocked_per_view=0,
    ),
}  # fmt: skip


@dataclass(slots=True)
class _Progress:
    """What a checkpoint holds beside the tensors."""

    recipe: dict[str, Any]
    seed: int
    learning_rate: float
    epoch: int = 0
    best_loss: float = math.inf
    stagnant: int = 0


def fit(
    name: str,
    data: Sequence[Path],
    validation: Sequence[Path],
    recipe: Recipe,
    out: Path,
    *,
    epochs: int | None = None,
    threads: int = 2,
    seed: int = 0,
    version: str = "0",
    start: Path | None = None,
) -> dict[str, Any]:
    """Trains network `name`, writes its best weights to `out` and returns its validation measures.

    Most candidates that the network is asked about are free of collision with the observed cloud, as in the service.
    Its logit is the log likelihood ratio of success, the log odds at a balanced prior: in the loss the log odds of the
    share of successes among all labels are added to it (logit adjustment, arXiv 2007.07314). Which kind of candidate is
    shown more often does not bend it; which was labelled more often does. After every epoch a checkpoint beside `out`
    lets a stopped run go on.

    Args:
        name: of the network.
        data: folders of labelled training scenes.
        validation: folders of labelled scenes that choose the epoch and fit the calibration.
        recipe: how to train.
        out: weights file.
        epochs: stop after so many, whatever the recipe's schedule.
        threads: of the CPU.
        seed: of the first weights, of orders and of draws.
        version: that the weights' header carries.
        start: weights to begin with, also older ones with fewer inputs; None for random ones.

    Raises:
        LabelsError: folders without usable labels, a checkpoint of another recipe or seed, or `start` of another
            network.
        WeightsError: `start` cannot be read.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    train_views = [view for view in load_views(data) if metrics.usable(view.success.numpy())]
    if not train_views:
        raise LabelsError(
            f"no view of the training labels has {metrics.FEWEST_POSITIVES} successes and a failure; "
            "generate more labels, or with more labels per view"
        )
    validation_views = list(load_views(validation))
    labels = sum(len(view.outcomes) for view in train_views)
    prior = sum(int(view.success.sum()) for view in train_views) / labels
    network = networks.build(name)
    optimiser = _optimiser(network, recipe)
    checkpoint = out.with_suffix(".checkpoint")
    if start is not None:
        _begin_with(start, name, network)
    progress = _resume(checkpoint, network, optimiser) or _Progress(asdict(recipe), seed, recipe.learning_rate)
    if (progress.recipe, progress.seed) != (asdict(recipe), seed):
        raise LabelsError(f"{checkpoint} is of another recipe or seed; use the same ones, or another --out")
    last_epoch = min(recipe.max_epochs, epochs or recipe.max_epochs)
    # Only halving ends the training: along the cosine the rate is small at the start, too.
    while progress.epoch < last_epoch and (recipe.cosine or progress.learning_rate >= recipe.smallest_learning_rate):
        started = time.monotonic()
        loss = _epoch(network, optimiser, recipe, train_views, prior, progress, seed)
        measures = measure(score_views(network, validation_views), seed)
        _schedule(recipe, progress, measures["served_loss"])
        if measures["served_loss"] <= progress.best_loss:
            progress.best_loss = measures["served_loss"]
            training = {
                "data": {"scenes": len(scene_files(data)), "views": len(train_views), "labels": labels, "prior": prior},
                "recipe": asdict(recipe), "seed": seed, "epoch": progress.epoch, "validation": measures,
            }  # fmt: skip
            header = weights.Header(name, version, configuration_of(network), tuple(measures["calibration"]), training)
            weights.save(out, network.state_dict(), header)
        _save_checkpoint(checkpoint, network, optimiser, progress)
        with out.with_suffix(".log.jsonl").open("a") as log:
            log.write(json.dumps({"epoch": progress.epoch, "train_loss": loss, **measures,
                                  "seconds": time.monotonic() - started}) + "\n")  # fmt: skip
    _, header = weights.load(out)
    return dict(header.training or {})


def _begin_with(start: Path, name: str, network: Network) -> None:
    """Loads weights; where a layer has got inputs since they were made, which stand last, theirs begin at zero."""
    state, header = weights.load(start)
    shapes = {key: tensor.shape for key, tensor in network.state_dict().items()}
    for key, tensor in state.items():
        if key in shapes and tensor.dim() == len(shapes[key]) == 2:
            state[key] = functional.pad(tensor, (0, max(0, shapes[key][1] - tensor.shape[1])))
    same = header.configuration.get("network") == json.loads(json.dumps(asdict(network.config)))
    if header.network != name or not same or {key: tensor.shape for key, tensor in state.items()} != shapes:
        raise LabelsError(f"{start} holds a {header.network} of another configuration; begin without --start")
    network.load_state_dict(state)


def _optimiser(network: Network, recipe: Recipe) -> torch.optim.Optimizer:
    if recipe.optimiser == "adam":
        return torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
    return torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)


def _epoch(
    network: Network,
    optimiser: torch.optim.Optimizer,
    recipe: Recipe,
    views: Sequence[LabelledView],
    prior: float,
    progress: _Progress,
    seed: int,
) -> float:
    """One pass over the views in a random order; the mean training loss."""
    rng = np.random.default_rng([seed, progress.epoch])
    order = rng.permutation(len(views))
    steps = math.ceil(len(views) / recipe.views_per_step)
    log_odds = math.log(prior / (1 - prior))
    total = 0.0
    network.train()
    bar = tqdm(range(steps), desc=f"epoch {progress.epoch}", mininterval=10)
    for step in bar:
        if recipe.cosine:
            share = (progress.epoch + step / steps) / recipe.max_epochs
            warm = min(1.0, (progress.epoch * steps + step + 1) / 100)
            progress.learning_rate = warm * recipe.learning_rate * max(0.03, (1 + math.cos(math.pi * share)) / 2)
        for group in optimiser.param_groups:
            group["lr"] = progress.learning_rate
        optimiser.zero_grad()
        for index in order[step * recipe.views_per_step : (step + 1) * recipe.views_per_step]:
            loss = _view_loss(network, augment(views[index], rng), log_odds, recipe, rng)
            (loss / recipe.views_per_step).backward()
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        bar.set_postfix(loss=f"{total / ((step + 1) * recipe.views_per_step):.4f}")
    progress.epoch += 1
    return total / len(views)


def _view_loss(
    network: Network, view: LabelledView, log_odds: float, recipe: Recipe, rng: np.random.Generator
) -> Tensor:
    """Cross-entropy of the outcomes of some candidates, whose probability is sigmoid(logit + log odds of the prior)."""
    which = torch.cat(
        [
            _some(view.collision_free, recipe.candidates_per_view, rng),
            _some(~view.collision_free, recipe.blocked_per_view, rng),
        ]
    )
    target = view.success[which]
    mirror = torch.from_numpy(rng.choice([-1.0, 1.0], len(which)).astype(np.float32))
    logits = network.score(networks.encode(network, view.cloud), view.cloud, view.candidates.select(which), mirror)
    return functional.binary_cross_entropy_with_logits(logits + log_odds, target.float())


def _some(mask: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """Indices of at most `count` true elements, drawn at random."""
    indices = mask.nonzero()[:, 0].numpy()
    return torch.from_numpy(rng.permutation(indices)[:count])


def _schedule(recipe: Recipe, progress: _Progress, validation_loss: float) -> None:
    """Halves the learning rate after `patience` epochs without a better validation loss."""
    progress.stagnant = 0 if validation_loss < progress.best_loss else progress.stagnant + 1
    if not recipe.cosine and progress.stagnant >= recipe.patience:
        progress.learning_rate /= 2
        progress.stagnant = 0


def _save_checkpoint(path: Path, network: Network, optimiser: torch.optim.Optimizer, progress: _Progress) -> None:
    tensors = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    for number, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in state.items()}
    write_whole(path, safetensors.torch.save(tensors, {"progress": json.dumps(asdict(progress))}))


def _resume(path: Path, network: Network, optimiser: torch.optim.Optimizer) -> _Progress | None:
    if not path.exists():
        return None
    with safetensors.safe_open(path, "pt") as stored:
        progress = _Progress(**json.loads(stored.metadata()["progress"]))
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118  not a mapping
    network.load_state_dict(
        {name.removeprefix("network."): tensor for name, tensor in tensors.items() if name.startswith("network.")}
    )
    state: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith("optimiser."):
            _, number, name = key.split(".", 2)
            state.setdefault(int(number), {})[name] = tensor
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    return progress
