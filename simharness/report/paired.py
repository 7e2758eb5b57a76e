"""Two runs of the same scenes: by how much their rates differ, and how sure that is.

A scene is given by the run's seed and the round's number, whoever grasps in it, so rounds are compared one by one.
Knows nothing of who played them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simharness.errors import UsageError
from simharness.play.metrics import Summary, summarise
from simharness.play.records import RoundRecord
from simharness.play.settings import RunSettings
from simharness.report.report import aligned, percent

RESAMPLES = 10_000
_BLOCK = 1_000
"""Resamples made at once."""

_QUANTILES = (0.025, 0.975)


@dataclass(frozen=True, slots=True)
class Difference:
    """One rate minus another; a fraction, or None where either has nothing to count.

    Args:
        value: over all rounds.
        interval: that holds it with 95 %; None as `value` is.
    """

    value: float | None
    interval: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Paired:
    """Two runs over the rounds that both have.

    Args:
        first, second: numbers of each over these rounds.
        gsr, dr: the first's rate minus the second's.
        left_out: rounds that only one of them has.
    """

    first: Summary
    second: Summary
    gsr: Difference
    dr: Difference
    left_out: int

    def to_json(self) -> dict[str, Any]:
        """The differences as JSON values: fractions, None where there was nothing to count."""
        return {
            "rounds": self.first.rounds,
            "rounds_left_out": self.left_out,
            "gsr_difference": self.gsr.value,
            "gsr_difference_interval": None if self.gsr.interval is None else list(self.gsr.interval),
            "dr_difference": self.dr.value,
            "dr_difference_interval": None if self.dr.interval is None else list(self.dr.interval),
        }


def paired(first: Sequence[RoundRecord], second: Sequence[RoundRecord], rng: np.random.Generator) -> Paired:
    """Compare two runs scene by scene.

    Intervals are percentiles of the bootstrap over rounds (Efron and Tibshirani 1993, section 13.3): as many rounds as
    there are, drawn with replacement, each with what both runs did there.

    Args:
        first: finished rounds.
        second: those of the other run.
        rng: draws the rounds.

    Raises:
        UsageError: they have no round in common, or other objects stood in one.
    """
    of_first, of_second = ({(record.seed, record.round): record for record in records} for records in (first, second))
    common = sorted(of_first.keys() & of_second.keys())
    if not common:
        raise UsageError("the runs have no round in common; give runs with the same seeds")
    for key in common:
        _check(of_first[key], of_second[key])
    mine, other = ([records[key] for key in common] for records in (of_first, of_second))
    counts = np.hstack([_counts(mine), _counts(other)])
    gsr, dr = _differences(counts, rng)
    return Paired(summarise(mine), summarise(other), gsr, dr, len(of_first.keys() ^ of_second.keys()))


def _check(first: RoundRecord, second: RoundRecord) -> None:
    if sorted(first.objects) != sorted(second.objects):
        raise UsageError(
            f"round {first.round} of seed {first.seed} began with {', '.join(first.objects)} in one run and with "
            f"{', '.join(second.objects)} in the other; pair runs of the same scenes and objects"
        )


def _counts(records: Sequence[RoundRecord]) -> NDArray[np.float64]:
    """Successes, attempts and objects (rounds, 3)."""
    return np.array(
        [
            (sum(attempt.success for attempt in record.attempts), len(record.attempts), len(record.objects))
            for record in records
        ],
        dtype=np.float64,
    )


def _differences(counts: NDArray[np.float64], rng: np.random.Generator) -> tuple[Difference, Difference]:
    """Of GSR and of DR, from the counts of two runs side by side (rounds, 6)."""
    rounds = len(counts)
    drawn = [
        rng.multinomial(rounds, np.full(rounds, 1 / rounds), size=_BLOCK) @ counts for _ in range(RESAMPLES // _BLOCK)
    ]
    sums = np.vstack([counts.sum(axis=0), *drawn])
    return _difference(sums[:, [0, 1, 3, 4]]), _difference(sums[:, [0, 2, 3, 5]])


def _difference(sums: NDArray[np.float64]) -> Difference:
    """Of two rates, from counts and totals of both (samples, 4); the first sample is what was observed."""
    counted = np.minimum(sums[:, 1], sums[:, 3]) > 0
    if not counted[0]:
        return Difference(None, None)
    of_first, first_total, of_second, second_total = sums[counted].T
    values = of_first / first_total - of_second / second_total
    low, high = np.quantile(values[1:], _QUANTILES)
    return Difference(float(values[0]), (float(low), float(high)))


def paired_table(names: tuple[str, str], settings: tuple[RunSettings, RunSettings], result: Paired) -> str:
    """What `simharness paired` prints."""
    rows = [("", "first", "second", "points", "95 % interval")]
    for rate in ("gsr", "dr"):
        first, second = getattr(result.first, rate), getattr(result.second, rate)
        counts = [f"{percent(of)} ({of.count} of {of.total})" for of in (first, second)]
        rows.append((rate.upper(), counts[0], counts[1], *_cells(getattr(result, rate))))
    lines = [
        f"first     {names[0]}",
        f"second    {names[1]}",
        "",
        *aligned(rows),
        "",
        f"rounds    {result.first.rounds} in both",
    ]
    if result.left_out:
        lines.append(f"left out  {result.left_out} that only one run has")
    of_first, of_second = (given.to_json() for given in settings)
    differing = [
        f"{name} {of_first[name]} and {of_second[name]}" for name in of_first if of_first[name] != of_second[name]
    ]
    if differing:
        lines.append(f"settings  {'; '.join(differing)}")
    return "\n".join(lines)


def points(difference: Difference) -> str:
    """`-1.2 [-2.5, 0.1]` in percentage points, or a dash."""
    return "-" if difference.value is None else " ".join(_cells(difference))


def _cells(difference: Difference) -> tuple[str, str]:
    if difference.value is None or difference.interval is None:
        return "-", "-"
    low, high = difference.interval
    return f"{100 * difference.value:+.1f}", f"[{100 * low:+.1f}, {100 * high:+.1f}]"
