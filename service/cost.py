"""How long a prediction should take, judged by what is asked and by how long the latest ones took. Knows no queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TypeAlias

from tesnet.query import GraspQuery

REMEMBERED_S = 60.0
"""How long a measured prediction counts: a machine can be busy, and a guess that is never tried again be wrong."""

SAMPLES = 5
"""Of the latest predictions of a kind; their lower median is what counts, so that one stall lifts no guess."""

Kind: TypeAlias = tuple[str | None, int, int]
"""The network that a query names, and the binary orders of magnitude of its points and of all else that it costs."""

Samples: TypeAlias = deque[tuple[float, float]]
"""When a prediction ended, and how many times `work` it took."""


class Costs:
    """Seconds that predictions should take. Not safe for threads: who owns it holds a lock."""

    def __init__(self) -> None:
        self._kinds: dict[Kind, Samples] = {}
        self._all: Samples = deque(maxlen=SAMPLES)

    def expected(self, query: GraspQuery, now: float) -> float:
        """Seconds that a prediction should take: as the latest ones of its kind, else as its `work` lets expect."""
        measured = self.measured(query, now)
        if measured is not None:
            return measured
        factor = _lower_median(self._all, now)
        return work(query) * (1.0 if factor is None else factor)

    def measured(self, query: GraspQuery, now: float) -> float | None:
        """The same, of the latest predictions of its kind alone; None where there were none lately."""
        factor = _lower_median(self._kinds.get(_kind(query), ()), now)
        return None if factor is None else work(query) * factor

    def learn(self, queries: Sequence[GraspQuery], seconds: float, now: float) -> None:
        """Note the seconds that queries took together; each one's share is as expected."""
        expected = [self.expected(query, now) for query in queries]
        factor = max(seconds, 1e-6) / sum(expected)
        for query, own in zip(queries, expected, strict=True):
            share = factor * own / work(query)
            for samples in (self._kinds.setdefault(_kind(query), deque(maxlen=SAMPLES)), self._all):
                samples.append((now, share))


def work(query: GraspQuery) -> float:
    """How much a query asks for: about the seconds that one core of an AMD EPYC takes, fitted to twelve queries.

    Only proportions matter: `Costs` learns how fast the machine and the network are.
    """
    return _points_work(query) + _options_work(query)


def _points_work(query: GraspQuery) -> float:
    return 0.03 + 0.6e-6 * len(query.points)


def _options_work(query: GraspQuery) -> float:
    views = 1 if query.viewpoints is None else len(query.viewpoints)
    shadows = 2 if query.unseen == "occupied" else 1
    plane = 0.05 if query.support_height == "auto" or isinstance(query.up, str) else 0.0
    corrections = 0.05 * views if query.calibrate else 0.0
    search = 2.5e-4 * query.num_approach_points + 4e-5 * query.max_candidates
    return 0.015 + search + 2.5e-3 * views * shadows + plane + corrections


def _kind(query: GraspQuery) -> Kind:
    return query.model, len(query.points).bit_length(), round(1e3 * _options_work(query)).bit_length()


def _lower_median(samples: Sequence[tuple[float, float]] | Samples, now: float) -> float | None:
    recent = sorted(factor for ended, factor in samples if now - ended <= REMEMBERED_S)
    return recent[(len(recent) - 1) // 2] if recent else None
