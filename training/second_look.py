"""The second look at the best candidates: samples of an archive's scenes, and the fit to them.

The network stays as it is; what looks again learns what it leaves to be told. So what scores the samples must not have
been trained on their scenes, or its logits are better there than they will be where it is used. Where the network is
the mean of several that were each trained without a part of the scenes, these score each its part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from simharness.sim.objects import ObjectModel
from simharness.sim.outcome_kinds import OUTCOME_KINDS
from simharness.sim.scene import restore_scene
from simharness.sim.world import World
from tesnet import networks, weights
from tesnet.candidates import at_rest
from tesnet.networks.second_look import INPUTS, SecondLook, looks_again, seen_by_fingers
from tesnet.networks.tesnet import TesNet
from tesnet.predictor import configuration_of
from training import metrics
from training.archive import SceneFile, for_each_scene, render_view
from training.parts import ArchivedScene
from training.samples import Samples, descend, read_samples, write_samples
from training.views import Fold, LabelledView, LabelsError, fold_of

BEST = 64
"""So many candidates of a call are looked at again."""

_BEST, _OTHERS = 60, 60
"""Samples of each view: its best candidates, and others."""

EPOCHS = 8
_RATE, _DECAY = 1.5e-3, 0.02
_HELD = 0.5
"""Weight of the loss of what the trunk tells besides: whether a grasp that is reached holds."""

_AT_ONCE = 2048
"""Samples that are measured at a time."""

_MOST_VIEWS = 1000
"""More than any scene has."""


def learn_second_look(
    file: Path,
    archive: Path,
    objects: str,
    samples: Path,
    out: Path,
    *,
    scored_by: Sequence[Path] = (),
    scenes: int | None = None,
    workers: int = 1,
    epochs: int = EPOCHS,
    seed: int = 0,
    version: str = "0",
) -> dict[str, Any]:
    """Draws samples from an archive's scenes and fits the second look of a network to them; see `sample` and `fit`.

    The samples are scored by that network unless there are others to do it (`scored_by`).
    """
    drawn = sample(scored_by or [file], archive, objects, samples, workers, scenes=scenes, seed=seed)
    return drawn | fit(file, samples, out, epochs=epochs, seed=seed, version=version)


def sample(
    files: Sequence[Path],
    archive: Path,
    objects: str,
    out: Path,
    workers: int = 1,
    *,
    scenes: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Writes what fingers see, logits and outcomes, of candidates in an archive's scenes, as files in `out`.

    Files already there are left alone, so that a stopped run goes on.

    Args:
        files: weights of the network. Of N files the k-th scores the k-th of N folds, which it was trained without
            (`Fold`; cross-fitting, Chernozhukov et al. 2018, section 3).
        archive: folder of `labels_*.npz`.
        objects: the object sets that the scenes were made of, joined with commas.
        out: folder for the files.
        workers: processes.
        scenes: so many, drawn from the whole archive; None for all.
        seed: of the draw.

    Raises:
        LabelsError: no archive, objects that the sets do not hold, or weights that were trained without another fold
            than the one that they are to score.
        SimError: a worker failed.
        WeightsError: the weights cannot be used.
    """
    for index, file in enumerate(files):  # fail here, not in a worker
        _check_fold(file, Fold(index, len(files)))
    make = partial(_sample_scene, files=tuple(files))
    return {"scenes": for_each_scene(archive, objects, make, out, "looks", workers, scenes=scenes, seed=seed)}


def _check_fold(file: Path, scores: Fold) -> None:
    """Raises LabelsError where a file says that it was trained without another fold than it scores."""
    _, header = _loaded(file)
    said = ((header.training or {}).get("data") or {}).get("leave_out")
    if scores.count > 1 and said is not None and (without := Fold(**said)) != scores:
        raise LabelsError(
            f"{file} was trained without fold {without} and is to score {scores}; "
            "give the weights of all folds in their order"
        )


def _loaded(file: Path) -> tuple[TesNet, weights.Header]:
    network, header = networks.load(file)
    if not isinstance(network, TesNet):
        raise LabelsError(f"{file} holds no tesnet; only that network looks twice")
    return network, header


@cache
def _first_look(file: Path) -> TesNet:
    """The network in a weights file without a second look, and without what labels do not teach.

    Or the second look would learn that candidates lose log odds of which the labels say nothing.
    """
    network, _ = _loaded(file)
    network.config = replace(network.config, second_look=0, caution=0.0, evenness=0.0, rims=0.0)
    return network.eval().requires_grad_(requires_grad=False)


def _sample_scene(job: SceneFile, models: Mapping[str, ObjectModel], *, files: Sequence[Path]) -> None:
    views = _views_of(job.scene, models, _first_look(files[fold_of(job.path, len(files))]))
    columns = [np.concatenate(column) for column in zip(*views, strict=True)] if views else [np.zeros((0, INPUTS))] * 4
    write_samples(job.path, seen=columns[0], logits=columns[1], outcomes=columns[2], views=columns[3])


def _views_of(scene: ArchivedScene, models: Mapping[str, ObjectModel], network: TesNet) -> list[Sequence[Any]]:
    """What fingers see (S, INPUTS), logits, outcomes and the view's number (S,) of some candidates of each view."""
    found: list[Sequence[Any]] = []
    with World() as world:
        restore_scene(world, scene.description, models)
        for number, archived in enumerate(scene.views):
            view = render_view(world, archived, network.preparation) if looks_again(archived.gripper) else None
            if view is None or not view.collision_free.any():
                continue
            view = view.only(view.collision_free)
            logits = _logits(network, view)
            order = logits.argsort(descending=True)
            rng = np.random.default_rng(crc32(archived.outcomes.tobytes()))
            others = order[_BEST:][torch.from_numpy(rng.permutation(len(order[_BEST:]))[:_OTHERS])]
            some = torch.cat([order[:_BEST], others])
            seen = seen_by_fingers(view.cloud, at_rest(view.cloud, view.candidates.select(some)))
            told = (seen.half(), logits[some], view.outcomes[some], torch.full_like(some, number))
            found.append([column.numpy() for column in told])
    return found


