"""The paper's Table 1 and Figure 6 from the weights and logs of a folder: how good each network is, and by which way.

Every run was measured on the validation views by `fit` itself, after each of its epochs; here the figures are put side
by side. What `fit` cannot measure is measured here: networks that were not trained in the folder, and the time that a
cloud takes.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from simharness.sim.camera import observe
from simharness.sim.objects import load_object_set
from simharness.sim.protocol import query_about
from simharness.sim.scene import make_scene
from simharness.sim.world import World
from tesnet import networks, weights
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from training.curves import Panel, draw
from training.evaluate import validate
from training.views import LabelsError, load_views

PUBLISHED: Mapping[str, tuple[float, float]] = {
    "gpd": (0.786, 0.362),
    "pointnetgpd": (0.832, 0.302),
    "edgegrasp": (0.883, 0.282),
    "gatv2": (0.889, 0.268),
    "tesnet-paper": (0.895, 0.262),
}
"""Accuracy and loss in the paper's Table 1."""

MEASURES = ("accuracy", "balanced_loss", "balanced_accuracy", "auroc", "average_precision")
"""Columns of the table, as `training.evaluate.measure` names them."""

_ORDER = ("heuristic", "gpd", "pointnetgpd", "edgegrasp", "gatv2", "tesnet-euclidean", "tesnet-paper", "tesnet")
_TIMED_CLOUDS = 12
_LOG = ".log.jsonl"


@dataclass(frozen=True, slots=True)
class Run:
    """One trained network.

    Args:
        path: its weights, or those of the same network with another seed.
        network: its name in the registry.
        training: what its header tells of data, recipe and measures.
        epochs: lines of its log, in the order of the epochs.
    """

    path: Path
    network: str
    training: Mapping[str, Any]
    epochs: Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Args:
        name: of the network, and what tells it from another line of the same.
        seeds: of its runs.
        parameters: of the network.
        measures: of all validation candidates, means over the runs.
        spread: largest difference between two runs, by measure; empty for one run.
        milliseconds, network_milliseconds: a cloud takes from points to grasps, and the network's part; medians.
        views, labels: that it was trained on; None where it was not trained here.
        approach_points: that a step showed at most; None for all.
    """

    name: str
    seeds: Sequence[int]
    parameters: int
    measures: Mapping[str, float]
    spread: Mapping[str, float]
    milliseconds: float
    network_milliseconds: float
    views: int | None = None
    labels: int | None = None
    approach_points: int | None = None


def compare(data: Path, out: Path, validation: Sequence[Path] = ()) -> dict[str, Any]:
    """Writes `table1.md`, `table1.json`, `figure6.svg` and `figure6.png` to `out`; what the table says.

    Args:
        data: folder of the logs that `fit` wrote and the weights beside them. Runs of one network with several seeds
            make one line. Weights without a log take no part.
        out: folder for the table and the figure.
        validation: folders of the labels that the runs were measured on. With them the table also has the heuristic and
            the shipped weights.

    Raises:
        LabelsError: no run in `data`, or a log without weights or without what the figure shows.
        WeightsError: weights that cannot be used.
    """
    runs = read_runs(data)
    torch.set_num_threads(1)
    queries = clouds(_TIMED_CLOUDS)
    rows = [_trained(of_one, queries) for of_one in _by_network(runs)]
    if validation:
        rows = [_heuristic(validation, queries), *rows, _shipped(validation, queries)]
    out.mkdir(parents=True, exist_ok=True)
    table = [asdict(row) for row in rows]
    (out / "table1.json").write_text(json.dumps(table, indent=2) + "\n")
    (out / "table1.md").write_text(markdown(rows))
    figure = draw("Validation candidates, balanced, after each epoch", panels(runs))
    (out / "figure6.svg").write_text(figure.svg())
    figure.save_png(out / "figure6.png")
    return {"rows": table}


def read_runs(data: Path) -> list[Run]:
    """The finished epochs of every run under a folder, by network in the order of the table, then by seed.

    A run is a log. Its weights have the same name; of a run NAME-SEED they may be missing where there are those of
    NAME: the same network, trained with another seed.
    """
    runs = [_read_run(log) for log in sorted(data.glob(f"*{_LOG}"))]
    if not runs:
        raise LabelsError(f"{data} holds no *{_LOG}; train networks into it with `python -m training fit --out`")
    return sorted(runs, key=lambda run: (_place(run.network), run.training["seed"], run.path.name))


def _place(network: str) -> int:
    return _ORDER.index(network) if network in _ORDER else len(_ORDER)


def _read_run(log: Path) -> Run:
    # A run that was stopped between its log and its checkpoint wrote an epoch's line twice.
    by_epoch = {entry["epoch"]: entry for entry in map(json.loads, log.read_text().splitlines())}
    epochs = [by_epoch[epoch] for epoch in sorted(by_epoch)]
    if not all("with_blocked" in entry for entry in epochs):
        raise LabelsError(f"{log} lacks measures of all candidates; it was written by an older version: train again")
    path, seed = _weights_of(log)
    _, header = weights.load(path)
    if "validation_with_blocked" not in header.training:
        raise LabelsError(f"{path} lacks measures of all candidates; it was written by an older version: train again")
    training = header.training
    if seed is not None:
        training = {**training, "seed": seed, "validation_with_blocked": epochs[-1]["with_blocked"]}
    return Run(path, header.network, training, epochs)


def _weights_of(log: Path) -> tuple[Path, int | None]:
    """The weights beside a log; or those of another seed, and the seed that the log's name tells."""
    name = log.name.removesuffix(_LOG)
    own = log.with_name(f"{name}.safetensors")
    if own.exists():
        return own, None
    network, _, seed = name.rpartition("-")
    others = log.with_name(f"{network}.safetensors")
    if not (seed.isdecimal() and others.exists()):
        raise LabelsError(f"{own} is missing, which `fit` writes beside {log.name}; keep both in one folder")
    return others, int(seed)


