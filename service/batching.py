"""One worker thread that owns the predictor, behind a bounded queue. Knows neither HTTP nor the event loop.

The predictor is made, warmed up and used in the worker's thread only. It predicts together what waits when it is free,
up to a limit; it never waits for more to come. A request is a `concurrent.futures.Future`: whoever waits for it may
cancel it while it is queued, and its place is free again at once. A job whose deadline has passed is never predicted.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

from service.errors import DeadlineExceeded, NotReady, QueueFull
from tesnet.query import GraspQuery
from tesnet.result import GraspResult

if TYPE_CHECKING:  # importing it loads torch, which `--help` and a port in use need not wait for
    from tesnet.predictor import ModelInfo

log = logging.getLogger(__name__)

State = Literal["loading", "ready", "failed", "stopped"]

FIRST_GUESS_S = 0.1
"""Seconds that a prediction should take before any was measured."""


class Predictor(Protocol):
    """What the service needs of `tesnet.predictor.GraspPredictor`."""

    @property
    def model(self) -> ModelInfo:
        """Which network this is."""

    @property
    def device(self) -> object:
        """Where it computes, as text."""

    def warm_up(self) -> None:
        """Predict once, so that the first request is not slow."""

    def predict_batch(self, queries: Sequence[GraspQuery]) -> list[GraspResult]:
        """The answer to each query."""


PredictorFactory = Callable[[], Predictor]


@dataclass(frozen=True, slots=True)
class Answer:
    """A prediction, how long its query waited for the predictor, and how many were predicted together."""

    result: GraspResult
    queue_ms: float
    batch_size: int


@dataclass(frozen=True, eq=False, slots=True)
class Job:
    """A query in the queue, with its deadline on the clock of `time.perf_counter`, which no change of date moves."""

    query: GraspQuery
    deadline: float = math.inf
    future: Future[Answer] = field(default_factory=Future)
    submitted: float = field(default_factory=time.perf_counter)

    def refuse(self, error: Exception) -> None:
        """Give the waiting request an error in place of an answer, unless it has gone already."""
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(error)


class PredictionWorker:
    """A thread, its predictor and its queue.

    Args:
        factory: makes the predictor, in the worker's thread.
        capacity: how many queries may wait.
        max_batch: how many are predicted together.
        on_batch: told the size of every batch that is predicted.
        on_ready: told when queries are taken.
        on_failure: told the exception when the predictor cannot be made; the worker's state is `failed` then.
    """

    def __init__(
        self,
        factory: PredictorFactory,
        capacity: int,
        max_batch: int = 1,
        on_batch: Callable[[int], None] = lambda _: None,
        on_ready: Callable[[], None] = lambda: None,
        on_failure: Callable[[BaseException], None] = lambda _: None,
    ) -> None:
        self._factory = factory
        self._capacity = capacity
        self._max_batch = max_batch
        self._on_batch = on_batch
        self._on_ready = on_ready
        self._on_failure = on_failure
        self._jobs: deque[Job] = deque()
        self._changed = threading.Condition()
        self._state: State = "loading"
        self._model: ModelInfo | None = None
        self._device = ""
        self._seconds: dict[int, float] = {}  # of the latest predictions, by `_size`
        self._free_at = 0.0  # when what is being predicted should be done, on the clock of deadlines
        self._thread = threading.Thread(target=self._run, name="predictor", daemon=True)

    @property
    def state(self) -> State:
        """Where the worker stands; queries are taken when it is `ready`."""
        return self._state

    @property
    def model(self) -> ModelInfo:
        """The loaded network.

        Raises:
            NotReady: while it is being loaded.
        """
        if self._model is None:
            raise NotReady("The weights are being loaded; come back in a moment.", retry_after=1)
        return self._model

    @property
    def device(self) -> str:
        """Where the loaded network computes."""
        return self._device

    @property
    def depth(self) -> int:
        """Queries that wait."""
        return len(self._jobs)

    @property
    def expected_wait(self) -> float:
        """Seconds that a query queued now would wait, judged by how long the latest clouds of like size took."""
        with self._changed:
            waiting = sum(self._expected(job.query) for job in self._jobs)
            return max(0.0, self._free_at - time.perf_counter()) + waiting

    @property
    def retry_after(self) -> int:
        """Whole seconds, 1 to 60, in which a full queue should have been worked off."""
        return _whole_seconds(self.expected_wait)

    def start(self) -> None:
        """Start loading."""
        self._thread.start()

    def stop(self, timeout: float | None = None) -> bool:
        """Finish what is being predicted, refuse what waits, end the thread.

        Args:
            timeout: seconds to wait for the thread; None waits as long as it takes.

        Returns:
            Whether the thread has ended.
        """
        with self._changed:
            self._state = "stopped"
            waiting = list(self._jobs)
            self._jobs.clear()
            self._changed.notify()
        for job in waiting:
            job.refuse(NotReady("The service ended before this request's turn; repeat it.", retry_after=1))
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def check_live(self) -> None:
        """Whether queries are taken, or will be.

        Raises:
            NotReady: the predictor could not be made.
        """
        if self._state == "failed":
            raise NotReady("The predictor could not be loaded; the log says why.", retry_after=60)

    def check_ready(self) -> None:
        """Whether queries are taken.

        Raises:
            NotReady: loading, failed or stopped.
        """
        if self._state != "ready":
            raise NotReady(f"The predictor is {self._state}; come back in a moment.", retry_after=1)

    def check_room(self) -> None:
        """Whether one more query may wait: asked early, before a body is read, and again by `submit`.

        Raises:
            QueueFull: as many wait as may.
        """
        if len(self._jobs) >= self._capacity:
            raise QueueFull(
                f"{len(self._jobs)} requests wait (limit {self._capacity}); repeat this one in {self.retry_after} s.",
                self.retry_after,
            )

    def submit(self, query: GraspQuery, deadline: float = math.inf, begin_by: float = math.inf) -> Job:
        """Queue a query; its future gives an `Answer`.

        Args:
            query: what is asked.
            deadline: by when the answer is wanted, on the clock of `time.perf_counter`.
            begin_by: by when the prediction has to begin, on the same clock. After either the query is not predicted.

        Raises:
            QueueFull: as many wait as may, or so many that the query would be late; it says when the same query would
                not be. A free predictor tries every query: how long one takes is a guess, and only trying mends it.
            NotReady: loading, failed or stopped.
        """
        with self._changed:
            self.check_ready()
            self.check_room()
            now, wait, own = time.perf_counter(), self.expected_wait, self._expected(query)
            left = min(begin_by, deadline - own) - now
            if wait > 0 and wait > left and now < min(begin_by, deadline):  # what is late already gets its 504
                if wait <= min(begin_by, deadline) - now:  # a guess at its own time, which must not refuse it for ever
                    self._seconds[_size(query)] = 0.9 * own
                retry_after = _whole_seconds(wait - left)
                raise QueueFull(
                    f"{len(self._jobs)} requests wait and the predictor is busy for some {wait:.1f} s; to be in time, "
                    f"this one of some {own:.1f} s would have to begin within {max(0.0, left):.1f} s; repeat it in "
                    f"{retry_after} s or with a larger X-Request-Timeout.",
                    retry_after,
                )
            job = Job(query, min(deadline, begin_by))
            self._jobs.append(job)
            self._changed.notify()
        return job

    def cancel(self, job: Job) -> None:
        """Nobody waits for the job any more: free its place. One that is being predicted runs to its end unheard."""
        with self._changed:
            if job.future.cancel() and job in self._jobs:
                self._jobs.remove(job)

    def _run(self) -> None:
        try:
            predictor = self._factory()
            predictor.warm_up()
            self._device = str(predictor.device)
            self._model = predictor.model
        except BaseException as error:  # noqa: BLE001 - told to the owner, whatever it is
            self._state = "failed"
            self._on_failure(error)
            return
        with self._changed:
            if self._state == "loading":
                self._state = "ready"
                self._on_ready()
        while batch := self._next_batch():
            self._on_batch(len(batch))
            self._predict(predictor, batch)

    def _next_batch(self) -> list[Job]:
        """The jobs to predict together, at least one; none when the worker is to end."""
        batch: list[Job] = []
        with self._changed:
            self._free_at = 0.0
            while not batch:
                self._changed.wait_for(lambda: self._jobs or self._state == "stopped")
                if self._state == "stopped":
                    return []
                while self._jobs and len(batch) < self._max_batch:
                    job = self._jobs.popleft()
                    if time.perf_counter() > job.deadline:
                        job.refuse(DeadlineExceeded("The deadline passed while the request waited for its turn."))
                    elif job.future.set_running_or_notify_cancel():
                        batch.append(job)
            self._free_at = time.perf_counter() + sum(self._expected(job.query) for job in batch)
        return batch

    def _predict(self, predictor: Predictor, batch: list[Job]) -> None:
        started = time.perf_counter()
        try:
            results = predictor.predict_batch([job.query for job in batch])
        except Exception as error:  # noqa: BLE001 - the waiting request raises it again
            if len(batch) > 1:  # each by itself, so that a query's fault is its own
                for job in batch:
                    self._predict(predictor, [job])
            else:
                batch[0].future.set_exception(error)
            return
        self._learn(batch, time.perf_counter() - started)
        for job, result in zip(batch, results, strict=True):
            job.future.set_result(Answer(result, 1e3 * (started - job.submitted), len(batch)))

    def _expected(self, query: GraspQuery) -> float:
        """Seconds that a prediction should take: as the latest ones of the nearest size."""
        if not self._seconds:
            return FIRST_GUESS_S
        return self._seconds[min(self._seconds, key=lambda known: abs(known - _size(query)))]

    def _learn(self, batch: list[Job], taken: float) -> None:
        """Note the seconds that a batch took, as a moving average; each query's share is as expected."""
        with self._changed:
            expected = [self._expected(job.query) for job in batch]
            for job, seconds in zip(batch, expected, strict=True):
                share = max(taken, 1e-6) * seconds / sum(expected)
                before = self._seconds.setdefault(_size(job.query), share)
                self._seconds[_size(job.query)] = before + 0.2 * (share - before)


def _whole_seconds(seconds: float) -> int:
    return max(1, min(60, math.ceil(seconds)))


def _size(query: GraspQuery) -> int:
    """The same for clouds of like size: those of 2^(n-1) to 2^n - 1 points."""
    return len(query.points).bit_length()