def _logits(network: TesNet, view: LabelledView) -> Tensor:
    features = networks.encode(network, view.cloud)
    rows = torch.arange(len(view.outcomes)).split(network.scored_at_once)
    return torch.cat([network.score(features, view.cloud, view.candidates.select(some)) for some in rows])


def fit(
    file: Path, samples: Path, out: Path, *, epochs: int = EPOCHS, seed: int = 0, version: str = "0"
) -> dict[str, Any]:
    """Fits a second look to all samples in a folder, writes the network with it to `out` and returns its measures.

    The served score's calibration stays, and the loss is that score's. Besides, the trunk learns to tell whether grasps
    that were reached held, which the rest of the network tells least well.

    Args:
        file: weights of the network that scored the samples.
        samples: folder of `sample`.
        out: the weights file.
        epochs: passes over the samples.
        seed: of initial values, order and ways to look.
        version: that the weights' header carries.

    Raises:
        LabelsError: the folder holds no samples.
        WeightsError: the weights cannot be used.
    """
    known = read_samples(samples, "looks")
    first, header = _loaded(file)
    torch.manual_seed(seed)
    look = SecondLook()
    _train(look, known, header.calibration, epochs)
    measures = _measures(look.eval(), known, header.calibration)
    network = networks.build(header.network, {**header.configuration["network"], "second_look": BEST})
    of_look = {f"second_look.{name}": tensor for name, tensor in look.state_dict().items()}
    network.load_state_dict({**first.state_dict(), **of_look})
    card = {"samples": len(known.train), "seed": seed, "epochs": epochs, "held_out": measures}
    training = {"first_look": {"sha256": weights.sha256(file), "training": dict(header.training)}, "second_look": card}
    configuration = {**configuration_of(network), "candidates": header.configuration["candidates"]}
    kept = weights.Header(header.network, version, configuration, header.calibration, training)
    weights.save(out, network.state_dict(), kept)
    return card


def _train(look: SecondLook, known: Samples, calibration: tuple[float, float], epochs: int) -> None:
    everything, before, outcomes = (known.columns[name] for name in ("seen", "logits", "outcomes"))
    rows = known.train
    some = rows[torch.randperm(len(rows))[:40_000]]
    told = torch.cat([everything[some].float(), before[some, None]], dim=1)
    look.mean, look.spread = told.mean(dim=0), told.std(dim=0) + 0.05
    holds = nn.Linear(look.change.in_features, 1)
    a, b = calibration

    def loss_of(batch: Tensor) -> Tensor:
        way = int(torch.randint(len(look.order), ()))
        seen, logits = everything[batch].float()[:, look.order[way]] * look.signs[way], before[batch]
        success, reached = _outcomes(outcomes[batch])
        features = look.features(seen, logits)
        loss = binary_cross_entropy_with_logits(a * (logits + look.change(features)[:, 0]) + b, success)
        if reached.any():
            told_held = holds(features)[:, 0][reached]
            loss = loss + _HELD * binary_cross_entropy_with_logits(told_held, success[reached])
        return loss

    look.train()
    optimiser = torch.optim.AdamW([*look.parameters(), *holds.parameters()], lr=_RATE, weight_decay=_DECAY)
    descend(rows, loss_of, optimiser, partial(_one_cycle, optimiser), epochs)


def _one_cycle(optimiser: torch.optim.Optimizer, steps: int) -> torch.optim.lr_scheduler.LRScheduler:
    return torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps)


def _outcomes(codes: Tensor) -> tuple[Tensor, Tensor]:
    """Whether each grasp succeeded, as numbers, and whether it was reached."""
    on_the_way = torch.tensor([kind in ("pregrasp", "approach") for kind in OUTCOME_KINDS])
    return (codes == OUTCOME_KINDS.index("success")).float(), ~on_the_way[codes.long()]


def _measures(look: SecondLook, known: Samples, calibration: tuple[float, float]) -> dict[str, Any]:
    """Of the samples held out, before and after the second look: the served score's measures, and the best of views."""
    rows = known.held_out
    seen, before, outcomes, views = (known.columns[name][rows] for name in ("seen", "logits", "outcomes", "views"))
    views = views + _MOST_VIEWS * known.scenes[rows]  # unlike those of all other scenes
    with torch.inference_mode():
        parts = zip(seen.split(_AT_ONCE), before.split(_AT_ONCE), strict=True)
        after = torch.cat([look(some.float(), logits) for some, logits in parts])
    success = _outcomes(outcomes)[0].bool().numpy()
    told = {}
    for name, logits in (("before", before), ("after", after)):
        measures = metrics.served(logits.double().numpy(), success, calibration)
        told[name] = {key: measures[key] for key in ("served_loss", "calibration_error", "auroc")}
        told[name]["best_of_view"] = _best_of_views(logits, views, torch.from_numpy(success))
    return {"candidates": len(rows), **told}


def _best_of_views(logits: Tensor, views: Tensor, success: Tensor) -> float:
    """The share of views whose best candidate succeeds."""
    _, view = views.unique(return_inverse=True)
    best = [success[view == number][logits[view == number].argmax()] for number in range(int(view.max()) + 1)]
    return float(torch.stack(best).float().mean())
