"""The requests that wait for the predictor, and whose turn is next. Knows no threads and no HTTP.

Of those that wait the cheapest goes first, so that a small cloud need not wait for eight large ones. What is passed by
cheaper ones that came later is not passed for ever: once these have taken as long as it would have waited and taken
itself, or as its deadline leaves to spare, it is due, and nothing passes it any more. So nobody waits more than about
twice as long as in order of arrival.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field

from tesnet.query import GraspQuery
from tesnet.result import GraspResult

MUCH_CHEAPER = 2
"""Binary orders of magnitude in expected time by which a request is cheaper than what waits, to have a spare place."""

INTERRUPTED_FROM = 1.5
"""How many times as long as another's a prediction should take for the other to interrupt it."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A prediction, how long its query waited for the predictor, and how many were predicted together."""

    result: GraspResult
    queue_ms: float
    batch_size: int


@dataclass(eq=False, slots=True)
class Job:
    """A query that waits or is predicted. Times are on the clock of `time.perf_counter`, which no change of date moves.

    Args:
        query: what is asked.
        expected: seconds that its prediction should take.
        deadline: by when its answer is wanted.
        begin_by: by when its prediction has to begin.
        client: whose it is, where that is known.
        future: gives the answer.
        submitted: when it was asked.
        passed: seconds that those should take that have passed it.
        spare: how many seconds that may be.
        forsaken: whether nobody waits for it any more.
    """

    query: GraspQuery
    expected: float
    deadline: float = math.inf
    begin_by: float = math.inf
    client: Hashable = None
    future: Future[Answer] = field(default_factory=Future)
    submitted: float = field(default_factory=time.perf_counter)
    passed: float = 0.0
    spare: float = math.inf
    forsaken: bool = False

    @property
    def latest(self) -> float:
        """By when it has to begin at the very latest."""
        return min(self.deadline, self.begin_by)

    @property
    def size(self) -> int:
        """The binary order of magnitude of its expected seconds: requests of one size go in order of arrival."""
        return math.frexp(self.expected)[1]

    @property
    def is_due(self) -> bool:
        """Whether nothing may pass it any more."""
        return self.passed >= self.spare

    def refuse(self, error: Exception) -> None:
        """Give the waiting request an error in place of an answer, unless it has gone already."""
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(error)


class Turns:
    """The jobs that wait. Not safe for threads: who owns it holds a lock.

    Args:
        places: how many may wait; a quarter more may that are much cheaper than what waits.
        client_places: how many of one client's, where clients are known; None is no limit.
    """

    def __init__(self, places: int, client_places: int | None = None) -> None:
        self.places = places
        self.most = places + max(1, places // 4)
        self.client_places = client_places
        self._jobs: list[Job] = []
        self._of_client: Counter[Hashable] = Counter()

    def __len__(self) -> int:
        return len(self._jobs)

    def __iter__(self) -> Iterator[Job]:
        return iter(self._jobs)

    @property
    def expected(self) -> float:
        """Seconds that everything that waits should take."""
        return sum(job.expected for job in self._jobs)

    def is_full_for(self, client: Hashable) -> bool:
        """Whether one client has as many places as it may."""
        return client is not None and self.client_places is not None and self._of_client[client] >= self.client_places

    def has_place(self, job: Job) -> bool:
        """Whether one more may wait: a usual place, or for a cheap one a spare place."""
        if len(self._jobs) < self.places:
            return True
        mean = Job(job.query, self.expected / len(self._jobs))
        return len(self._jobs) < self.most and job.size + MUCH_CHEAPER <= mean.size

    def expect(self, seconds: Callable[[GraspQuery], float]) -> None:
        """Take what is now known of how long predictions take: two alike are of one size, whenever they came."""
        for job in self._jobs:
            job.expected = seconds(job.query)

    def ahead_of(self, job: Job) -> float:
        """Seconds that those should take whose turn is before the job's, were it to wait too."""
        return sum(other.expected for other in self._jobs if other.is_due or other.size <= job.size)

    def add(self, job: Job, busy: float) -> None:
        """Let a job wait.

        Args:
            job: is asked last.
            busy: seconds for which the predictor should be busy with what does not wait any more.
        """
        in_order = busy + self.expected
        to_spare = min(job.deadline - job.expected, job.begin_by) - job.submitted - in_order
        job.spare = max(0.0, min(in_order + job.expected, to_spare))
        self._jobs.append(job)
        self._of_client[job.client] += 1

    def remove(self, job: Job) -> None:
        """Forget a job, if it waits."""
        if job in self._jobs:
            self._jobs.remove(job)
            self._of_client -= Counter([job.client])

    def clear(self) -> list[Job]:
        """Forget all of them; in order of arrival."""
        jobs, self._jobs = self._jobs, []
        self._of_client.clear()
        return jobs

    def take(self) -> Job | None:
        """The job whose turn it is: the first that is due, else the first of the cheapest."""
        if not self._jobs:
            return None
        return self._take(next((job for job in self._jobs if job.is_due), None) or min(self._jobs, key=_size))

    def take_between(self, running: Job) -> Job | None:
        """A job so much cheaper than the one that runs that it may interrupt it, unless that one or another is due."""
        if not self._jobs or running.is_due or any(job.is_due for job in self._jobs):
            return None
        cheapest = min(self._jobs, key=_size)
        if not may_interrupt(cheapest, running):
            return None
        running.passed += cheapest.expected
        return self._take(cheapest)

    def _take(self, taken: Job) -> Job:
        for job in self._jobs[: self._jobs.index(taken)]:
            job.passed += taken.expected
        self.remove(taken)
        return taken


def may_interrupt(job: Job, running: Job) -> bool:
    """Whether a job is so much cheaper than the one that runs that this one goes on only after it."""
    return INTERRUPTED_FROM * job.expected <= running.expected


def _size(job: Job) -> int:
    return job.size