def _by_network(runs: Sequence[Run]) -> list[list[Run]]:
    names = list(dict.fromkeys(run.network for run in runs))
    return [[run for run in runs if run.network == name] for name in names]


def _shown(network: str) -> str:
    """A trained network's name in the table and the figure; the product's is told from the weights that are shipped."""
    return "tesnet (same data)" if network == "tesnet" else network


def _trained(runs: Sequence[Run], queries: Sequence[GraspQuery]) -> Row:
    first = runs[0]
    measured = [run.training["validation_with_blocked"] for run in runs]
    values = {measure: [of_run[measure] for of_run in measured] for measure in MEASURES}
    total, of_network = milliseconds(GraspPredictor.load(first.path), queries)
    return Row(
        name=_shown(first.network),
        seeds=[run.training["seed"] for run in runs],
        parameters=_parameters(networks.load(first.path)[0]),
        measures={measure: statistics.fmean(of_runs) for measure, of_runs in values.items()},
        spread={measure: max(of_runs) - min(of_runs) for measure, of_runs in values.items()} if len(runs) > 1 else {},
        milliseconds=total,
        network_milliseconds=of_network,
        views=first.training["data"]["views"],
        labels=first.training["data"]["labels"],
        approach_points=first.training["approach_points_per_step"],
    )


def _heuristic(validation: Sequence[Path], queries: Sequence[GraspQuery]) -> Row:
    network = networks.build("heuristic").eval()
    return _measured("heuristic", network, GraspPredictor.without_weights("heuristic"), validation, queries)


def _shipped(validation: Sequence[Path], queries: Sequence[GraspQuery]) -> Row:
    path = weights.default_weights()
    return _measured("tesnet (shipped)", networks.load(path)[0], GraspPredictor.load(path), validation, queries)


