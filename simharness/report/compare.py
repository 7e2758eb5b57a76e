"""Several networks on the same scenes: the paper's Table 2, with intervals and differences paired by scene.

Knows what is said of the runs, not how they are played.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simharness.drawing import Drawing
from simharness.play.metrics import Rate, Summary, summarise
from simharness.play.records import Run
from simharness.play.settings import RunSettings
from simharness.report.bars import bars
from simharness.report.paired import Paired, paired, points
from simharness.report.plot import Panel
from simharness.report.report import numbers
from simharness.sim.objects import SceneKind

TABLE = "table2"
"""Name of the files, without what tells their format."""

PUBLISHED: Mapping[tuple[str, SceneKind], tuple[float, float]] = {
    ("gpd", "packed"): (0.785, 0.813),
    ("gpd", "pile"): (0.756, 0.772),
    ("pointnetgpd", "packed"): (0.811, 0.854),
    ("pointnetgpd", "pile"): (0.779, 0.798),
    ("edgegrasp", "packed"): (0.906, 0.922),
    ("edgegrasp", "pile"): (0.871, 0.902),
    ("tesnet-paper", "packed"): (0.941, 0.952),
    ("tesnet-paper", "pile"): (0.922, 0.935),
}
"""GSR and DR in the paper's Table 2. There contacts on the way push, as for executor `edge`."""

_REFERENCE = "tesnet"


@dataclass(frozen=True, slots=True)
class Contestant:
    """A network that takes part.

    Args:
        network: its name.
        weights: its file; None for the one that the service loads by itself.
    """

    network: str
    weights: Path | None

    @property
    def name(self) -> str:
        """What it is called in tables: as its file is, so that two files of one network can be told apart."""
        return self.network if self.weights is None else self.weights.stem


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of the comparison: who takes part, and what is played."""

    contestant: Contestant
    settings: RunSettings

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.condition}/{self.contestant.name}"

    @property
    def condition(self) -> str:
        """What it has in common with the runs that it is compared with."""
        return f"{self.settings.scene}-{self.settings.executor}"


class Comparison:
    """The finished runs of a comparison.

    Args:
        trials: what is to be played; all of a condition with the same settings but for the network.
        versions: of the packages (`package_versions`).
    """

    def __init__(self, trials: Sequence[Trial], versions: Mapping[str, str]) -> None:
        self._trials = trials
        self._versions = versions
        self._runs: dict[str, Run] = {}
        self._paired: dict[str, Paired] = {}
        names = [trial.contestant.name for trial in trials]
        self._reference = _REFERENCE if _REFERENCE in names else names[0]

    def add(self, name: str, run: Run) -> None:
        """Take a finished run in.

        Args:
            name: of its trial.
            run: of the same rounds as the others of its condition.

        Raises:
            UsageError: it was played on other scenes than the reference's.
        """
        self._runs[name] = run
        for trial in self._trials:
            reference = self._runs.get(f"{trial.condition}/{self._reference}")
            if reference is not None and trial.name in self._runs and trial.name not in self._paired:
                self._paired[trial.name] = paired(
                    self._runs[trial.name].rounds, reference.rounds, np.random.default_rng(0)
                )

    def report(self) -> dict[str, Any]:
        """The content of table2.json; networks have the keys of report.json, rates and differences are fractions."""
        settings = self._trials[0].settings.to_json()
        own = ("scene", "executor", "model", "objects")
        return {
            "complete": self._complete,
            "reference": self._reference,
            "settings": {name: value for name, value in settings.items() if name not in own},
            "objects": {trial.condition: trial.settings.objects for trial in self._trials},
            "versions": dict(self._versions),
            "conditions": {
                condition: {trial.contestant.name: self._entry(trial) for trial in self._done(condition)}
                for condition in self._conditions
            },
        }

    def table(self) -> str:
        """The rates in Markdown, one table for each scene and executor."""
        lines = [self._title + ".", "", self._played_by + "."]
        if not self._complete:
            lines += ["", f"Incomplete: {len(self._runs)} of {len(self._trials)} runs."]
        for condition in self._conditions:
            against = f"against {self._reference}"
            head = (condition.replace("-", ", "), "GSR, %", "successes", against, "DR, %", "objects", against, "paper")
            lines += ["", _line(head), _line(["---"] * len(head)), *map(self._row, self._done(condition))]
        return "\n".join(lines) + "\n\n" + _LEGEND

    def chart(self) -> Drawing:
        """The rates as bars, one panel for each scene and executor."""
        return bars(self._title, [self._panel(condition) for condition in self._conditions])

    @property
    def _complete(self) -> bool:
        return len(self._runs) == len(self._trials)

    @property
    def _conditions(self) -> list[str]:
        return list(dict.fromkeys(trial.condition for trial in self._trials))

    @property
    def _title(self) -> str:
        settings = self._trials[0].settings
        objects = ", ".join(dict.fromkeys(Path(trial.settings.objects).name for trial in self._trials))
        seeds = f"seed{'s' if len(settings.seeds) > 1 else ''} {' '.join(map(str, settings.seeds))}"
        return f"Objects {objects}, camera {settings.camera}, {seeds}, {settings.rounds} rounds for each seed"

    @property
    def _played_by(self) -> str:
        commit = f", commit {self._versions['commit']}" if "commit" in self._versions else ""
        return f"Played by version {self._versions.get('tes-net', 'unknown')}{commit}"

    def _done(self, condition: str) -> list[Trial]:
        """The finished trials of a condition."""
        return [trial for trial in self._trials if trial.condition == condition and trial.name in self._runs]

    def _entry(self, trial: Trial) -> dict[str, Any]:
        run, result = self._runs[trial.name], self._paired.get(trial.name)
        return {
            "model": None if run.model is None else asdict(run.model),
            **numbers(summarise(run.rounds)),
            "paired": None if result is None else result.to_json(),
        }

    def _row(self, trial: Trial) -> str:
        summary, result = summarise(self._runs[trial.name].rounds), self._paired.get(trial.name)
        alone = trial.contestant.name == self._reference
        differences = ("", "") if result is None or alone else (points(result.gsr), points(result.dr))
        return _line(
            [
                trial.contestant.name,
                *_rate(summary.gsr),
                differences[0],
                *_rate(summary.dr),
                differences[1],
                _published(trial),
            ]
        )

    def _panel(self, condition: str) -> Panel:
        trials = self._done(condition)
        summaries: list[Summary] = [summarise(self._runs[trial.name].rounds) for trial in trials]
        series = {"GSR": [summary.gsr for summary in summaries], "DR": [summary.dr for summary in summaries]}
        return Panel(condition.replace("-", ", "), [trial.contestant.name for trial in trials], 0, series)


_LEGEND = """Rates with 95 % Wilson intervals. Differences are in points and paired by scene, with 95 % intervals of the
bootstrap over rounds. Paper: its Table 2, GSR / DR.
"""


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rate(rate: Rate) -> tuple[str, str]:
    low, high = rate.interval
    value = "-" if rate.value is None else f"{100 * rate.value:.1f}"
    return f"{value} [{100 * low:.1f}, {100 * high:.1f}]", f"{rate.count} of {rate.total}"


def _published(trial: Trial) -> str:
    settings = trial.settings
    found = PUBLISHED.get((settings.model, settings.scene)) if settings.executor == "edge" else None
    return "" if found is None else f"{100 * found[0]:.1f} / {100 * found[1]:.1f}"
