"""What a run leaves behind: report.json, and the table that is printed. Pure functions of a run."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from simharness.play.metrics import Percentiles, Rate, Summary, summarise
from simharness.play.records import OBJECTS_PER_ROUND, ModelRecord, Run
from simharness.play.settings import RunSettings

_PACKAGES = ("tes-net", "numpy", "pybullet", "scipy", "trimesh", "pillow", "httpx", "torch")


def report(run: Run, versions: dict[str, str]) -> dict[str, Any]:
    """The content of report.json: rates are fractions, None where there was nothing to count; times in milliseconds.

    Args:
        run: complete or not.
        versions: see `package_versions`.
    """
    settings = run.settings.to_json()
    serving = run.serving
    return {
        "complete": run.complete,
        "stopped_by": run.stopped_by,
        **numbers(summarise(run.rounds)),
        "by_seed": {
            str(seed): numbers(summarise(record for record in run.rounds if record.seed == seed))
            for seed in run.settings.seeds
        },
        "settings": {
            **settings,
            "objects_per_round": OBJECTS_PER_ROUND,
            "workers": run.workers,
            "url": None if serving is None else serving.url,
            "service_threads": None if serving is None else serving.num_threads,
            "device": None if serving is None else serving.device,
        },
        "model": None
        if run.model is None
        else {"name": run.model.name, "version": run.model.version, "weights_sha256": run.model.weights_sha256},
        "versions": versions,
    }


def package_versions() -> dict[str, str]:
    """Versions of Python and of the installed packages that results depend on; the commit of a checkout."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():
        describe = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude", "*"]
        with suppress(OSError, subprocess.CalledProcessError):
            versions["commit"] = subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    return versions


def table(run: Run) -> str:
    """The run in some lines of text."""
    total = summarise(run.rounds)
    rows = [("", "rate", "95 % interval", "counted")]
    rows += _rate_rows(total, "")
    if len(run.settings.seeds) > 1:
        for seed in run.settings.seeds:
            rows += _rate_rows(summarise(record for record in run.rounds if record.seed == seed), f" seed {seed}")
    lines = [
        title(run.settings, run.model),
        "",
        *aligned(rows),
        "",
        f"rounds    {total.rounds} of {run.settings.rounds * len(run.settings.seeds)}: {counts(total.ended)}",
        f"failures  {counts(total.failures)}",
        f"no grasp  {counts(total.no_grasps)}",
        f"latency   service {times(total.service_ms)}, round trip {times(total.round_trip_ms)}",
    ]
    if run.settings.calibrate:
        lines.append(f"depth     corrected in {total.corrected} of {total.gsr.total} attempts")
    if run.stopped_by is not None:
        lines.append(f"INCOMPLETE: {run.stopped_by.splitlines()[0]}")
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of equally many cells as lines with their columns one below the other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def title(settings: RunSettings, model: ModelRecord | None) -> str:
    """A run in one line; the model by the name it was asked for where it has not answered."""
    return " | ".join(
        [
            f"{settings.scene} scenes",
            f"objects {settings.objects}",
            f"camera {settings.camera}",
            f"executor {settings.executor}",
            settings.model if model is None else f"{model.name} {model.version}",
            f"seed{'s' if len(settings.seeds) > 1 else ''} {' '.join(map(str, settings.seeds))}",
        ]
    )


def counts(values: dict[str, int]) -> str:
    """`kind 3, other 1` of the kinds that occurred."""
    parts = [f"{name.replace('_', ' ')} {count}" for name, count in values.items() if count]
    return ", ".join(parts) or "none"


def times(values: Percentiles) -> str:
    """`34 ms (p95 50)`."""
    if values.median is None or values.p95 is None:
        return "not measured"
    return f"{values.median:.0f} ms (p95 {values.p95:.0f})"


def percent(rate: Rate) -> str:
    """`88.1 %`, or a dash when there was nothing to count."""
    return "-" if rate.value is None else f"{100 * rate.value:.1f} %"


def _rate_rows(summary: Summary, suffix: str) -> list[tuple[str, str, str, str]]:
    rows = []
    for name, rate, what in (("GSR", summary.gsr, "attempts"), ("DR", summary.dr, "objects")):
        low, high = rate.interval
        interval = f"{100 * low:.1f} - {100 * high:.1f} %"
        rows.append((name + suffix, percent(rate), interval, f"{rate.count} of {rate.total} {what}"))
    return rows


def numbers(summary: Summary) -> dict[str, Any]:
    """A summary as JSON values: rates are fractions, None where there was nothing to count; times in milliseconds."""
    return {
        "gsr": summary.gsr.value,
        "gsr_interval": list(summary.gsr.interval),
        "dr": summary.dr.value,
        "dr_interval": list(summary.dr.interval),
        "successes": summary.gsr.count,
        "attempts": summary.gsr.total,
        "objects_grasped": summary.dr.count,
        "objects_total": summary.dr.total,
        "failures": summary.failures,
        "corrected": summary.corrected,
        "no_grasps": summary.no_grasps,
        "rounds": summary.rounds,
        "rounds_ended": summary.ended,
        "latencies": {
            "service_total_ms": {"median": summary.service_ms.median, "p95": summary.service_ms.p95},
            "round_trip_ms": {"median": summary.round_trip_ms.median, "p95": summary.round_trip_ms.p95},
        },
    }