def _measured(
    name: str,
    network: networks.Network,
    predictor: GraspPredictor,
    validation: Sequence[Path],
    queries: Sequence[GraspQuery],
) -> Row:
    """A line for a network that was not trained in the folder."""
    _, of_all = validate(network, list(load_views(validation, predictor.preparation)), seed=0)
    total, of_network = milliseconds(predictor, queries)
    measures = {measure: of_all[measure] for measure in MEASURES}
    return Row(name, [], _parameters(network), measures, {}, total, of_network)


def _parameters(network: networks.Network) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def clouds(count: int) -> list[GraspQuery]:
    """What the harness would ask about packed and pile scenes of embedded objects, in turn; always the same."""
    queries = []
    for number in range(count):
        kind = ("packed", "pile")[number % 2]
        rng = np.random.default_rng([6, number])
        with World() as world:
            make_scene(world, kind, load_object_set("procedural", kind), rng)  # type: ignore[arg-type]  # a literal
            queries.append(query_about(observe(world, "random", rng)))
    return queries


def milliseconds(predictor: GraspPredictor, queries: Iterable[GraspQuery]) -> tuple[float, float]:
    """Medians over the queries: the whole answer, and the network's part of it."""
    predictor.warm_up()
    timings = [predictor.predict(query).timings_ms for query in queries]
    return (
        statistics.median(sum(timing.values()) for timing in timings),
        statistics.median(timing["network"] for timing in timings),
    )


def panels(runs: Sequence[Run]) -> list[Panel]:
    """Loss and accuracy against the epoch, a curve a network: the mean of its runs over the epochs that all have."""

    def curves(measure: str, factor: float) -> dict[str, list[float]]:
        found = {}
        for of_one in _by_network(runs):
            shortest = min(len(run.epochs) for run in of_one)
            found[_shown(of_one[0].network)] = [
                factor * statistics.fmean(run.epochs[epoch]["with_blocked"][measure] for run in of_one)
                for epoch in range(shortest)
            ]
        return found

    return [Panel("loss", curves("balanced_loss", 1)), Panel("accuracy, %", curves("accuracy", 100))]


def markdown(rows: Sequence[Row]) -> str:
    """The table, with the paper's accuracy and loss beside those that it gives."""
    lines = ["| " + " | ".join(_HEAD) + " |", "| --- " * len(_HEAD) + "|", *map(_line, rows)]
    return "\n".join(lines) + "\n\n" + _LEGEND


_HEAD = (
    "network", "parameters", "accuracy %", "loss", "paper", "balanced accuracy %", "AUROC", "AP",
    "ms a cloud (network)", "views", "labels", "seeds",
)  # fmt: skip

_LEGEND = """All labelled candidates of the validation views. Accuracy and loss are Edge Grasp Network's (balanced
views, logit > 0.5). Of several seeds: the mean, and after +- half the difference of the largest and the smallest.
Times are medians on one CPU thread, from points to grasps. Labels with a star: in a step the network saw the candidates
of at most so many approach points of a view.
"""


def _line(row: Row) -> str:
    def cell(measure: str, factor: float, digits: int) -> str:
        text = f"{factor * row.measures[measure]:.{digits}f}"
        return text + (f" +- {factor * row.spread[measure] / 2:.{digits}f}" if row.spread else "")

    published = PUBLISHED.get(row.name)
    cells = [
        row.name,
        f"{row.parameters:,}",
        cell("accuracy", 100, 1),
        cell("balanced_loss", 1, 3),
        "" if published is None else f"{100 * published[0]:.1f}, {published[1]:.3f}",
        cell("balanced_accuracy", 100, 1),
        cell("auroc", 1, 3),
        cell("average_precision", 1, 3),
        f"{row.milliseconds:.0f} ({row.network_milliseconds:.0f})",
        "" if row.views is None else f"{row.views:,}",
        "" if row.labels is None else f"{row.labels:,}" + (f" *{row.approach_points}" if row.approach_points else ""),
        ", ".join(map(str, row.seeds)),
    ]
    return "| " + " | ".join(cells) + " |"
