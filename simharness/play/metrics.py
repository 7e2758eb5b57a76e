"""GSR, DR and their intervals: pure functions over recorded rounds.

GSR is successful grasps over attempted grasps; DR is objects grasped over objects present after the scene has settled.
Lifting another object than the one aimed at counts, two lifted at once count once, and an object that leaves the
workspace otherwise stays in DR's denominator.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from simharness.play.records import ROUND_ENDS, RoundRecord
from simharness.sim.outcome_kinds import FAILURE_KINDS

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""


def wilson_interval(count: int, total: int, z: float = Z_95) -> tuple[float, float]:
    """Interval of a binomial rate (Wilson 1927, equation 1); (0, 1) when nothing was observed.

    Args:
        count: successes.
        total: trials.
        z: quantile of the standard normal distribution.

    Raises:
        ValueError: not 0 <= count <= total.
    """
    if not 0 <= count <= total:
        raise ValueError(f"{count} of {total} is no rate; the count must lie between 0 and the total")
    if total == 0:
        return 0.0, 1.0
    rate = count / total
    centre = (rate + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * math.sqrt(rate * (1 - rate) / total + z * z / (4 * total * total))
    # At the ends one limit is exactly the rate; rounding must not push it past.
    low = 0.0 if count == 0 else max(0.0, centre - half)
    high = 1.0 if count == total else min(1.0, centre + half)
    return low, high


@dataclass(frozen=True, slots=True)
class Rate:
    """So many out of so many."""

    count: int
    total: int

    @property
    def value(self) -> float | None:
        """The fraction; None when there was nothing to count."""
        return self.count / self.total if self.total else None

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval."""
        return wilson_interval(self.count, self.total)


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Median and 95th percentile of times in milliseconds; None when there are none."""

    median: float | None
    p95: float | None

    @classmethod
    def of(cls, values: Sequence[float]) -> Percentiles:
        """Percentiles of `values`, linear between ranks."""
        if not values:
            return cls(None, None)
        median, p95 = np.percentile(np.asarray(values, dtype=np.float64), [50, 95])
        return cls(float(median), float(p95))


@dataclass(frozen=True, slots=True)
class Summary:
    """A run in numbers.

    Args:
        rounds: finished rounds.
        gsr, dr: grasp success rate and declutter rate.
        failures: failed attempts by kind, every kind named.
        corrected: attempts on depth that the service corrected (`--calibrate`).
        no_grasps: observations without a grasp, by the service's reason.
        ended: rounds by the way they ended, every way named.
        service_ms, round_trip_ms: times of the requests.
    """

    rounds: int
    gsr: Rate
    dr: Rate
    failures: dict[str, int]
    corrected: int
    no_grasps: dict[str, int]
    ended: dict[str, int]
    service_ms: Percentiles
    round_trip_ms: Percentiles


def summarise(rounds: Iterable[RoundRecord]) -> Summary:
    """The numbers of some rounds, of one seed or of several pooled."""
    done = list(rounds)
    attempts = [attempt for record in done for attempt in record.attempts]
    no_grasps = [entry for record in done for entry in record.no_grasps]
    successes = sum(attempt.success for attempt in attempts)
    failures = Counter(attempt.outcome for attempt in attempts if not attempt.success)
    ended = Counter(record.ended for record in done)
    requests = [attempt.latency for attempt in attempts] + [entry.latency for entry in no_grasps]
    latencies = [latency for latency in requests if latency is not None]
    return Summary(
        rounds=len(done),
        gsr=Rate(successes, len(attempts)),
        dr=Rate(successes, sum(len(record.objects) for record in done)),
        failures={kind: failures[kind] for kind in FAILURE_KINDS},
        corrected=sum(attempt.corrected for attempt in attempts),
        no_grasps=dict(sorted(Counter(entry.reason for entry in no_grasps).items())),
        ended={way: ended[way] for way in ROUND_ENDS},
        service_ms=Percentiles.of([latency.service for latency in latencies if latency.service is not None]),
        round_trip_ms=Percentiles.of([latency.round_trip for latency in latencies]),
    )
