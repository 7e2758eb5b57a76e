"""How the rates change as sensing gets worse: one ordinary run for each condition, all with the same rounds.

A round's scene does not depend on the camera, so every condition meets the same tables. Knows how conditions differ and
what is said of them, not how they are played.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Literal, get_args

from simharness.errors import UsageError
from simharness.play.metrics import Rate, Summary, summarise
from simharness.play.records import ModelRecord, Run
from simharness.play.settings import RunSettings
from simharness.report.plot import Panel, plot
from simharness.report.report import numbers, title
from simharness.sim.sensors.catalogue import SensorName

JSON_FILE = "robustness.json"
TABLE_FILE = "robustness.md"
PLOT_FILE = "robustness.svg"

AxisName = Literal[
    "noise",
    "sensor",
    "viewpoint",
    "distance",
    "points",
    "d435-viewpoint",
    "d435-distance",
    "d415-viewpoint",
    "d415-distance",
]
AXIS_NAMES: tuple[AxisName, ...] = get_args(AxisName)


@dataclass(frozen=True, slots=True)
class Condition:
    """One way of sensing.

    Args:
        name: of its folder.
        label: its level on an axis.
        changes: settings that differ from those of camera `random`.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)

    def settings(self, base: RunSettings) -> RunSettings:
        """The settings of this condition's run."""
        return replace(base, **self.changes)


@dataclass(frozen=True, slots=True)
class Axis:
    """One kind of disturbance.

    Args:
        title: of its table and its part of the plot.
        levels: its conditions; an axis may share one with others.
        joined: so many levels, from the first, lie on one scale.
    """

    title: str
    levels: tuple[Condition, ...]
    joined: int


_ANGLES_DEG = (0, 15, 30, 45, 60, 75, 80)
_DISTANCES_MM = (350, 500, 700, 900, 1200)
_NEAREST_D415_MM = 500  # it sees nothing under 0.44 m


def _viewpoints(prefix: str = "", **changes: Any) -> tuple[Condition, ...]:
    return tuple(
        Condition(f"{prefix}polar-{angle}deg", f"{angle} deg", {"polar_deg": float(angle), **changes})
        for angle in _ANGLES_DEG
    )


def _distances(prefix: str = "", nearest_mm: int = 0, **changes: Any) -> tuple[Condition, ...]:
    return tuple(
        Condition(f"{prefix}distance-{distance}mm", f"{distance / 1000:g} m", {"distance": distance / 1000, **changes})
        for distance in _DISTANCES_MM
        if distance >= nearest_mm
    )


def _sensor(name: SensorName, label: str = "") -> Condition:
    return Condition(f"sensor-{name}", label or name, {"sensor": name})


def _calibrated(condition: Condition) -> Condition:
    return Condition(
        f"{condition.name}-calibrated", f"{condition.label}, calibrated", {**condition.changes, "calibrate": True}
    )


_UNCHANGED = "unchanged"
_NO_NOISE = Condition("noise-0", "none", {"noise_std": 0.0})
_DEX = Condition("noise-giga", "giga's", {"noise_std": 0.0, "dex_noise": True})

AXES: Mapping[AxisName, Axis] = {
    "noise": Axis(
        "Noise on each coordinate of each point",
        (
            _NO_NOISE,
            Condition(_UNCHANGED, "0.8 mm"),
            Condition("noise-2mm", "2 mm", {"noise_std": 0.002}),
            Condition("noise-4mm", "4 mm", {"noise_std": 0.004}),
            _DEX,
        ),
        joined=4,
    ),
    "sensor": Axis(
        "Sensor, 0.6-0.75 m away",
        (
            replace(_NO_NOISE, label="ideal"),
            Condition(_UNCHANGED, "gaussian"),
            _sensor("dropout"),
            _sensor("flying"),
            _sensor("d415"),
            _sensor("d435"),
            _sensor("d435-pose", "d435, pose"),
            _calibrated(_sensor("d435-pose", "d435, pose")),
            _sensor("d435-uncalibrated", "d435, all"),
            _sensor("tof"),
            _sensor("simkinect"),
            _sensor("redwood"),
            _sensor("patches"),
            replace(_DEX, label="dex"),
            _calibrated(replace(_DEX, label="dex")),
        ),
        joined=0,
    ),
    "viewpoint": Axis("Angle of the view from straight above", _viewpoints(), joined=7),
    "distance": Axis("Distance from the table's middle", _distances(), joined=5),
    "points": Axis(
        "Voxels that keep one point each",
        (
            Condition(_UNCHANGED, "every point"),
            *(Condition(f"voxel-{edge}mm", f"{edge} mm", {"voxel_size": edge / 1000}) for edge in (3, 5, 7, 10)),
        ),
        joined=5,
    ),
    "d435-viewpoint": Axis(
        "D435: angle of the view from straight above", _viewpoints("d435-", sensor="d435"), joined=7
    ),
    "d435-distance": Axis("D435: distance from the table's middle", _distances("d435-", sensor="d435"), joined=5),
    "d415-viewpoint": Axis(
        "D415: angle of the view from straight above", _viewpoints("d415-", sensor="d415"), joined=7
    ),
    "d415-distance": Axis(
        "D415: distance from the table's middle", _distances("d415-", _NEAREST_D415_MM, sensor="d415"), joined=4
    ),
}


