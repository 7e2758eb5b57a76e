"""Fits a network to labelled views. Resumes from its checkpoint; the schedule looks at validation only."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
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
from tesnet.predictor import configuration_of, named_device
from tesnet.threads import Threads
from tesnet.whole_file import write_whole
from training import metrics
from training.augment import augment, vary
from training.evaluate import validate
from training.processes import ALONE, Processes
from training.views import Fold, LabelledView, LabelsError, StoredViews, load_views, moved, scene_files


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
        keep: weights of the epoch with the least validation loss, or of the last one.
        vary: whether views are also varied in what the caller may have left out (`training.augment.vary`).
        network: fields of the network's configuration that differ from those of `start` or else from the defaults.
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
    keep: Literal["best", "last"] = "best"
    vary: bool = False
    network: Mapping[str, Any] = field(default_factory=dict)


PRESETS = {
    "default": Recipe(),
    # For weights that are good already (`start`), on many more views than they saw.
    "refine": Recipe(learning_rate=1e-3, weight_decay=0.02, max_epochs=3),
    # The one network that is served, from the weights before it (`start`): told the hand, the noise and any doubt, on
    # folders of many hands, objects and sensors. Few epochs, because a second look at a view teaches little; the last
    # one is kept, as its rate is the smallest.
    "product": Recipe(
        learning_rate=7e-4, weight_decay=0.02, max_epochs=3, views_per_step=10, candidates_per_view=160,
        blocked_per_view=40, keep="last", vary=True,
        network={"told": True, "doubt": True, "caution": 8.0, "mirrored": 64, "evenness": 4.0, "rims": 4.0},
    ),
    # The same for every network of a comparison. The last epoch is kept: choosing the best one would favour those whose
    # validation loss jumps about.
    "comparison": Recipe(learning_rate=1e-3, max_epochs=8, views_per_step=2, blocked_per_view=80, keep="last"),
    # Section 5.1: Adam, the rate halved after 6 stagnant epochs; the rate itself is Edge Grasp Network's.
    "paper": Recipe(
        optimiser="adam", learning_rate=1e-4, weight_decay=0.0, patience=6, smallest_learning_rate=1e-6,
        max_epochs=200, cosine=False, views_per_step=1, candidates_per_view=2000, blocked_per_view=0,
    ),
}  # fmt: skip


APPROACH_POINTS_PER_STEP = dict.fromkeys(("edgegrasp", "gatv2", "tesnet-paper", "tesnet-euclidean"), 16)
"""Networks that work around each approach point, and of how many of a view's they see the candidates in a step: on one
CPU core a step with all of them, 70 on average, would take several times as long as one of the other networks."""

CHECKPOINT_S = 180.0
"""Seconds between checkpoints within an epoch."""


@dataclass(slots=True)
class _Progress:
    """What a checkpoint holds beside the tensors.

    Args:
        recipe, seed, leave_out: of the run.
        learning_rate: now.
        epoch: epochs done.
        best_loss: least validation loss of them.
        stagnant: epochs since then.
        step: steps done in the next epoch.
        loss: sum of the losses of its views so far.
        seconds: that it has taken.
    """

    recipe: dict[str, Any]
    seed: int
    learning_rate: float
    epoch: int = 0
    best_loss: float = math.inf
    stagnant: int = 0
    step: int = 0
    loss: float = 0.0
    seconds: float = 0.0
    leave_out: dict[str, int] | None = None


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
    calibration: Sequence[Path] = (),
    device: str = "cpu",
    leave_out: Fold | None = None,
) -> dict[str, Any]:
    """Trains network `name`, writes its weights to `out` and returns its validation measures.

    Most candidates that the network is asked about are free of collision with the observed cloud, as in the service.
    Its logit is the log likelihood ratio of success, the log odds at a balanced prior: in the loss the log odds of the
    share of successes among all labels are added to it (logit adjustment, arXiv 2007.07314). Which kind of candidate is
    shown more often does not bend it; which was labelled more often does. Checkpoints beside `out`, after every epoch
    and every few minutes within one, let a stopped run go on as if it had not been stopped.

    Processes that torchrun started divide the views of each step among them; its gradient is the same.

    Args:
        name: of the network.
        data: folders of labelled training scenes.
        validation: folders of labelled scenes that choose the epoch, unless the recipe keeps the last.
        recipe: how to train.
        out: weights file.
        epochs: stop after so many, whatever the recipe's schedule.
        threads: of the CPU; while other processes keep the cores busy steps take fewer, which changes rounding alone.
        seed: of the first weights, of orders and of draws.
        version: that the weights' header carries.
        start: weights to begin with, also older ones with fewer inputs; None for random ones.
        calibration: folders of labelled scenes that fit the calibration; those of `validation` unless given.
        device: that computes: `cpu`, `cuda`, `cuda:1` ...
        leave_out: scenes of `data`, by the numbers of their files, that are not trained on, so that the second look can
            learn of them. These are the archive's numbers where `data` was rendered from it.

    Raises:
        DeviceError: this machine does not have the device.
        LabelsError: folders without usable labels or with clouds of another preparation, a checkpoint of another recipe
            or seed, `start` of another network, or a network without parameters.
        WeightsError: `start` cannot be read.
    """
    torch.set_num_threads(threads)
    cores = Threads(threads)
    torch.manual_seed(seed)
    processes = Processes.joined()
    network = _first_network(name, recipe, start).to(named_device(device))
    if networks.is_weightless(name):
        raise LabelsError(f"{name} has no parameters to train; choose another network")
    train_views = StoredViews(data, network.preparation, metrics.usable, leave_out)
    if not train_views:
        raise LabelsError(
            f"no view of the training labels has {metrics.FEWEST_POSITIVES} successes and a failure; "
            "generate more labels, or with more labels per view"
        )
    validation_views = list(load_views(validation, network.preparation))
    calibration_views = list(load_views(calibration, network.preparation))
    labels, prior = train_views.labels, train_views.successes / train_views.labels
    optimiser = _optimiser(network, recipe)
    checkpoint = out.with_suffix(".checkpoint")
    without = None if leave_out is None else asdict(leave_out)
    begun = _Progress(asdict(recipe), seed, recipe.learning_rate, leave_out=without)
    progress = _resume(checkpoint, network, optimiser) or begun
    if (Recipe(**progress.recipe), progress.seed, progress.leave_out) != (recipe, seed, without):
        raise LabelsError(f"{checkpoint} is of another recipe, seed or fold; use the same ones, or another --out")
    approach_points = APPROACH_POINTS_PER_STEP.get(name)
    last_epoch = min(recipe.max_epochs, epochs or recipe.max_epochs)
    # Only halving ends the training: along the cosine the rate is small at the start, too.
    while progress.epoch < last_epoch and (recipe.cosine or progress.learning_rate >= recipe.smallest_learning_rate):
        loss = _epoch(
            network,
            optimiser,
            recipe,
            train_views,
            prior,
            progress,
            approach_points,
            checkpoint,
            cores=cores,
            processes=processes,
        )
        measured = validate(network, validation_views, seed, calibration_views) if processes.leads else None
        validation_loss = processes.from_leader(measured[0]["served_loss"] if measured else math.nan)
        _schedule(recipe, progress, validation_loss)
        is_kept = recipe.keep == "last" or validation_loss <= progress.best_loss
        progress.best_loss = min(progress.best_loss, validation_loss)
        if measured is None:
            continue
        measures, of_all = measured
        if is_kept:
            training = {
                "data": {
                    "scenes": len(scene_files(data, leave_out)), "views": len(train_views), "labels": labels,
                    "prior": prior, "leave_out": without,
                },
                "recipe": asdict(recipe), "approach_points_per_step": approach_points, "seed": seed,
                "epoch": progress.epoch, "validation": measures, "validation_with_blocked": of_all,
            }  # fmt: skip
            header = weights.Header(name, version, configuration_of(network), tuple(measures["calibration"]), training)
            weights.save(out, network.state_dict(), header)
        # A run that is stopped between these two repeats the epoch's end and its line: an epoch's last line counts.
        with out.with_suffix(".log.jsonl").open("a") as log:
            log.write(json.dumps({"epoch": progress.epoch, "train_loss": loss, **measures, "with_blocked": of_all,
                                  "seconds": progress.seconds}) + "\n")  # fmt: skip
        progress.seconds = 0.0
        _save_checkpoint(checkpoint, network, optimiser, progress)
    processes.meet()
    _, header = weights.load(out)
    return dict(header.training or {})


def _first_network(name: str, recipe: Recipe, start: Path | None) -> Network:
    """The network to train: with random weights, or with those of a file and its configuration.

    Layers that it has got since that file was made, if a fresh one's are zero, and inputs of layers, which stand last,
    begin at zero. A second look is left out: it learns afterwards what the rest then leaves (`training.second_look`).
    """
    if start is None:
        return networks.build(name, recipe.network)
    state, header = weights.load(start)
    other = LabelsError(f"{start} holds a {header.network} of another configuration; begin without --start")
    if header.network != name:
        raise other
    configuration = {**header.configuration["network"], **recipe.network}
    configuration.pop("second_look", None)
    state = {key: tensor for key, tensor in state.items() if not key.startswith("second_look.")}
    try:
        network = networks.build(name, configuration)
    except (KeyError, TypeError, ValueError) as error:
        raise other from error
    fresh = network.state_dict()
    state = {key: tensor for key, tensor in fresh.items() if not tensor.any()} | state
    for key, tensor in state.items():
        if key in fresh and tensor.dim() == fresh[key].dim() == 2:
            state[key] = functional.pad(tensor, (0, max(0, fresh[key].shape[1] - tensor.shape[1])))
    if {key: tensor.shape for key, tensor in state.items()} != {key: tensor.shape for key, tensor in fresh.items()}:
        raise other
    network.load_state_dict(state)
    return network


def _optimiser(network: Network, recipe: Recipe) -> torch.optim.Optimizer:
    if recipe.optimiser == "adam":
        return torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
    return torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)


def _epoch(
    network: Network,
    optimiser: torch.optim.Optimizer,
    recipe: Recipe,
    views: StoredViews,
    prior: float,
    progress: _Progress,
    approach_points: int | None,
    checkpoint: Path,
    *,
    cores: Threads,
    processes: Processes = ALONE,
) -> float:
    """One pass over the views in a random order, from the step that was reached; the mean training loss.

    What is drawn in a step derives from the seed, the epoch and the view alone, so that a resumed run draws the same.
    """
    order = np.random.default_rng([progress.seed, progress.epoch]).permutation(len(views))
    steps = math.ceil(len(views) / recipe.views_per_step)
    log_odds = math.log(prior / (1 - prior))
    network.train()
    bar = tqdm(range(progress.step, steps), f"epoch {progress.epoch}", mininterval=10, disable=not processes.leads)
    seconds, started, saved = progress.seconds, time.monotonic(), time.monotonic()
    for step in bar:
        if recipe.cosine:
            share = (progress.epoch + step / steps) / recipe.max_epochs
            warm = min(1.0, (progress.epoch * steps + step + 1) / 100)
            progress.learning_rate = warm * recipe.learning_rate * max(0.03, (1 + math.cos(math.pi * share)) / 2)
        for group in optimiser.param_groups:
            group["lr"] = progress.learning_rate
        optimiser.zero_grad()
        of_step = torch.zeros((), device=networks.device_of(network))
        shown = order[step * recipe.views_per_step : (step + 1) * recipe.views_per_step]
        for index in shown[processes.rank :: processes.count]:
            rng = np.random.default_rng([progress.seed, progress.epoch, int(index)])
            view = vary(views[index], rng) if recipe.vary else views[index]
            with cores.working():
                loss = _view_loss(network, augment(view, rng), log_odds, recipe, rng, approach_points)
                (loss / recipe.views_per_step).backward()
            of_step += loss.detach()
        progress.loss += processes.summed(list(network.parameters()), of_step)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        progress.step = step + 1
        progress.seconds = seconds + time.monotonic() - started
        bar.set_postfix(loss=f"{progress.loss / (progress.step * recipe.views_per_step):.4f}")
        if processes.leads and time.monotonic() - saved >= CHECKPOINT_S:
            _save_checkpoint(checkpoint, network, optimiser, progress)
            saved = time.monotonic()
    mean = progress.loss / len(views)
    progress.epoch, progress.step, progress.loss = progress.epoch + 1, 0, 0.0
    return mean


def _view_loss(
    network: Network,
    view: LabelledView,
    log_odds: float,
    recipe: Recipe,
    rng: np.random.Generator,
    approach_points: int | None = None,
) -> Tensor:
    """Cross-entropy of the outcomes of some candidates, whose probability is sigmoid(logit + log odds of the prior).

    With `approach_points`, of candidates of so many approach points.
    """
    shown = torch.ones_like(view.collision_free)
    if approach_points is not None:
        there = view.approach.unique().numpy()
        shown = torch.isin(view.approach, torch.from_numpy(rng.permutation(there)[:approach_points]))
    which = torch.cat(
        [
            _some(shown & view.collision_free, recipe.candidates_per_view, rng),
            _some(shown & ~view.collision_free, recipe.blocked_per_view, rng),
        ]
    )
    device = networks.device_of(network)
    target = view.success[which].float().to(device)
    mirror = torch.from_numpy(rng.choice([-1.0, 1.0], len(which)).astype(np.float32)).to(device)
    cloud, candidates = moved(view.cloud, device), moved(view.candidates.select(which), device)
    logits = network.score(networks.encode(network, cloud), cloud, candidates, mirror)
    return functional.binary_cross_entropy_with_logits(logits + log_odds, target)


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
