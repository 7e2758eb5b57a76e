"""One worker thread that owns the predictor, behind a bounded queue. Knows neither HTTP nor the event loop.

The predictor is made, warmed up and used in the worker's thread only. It predicts together what waits when it is free,
up to a limit; it never waits for more to come. `service.turns` says whose turn it is. Between the stages of a
prediction cheaper ones have their turn, and one that nobody waits for is given up there: its deadline has passed,
whoever waited for it has cancelled it, or the worker ends.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, Protocol

from service.cost import Costs
from service.errors import DeadlineExceeded, NotReady, QueueFull
from service.turns import Answer, Job, Turns, may_interrupt
from tesnet.errors import GaveUp
from tesnet.query import GraspQuery
from tesnet.result import GraspResult

if TYPE_CHECKING:  # importing it loads torch, which `--help` and a port in use need not wait for
    from tesnet.predictor import GiveUp, ModelInfo

log = logging.getLogger(__name__)

State = Literal["loading", "ready", "failed", "stopped"]


class Predictor(Protocol):
    """What the service needs of `tesnet.several.GraspPredictors`."""

    @property
    def models(self) -> Sequence[ModelInfo]:
        """Its networks, the default one first."""

    @property
    def device(self) -> object:
        """Where it computes, as text."""

    def warm_up(self) -> None:
        """Predict once, so that the first request is not slow."""

    def predict_batch(
        self, queries: Sequence[GraspQuery], give_up: Sequence[GiveUp | None] | None = None
    ) -> list[GraspResult]:
        """The answer to each query; `tesnet.errors.GaveUp` where one of `give_up` says that nobody waits."""


PredictorFactory = Callable[[], Predictor]


@dataclass(slots=True)
class _Running:
    """What is being predicted.

    Args:
        batch: the jobs.
        until: when it should be done.
        stolen: seconds that other predictions took in the middle of it.
    """

    batch: Sequence[Job]
    until: float
    stolen: float = 0.0


class PredictionWorker:
    """A thread, its predictor and its queue.

    Args:
        factory: makes the predictor, in the worker's thread.
        capacity: how many queries may wait.
        max_batch: how many are predicted together.
        on_batch: told the size of every batch that is predicted.
        on_ready: told when queries are taken.
        on_failure: told the exception when the predictor cannot be made; the worker's state is `failed` then.
        client_capacity: how many queries of one client may wait, where clients are known; None is no limit.
    """

    def __init__(
        self,
        factory: PredictorFactory,
        capacity: int,
        max_batch: int = 1,
        on_batch: Callable[[int], None] = lambda _: None,
        on_ready: Callable[[], None] = lambda: None,
        on_failure: Callable[[BaseException], None] = lambda _: None,
        client_capacity: int | None = None,
    ) -> None:
        self._factory = factory
        self._max_batch = max_batch
        self._on_batch = on_batch
        self._on_ready = on_ready
        self._on_failure = on_failure
        self._turns = Turns(capacity, client_capacity)
        self._costs = Costs()
        self._changed = threading.Condition()
        self._state: State = "loading"
        self._models: Sequence[ModelInfo] = ()
        self._device = ""
        self._running: list[_Running] = []  # the last one interrupts the one before it
        self._thread = threading.Thread(target=self._run, name="predictor", daemon=True)

    @property
    def state(self) -> State:
        """Where the worker stands; queries are taken when it is `ready`."""
        return self._state

    @property
    def models(self) -> Sequence[ModelInfo]:
        """The loaded networks, the default one first.

        Raises:
            NotReady: while they are being loaded.
        """
        if not self._models:
            raise NotReady("The weights are being loaded; come back in a moment.", retry_after=1)
        return self._models

    @property
    def device(self) -> str:
        """Where the loaded networks compute."""
        return self._device

    @property
    def depth(self) -> int:
        """Queries that wait."""
        with self._changed:
            return len(self._turns)

    @property
    def expected_wait(self) -> float:
        """Seconds in which everything that was asked should be answered."""
        with self._changed:
            return self._busy() + self._turns.expected

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
            waiting = self._turns.clear()
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

    def check_room(self, client: Hashable = None, *, may_be_cheap: bool = True) -> None:
        """Whether one more query may wait: asked early, before a body is read; `submit` asks again.

        Args:
            client: whose it is, where that is known.
            may_be_cheap: whether it may turn out to be so cheap that it has a spare place.

        Raises:
            QueueFull: as many wait as may.
        """
        with self._changed:
            self._check_client(client)
            if len(self._turns) >= (self._turns.most if may_be_cheap else self._turns.places):
                raise self._full()

    def submit(
        self,
        query: GraspQuery,
        deadline: float = math.inf,
        begin_by: float = math.inf,
        client: Hashable = None,
    ) -> Job:
        """Queue a query; its future gives an `Answer`.

        Args:
            query: what is asked.
            deadline: by when the answer is wanted, on the clock of `time.perf_counter`.
            begin_by: by when the prediction has to begin, on the same clock. After either the query is not predicted.
            client: whose it is, where that is known.

        Raises:
            QueueFull: as many wait as may, or so many that the query would be late; it says when the same query would
                not be. A free predictor takes every query: how long one takes is a guess, and only trying mends it.
            NotReady: loading, failed or stopped.
        """
        with self._changed:
            self.check_ready()
            self._check_client(client)
            now = time.perf_counter()
            job = Job(query, self._costs.expected(query, now), deadline, begin_by, client, submitted=now)
            if not self._turns.has_place(job):
                raise self._full()
            self._check_in_time(job, now)
            self._turns.add(job, self._busy())
            self._changed.notify()
        return job

    def cancel(self, job: Job) -> None:
        """Nobody waits for the job any more: free its place. One that is being predicted is given up."""
        job.forsaken = True
        with self._changed:
            if job.future.cancel():
                self._turns.remove(job)

    def _check_client(self, client: Hashable) -> None:
        if self._turns.is_full_for(client):
            raise QueueFull(
                f"{self._turns.client_places} requests of yours wait, which is the limit for one client; wait for an "
                "answer before you ask again.",
                _whole_seconds(self.expected_wait),
            )

    def _check_in_time(self, job: Job, now: float) -> None:
        """Raise `QueueFull` for a job that would be late. Its own time counts where it was measured, not guessed."""
        wait = self._turns.ahead_of(job)
        if self._running and not may_interrupt(job, self._running[0].batch[0]):
            wait += self._busy()
        own = self._costs.measured(job.query, now) or 0.0
        left = min(job.begin_by, job.deadline - own) - now
        if wait > 0 and left < wait and now < job.latest:  # what is late already gets its 504
            retry_after = _whole_seconds(wait - left)
            raise QueueFull(
                f"{len(self._turns)} requests wait and the predictor is busy for some {wait:.1f} s; to be in time, "
                f"this one of some {job.expected:.1f} s would have to begin within {max(0.0, left):.1f} s; repeat it "
                f"in {retry_after} s or with a larger X-Request-Timeout.",
                retry_after,
            )

    def _full(self) -> QueueFull:
        retry_after = _whole_seconds(self.expected_wait)
        waiting = f"{len(self._turns)} requests wait (limit {self._turns.places})"
        return QueueFull(f"{waiting}; repeat this one in {retry_after} s.", retry_after)

    def _busy(self) -> float:
        """Seconds until what is being predicted should be done."""
        now = time.perf_counter()
        return max([0.0, *(running.until - now for running in self._running)])

    def _run(self) -> None:
        try:
            predictor = self._factory()
            predictor.warm_up()
            self._device = str(predictor.device)
            self._models = predictor.models
        except BaseException as error:  # noqa: BLE001 - told to the owner, whatever it is
            self._state = "failed"
            self._on_failure(error)
            return
        with self._changed:
            if self._state == "loading":
                self._state = "ready"
                self._on_ready()
        while batch := self._next_batch():
            self._predict(predictor, batch)

    def _next_batch(self) -> list[Job]:
        """The jobs to predict together, at least one; none when the worker is to end."""
        batch: list[Job] = []
        with self._changed:
            while not batch:
                self._changed.wait_for(lambda: len(self._turns) or self._state == "stopped")
                if self._state == "stopped":
                    return []
                while len(batch) < self._max_batch and (job := self._turns.take()):
                    if _begins(job):
                        batch.append(job)
            self._begin(batch)
        return batch

    def _begin(self, batch: list[Job]) -> None:
        """Note, in the same hold of the lock in which the jobs ceased to wait, that they are being predicted."""
        seconds = sum(job.expected for job in batch)
        for running in self._running:
            running.until += seconds
        self._running.append(_Running(batch, time.perf_counter() + seconds))

    def _predict(self, predictor: Predictor, batch: list[Job]) -> None:
        """Predict what `_begin` was told of. The predictor counts as free before anybody hears of an answer."""
        started = time.perf_counter()
        self._on_batch(len(batch))
        give_up = [partial(self._give_up, predictor, job) for job in batch]
        try:
            results = predictor.predict_batch([job.query for job in batch], give_up)
        except Exception as error:  # noqa: BLE001 - the waiting request raises it again
            self._end(None)
            self._fail(predictor, batch, error)
            return
        self._end(started)
        for job, result in zip(batch, results, strict=True):
            job.future.set_result(Answer(result, 1e3 * (started - job.submitted), len(batch)))

    def _end(self, started: float | None) -> None:
        """What was begun last is done; `started` is when, where it went well and its time can be learnt from."""
        now = time.perf_counter()
        with self._changed:
            ended = self._running.pop()
            if started is not None:
                self._costs.learn([job.query for job in ended.batch], now - started - ended.stolen, now)
                self._turns.expect(partial(self._costs.expected, now=now))

    def _fail(self, predictor: Predictor, batch: list[Job], error: Exception) -> None:
        """Tell a job its error; those of a batch are tried each by itself, so that a query's fault is its own."""
        if len(batch) == 1:
            late = DeadlineExceeded("The deadline passed while the grasps were computed.")
            batch[0].future.set_exception(late if isinstance(error, GaveUp) else error)
            return
        for job in batch:
            with self._changed:
                self._begin([job])
            self._predict(predictor, [job])

    def _give_up(self, predictor: Predictor, job: Job) -> bool:
        """Asked by the predictor between stages: whether nobody waits for a job. Cheap ones have their turn here."""
        while not (over := self._is_over(job)) and (cheap := self._take_between(job)):
            started = time.perf_counter()
            self._predict(predictor, [cheap])
            with self._changed:
                self._running[-1].stolen += time.perf_counter() - started
        return over

    def _is_over(self, job: Job) -> bool:
        return job.forsaken or self._state == "stopped" or time.perf_counter() > job.deadline

    def _take_between(self, job: Job) -> Job | None:
        """A job that may be predicted in the middle of another, which interrupts nothing itself."""
        with self._changed:
            while len(self._running) == 1 and (cheap := self._turns.take_between(job)):
                if _begins(cheap):
                    self._begin([cheap])
                    return cheap
        return None


def _begins(job: Job) -> bool:
    """Whether somebody still waits for a job whose turn has come; who is late is told so."""
    if time.perf_counter() > job.latest:
        job.refuse(DeadlineExceeded("The deadline passed while the request waited for its turn."))
        return False
    return job.future.set_running_or_notify_cancel()


def _whole_seconds(seconds: float) -> int:
    return max(1, min(60, math.ceil(seconds)))