def conditions(names: Sequence[AxisName]) -> list[Condition]:
    """The conditions of some axes, each once."""
    return list({condition.name: condition for name in names for condition in AXES[name].levels}.values())


class Study:
    """The finished runs of a study.

    Args:
        settings: what all runs have in common.
        names: of the axes.
    """

    def __init__(self, settings: RunSettings, names: Sequence[AxisName]) -> None:
        self._settings = settings
        self._axes = {name: AXES[name] for name in names}
        self._conditions = conditions(names)
        self._runs: dict[str, Run] = {}

    def add(self, condition: Condition, run: Run) -> None:
        """Take a finished run in.

        Raises:
            UsageError: it was played with another model than the runs before.
        """
        if self._runs and run.model != self._model:
            raise UsageError(
                f"condition {condition.name} was played with {run.model}, the conditions before it with {self._model}; "
                "rates of two models cannot be compared, give another --out"
            )
        self._runs[condition.name] = run

    def report(self, versions: Mapping[str, str]) -> dict[str, Any]:
        """The content of robustness.json; conditions have the keys of report.json.

        Args:
            versions: of the packages.
        """
        model = self._model
        return {
            "complete": self._complete,
            "settings": self._settings.to_json(),
            "model": None
            if model is None
            else {"name": model.name, "version": model.version, "weights_sha256": model.weights_sha256},
            "versions": dict(versions),
            "axes": {name: [level.name for level in axis.levels] for name, axis in self._axes.items()},
            "conditions": {
                condition.name: {
                    "changes": dict(condition.changes),
                    "points_median": _points(self._runs[condition.name]),
                    **numbers(summarise(self._runs[condition.name].rounds)),
                }
                for condition in self._conditions
                if condition.name in self._runs
            },
        }

    def table(self) -> str:
        """The rates in Markdown, one table for each axis."""
        lines = [f"{self._title}; rounds for each seed and condition: {self._settings.rounds}; 95 % Wilson intervals."]
        if not self._complete:
            lines += ["", f"Incomplete: {len(self._runs)} of {len(self._conditions)} conditions."]
        for axis in self._axes.values():
            lines += [
                "",
                f"| {axis.title} | GSR, % | successes | DR, % | objects | points, median |",
                "| --- | --- | --- | --- | --- | --- |",
                *(_row(level.label, self._runs[level.name]) for level in axis.levels if level.name in self._runs),
            ]
        return "\n".join(lines) + "\n"

    def plot(self) -> str:
        """The rates as an SVG drawing, one panel for each axis."""
        return plot(self._title, [self._panel(axis) for axis in self._axes.values()])

    @property
    def _complete(self) -> bool:
        return len(self._runs) == len(self._conditions)

    @property
    def _model(self) -> ModelRecord | None:
        return next(iter(self._runs.values())).model if self._runs else None

    @property
    def _title(self) -> str:
        return title(self._settings, self._model).replace(" | ", ", ")

    def _panel(self, axis: Axis) -> Panel:
        def rates(of: Literal["gsr", "dr"]) -> list[Rate | None]:
            return [None if summary is None else getattr(summary, of) for summary in summaries]

        summaries: list[Summary | None] = []
        labels = []
        for level in axis.levels:
            run = self._runs.get(level.name)
            summaries.append(None if run is None else summarise(run.rounds))
            points = None if run is None else _points(run)
            labels.append(level.label if points is None else f"{level.label}\n{points:.0f} pts")
        return Panel(axis.title, labels, axis.joined, {"GSR": rates("gsr"), "DR": rates("dr")})


def _points(run: Run) -> float | None:
    """Median number of points in a request; None when there was no request that says so."""
    counts = [attempt.counts for record in run.rounds for attempt in record.attempts]
    counts += [no_grasp.counts for record in run.rounds for no_grasp in record.no_grasps]
    points = [count["points"] for count in counts if "points" in count]
    return float(median(points)) if points else None


def _row(label: str, run: Run) -> str:
    summary, points = summarise(run.rounds), _points(run)
    cells = [label]
    for rate in (summary.gsr, summary.dr):
        low, high = rate.interval
        value = "-" if rate.value is None else f"{100 * rate.value:.1f}"
        cells += [f"{value} [{100 * low:.1f}, {100 * high:.1f}]", f"{rate.count} of {rate.total}"]
    return f"| {' | '.join(cells)} | {'-' if points is None else f'{points:.0f}'} |"
