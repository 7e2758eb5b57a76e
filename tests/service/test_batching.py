"""The worker by itself: one thread, a bounded queue, no HTTP."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from service import batching
from service.batching import PredictionWorker
from service.cost import REMEMBERED_S, Costs
from service.errors import DeadlineExceeded, NotReady, QueueFull
from tesnet.errors import GaveUp
from tesnet.query import GraspQuery
from tests.conftest import PATIENCE_S


class Echo:
    """Answers with the thread it ran in, when its gate is open."""

    models: Any = ("a model",)
    device = "cpu"

    def __init__(self) -> None:
        self.made_in = threading.current_thread()
        self.gate = threading.Event()
        self.entered = threading.Semaphore(0)

    def warm_up(self) -> None:
        assert threading.current_thread() is self.made_in

    def predict_batch(self, queries: Sequence[GraspQuery], give_up: Any = None) -> list[Any]:
        self.entered.release()
        assert self.gate.wait(PATIENCE_S)
        if any(query.seed == 13 for query in queries):
            raise ValueError("unlucky")
        return [threading.current_thread() for _ in queries]


@pytest.fixture
def query() -> GraspQuery:
    return GraspQuery(np.zeros((4, 3), np.float32))


@pytest.fixture
def made() -> list[Echo]:
    return []


StartWorker = Callable[..., PredictionWorker]


@pytest.fixture
def start(made: list[Echo]) -> Iterator[StartWorker]:
    workers: list[PredictionWorker] = []

    def factory() -> Echo:
        made.append(Echo())
        return made[0]

    def make(**options: Any) -> PredictionWorker:
        ready = threading.Event()
        workers.append(PredictionWorker(factory, on_ready=ready.set, **options))
        workers[0].start()
        assert ready.wait(PATIENCE_S)
        return workers[0]

    yield make
    made[0].gate.set()
    for worker in workers:
        worker.stop()


@pytest.fixture
def worker(start: StartWorker) -> PredictionWorker:
    return start(capacity=2)


def test_one_thread_makes_and_uses_the_predictor(worker: PredictionWorker, made: list[Echo], query: GraspQuery) -> None:
    made[0].gate.set()
    answers = [worker.submit(query).future.result(PATIENCE_S) for _ in range(2)]
    assert {id(answer.result) for answer in answers} == {id(made[0].made_in)}
    assert all(answer.queue_ms >= 0 for answer in answers)


def test_the_queue_is_bounded_and_cancelling_frees_a_place(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    running = worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    first, _ = worker.submit(query), worker.submit(query)
    with pytest.raises(QueueFull, match="limit 2") as refused:
        worker.submit(query)
    assert refused.value.retry_after >= 1

    worker.cancel(first)
    worker.cancel(running)  # too late: it runs to its end

    assert worker.depth == 1
    worker.submit(query)
    made[0].gate.set()
    assert running.future.result(PATIENCE_S) is not None
    with pytest.raises(CancelledError):
        first.future.result(PATIENCE_S)


def test_a_query_that_fails_does_not_end_the_worker(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    made[0].gate.set()
    with pytest.raises(ValueError, match="unlucky"):
        worker.submit(GraspQuery(query.points, seed=13)).future.result(PATIENCE_S)
    assert worker.submit(query).future.result(PATIENCE_S) is not None


def test_what_waits_is_predicted_together_up_to_the_limit(
    start: StartWorker, made: list[Echo], query: GraspQuery
) -> None:
    sizes: list[int] = []
    worker = start(capacity=8, max_batch=3, on_batch=sizes.append)
    first = worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    others = [worker.submit(query) for _ in range(4)]
    made[0].gate.set()
    answers = [job.future.result(PATIENCE_S) for job in (first, *others)]
    assert [answer.batch_size for answer in answers] == [1, 3, 3, 3, 1]
    assert sizes == [1, 3, 1]


def test_a_fault_in_a_batch_is_told_to_its_own_query_alone(
    start: StartWorker, made: list[Echo], query: GraspQuery
) -> None:
    worker = start(capacity=8, max_batch=8)
    first = worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    good, bad, late = worker.submit(query), worker.submit(GraspQuery(query.points, seed=13)), worker.submit(query)
    made[0].gate.set()
    assert all(job.future.result(PATIENCE_S) for job in (first, good, late))
    with pytest.raises(ValueError, match="unlucky"):
        bad.future.result(PATIENCE_S)


def test_a_query_whose_deadline_passed_is_never_predicted(
    start: StartWorker, made: list[Echo], query: GraspQuery
) -> None:
    sizes: list[int] = []
    worker = start(capacity=8, max_batch=8, on_batch=sizes.append)
    running = worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    late = worker.submit(query, deadline=time.perf_counter() - 1)
    made[0].gate.set()
    with pytest.raises(DeadlineExceeded):
        late.future.result(PATIENCE_S)
    assert running.future.result(PATIENCE_S) is not None
    assert sizes == [1]


def test_a_query_whose_turn_would_come_after_its_deadline_is_refused_at_once(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    worker.submit(query)
    assert worker.expected_wait > 0
    with pytest.raises(QueueFull, match="X-Request-Timeout"):
        worker.submit(query, deadline=time.perf_counter() + worker.expected_wait / 10)
    worker.submit(query, deadline=time.perf_counter() + 60)


class Timed:
    """Takes 1 s for a thousand points, on a clock that nothing else moves; holds each query at its gate.

    A query of 4,000 points asks halfway whether to go on.
    """

    models: Any = ("a model",)
    device = "cpu"
    now = 0.0

    def __init__(self) -> None:
        self.gate = threading.Semaphore(0)
        self.entered = threading.Semaphore(0)
        self.order: list[int] = []

    def perf_counter(self) -> float:
        return self.now

    def warm_up(self) -> None:
        pass

    def predict_batch(self, queries: Sequence[GraspQuery], give_up: Any = None) -> list[Any]:
        self.entered.release()
        assert self.gate.acquire(timeout=PATIENCE_S)
        seconds = sum(len(query.points) for query in queries) / 1000
        self.now += seconds / 2
        if seconds >= 4 and any(asked() for asked in give_up):
            raise GaveUp
        self.now += seconds / 2
        self.order += [query.seed for query in queries]
        return [None for _ in queries]


def cloud_of(points: int, seed: int = 0) -> GraspQuery:
    return GraspQuery(np.zeros((points, 3), np.float32), seed=seed)


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Timed, PredictionWorker]]:
    """A worker that has predicted a cloud of 4,000 points and one of 1,000, and is free."""
    predictor, ready = Timed(), threading.Event()
    monkeypatch.setattr(batching, "time", predictor)
    worker = PredictionWorker(lambda: predictor, capacity=8, on_ready=ready.set)
    worker.start()
    assert ready.wait(PATIENCE_S)
    for points in (4000, 1000):
        job = worker.submit(cloud_of(points))
        predictor.gate.release()
        job.future.result(PATIENCE_S)
        assert predictor.entered.acquire(timeout=PATIENCE_S)
    predictor.order.clear()
    yield predictor, worker
    for _ in range(20):
        predictor.gate.release()
    worker.stop()


@pytest.fixture
def busy(timed: tuple[Timed, PredictionWorker]) -> tuple[Timed, PredictionWorker]:
    """The same, predicting a cloud of 1,000 points."""
    predictor, worker = timed
    worker.submit(cloud_of(1000))
    assert predictor.entered.acquire(timeout=PATIENCE_S)
    return predictor, worker


def test_how_long_to_wait_follows_what_was_measured_of_the_clouds_that_wait(
    busy: tuple[Timed, PredictionWorker],
) -> None:
    predictor, worker = busy
    assert worker.expected_wait == pytest.approx(1)
    worker.submit(cloud_of(1000))
    worker.submit(cloud_of(1000))
    assert worker.expected_wait == pytest.approx(3)  # though the largest cloud took 4 s
    worker.submit(cloud_of(4000))
    assert worker.expected_wait == pytest.approx(7)
    predictor.now += 0.5  # of the second that is being predicted
    assert worker.expected_wait == pytest.approx(6.5)


def test_a_query_that_would_end_after_its_deadline_is_refused_though_its_turn_would_come_before(
    busy: tuple[Timed, PredictionWorker],
) -> None:
    predictor, worker = busy
    with pytest.raises(QueueFull, match=r"busy for some 1\.0 s.*of some 4\.0 s.*within 0\.5 s"):
        worker.submit(cloud_of(4000), deadline=predictor.now + 4.5)
    for _ in range(4):
        worker.submit(cloud_of(1000), deadline=predictor.now + 10)
    with pytest.raises(QueueFull) as refused:  # 5 s of work, 4 s of its own
        worker.submit(cloud_of(4000), deadline=predictor.now + 6.5)
    assert refused.value.retry_after == 3  # seconds after which the same request would be in time


def test_the_time_to_begin_by_is_that_of_the_wait_alone(busy: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = busy
    worker.submit(cloud_of(4000), begin_by=predictor.now + 1.5)
    with pytest.raises(QueueFull):
        worker.submit(cloud_of(4000), begin_by=predictor.now + 4.5)


def test_an_idle_predictor_takes_a_query_that_should_take_too_long(timed: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = timed
    worker.submit(cloud_of(4000), deadline=predictor.now + 0.5)
    assert predictor.entered.acquire(timeout=PATIENCE_S)


def test_a_predictor_that_should_be_done_takes_one_too(busy: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = busy
    predictor.now += 1
    worker.submit(cloud_of(4000), deadline=predictor.now + 0.5)
    assert worker.depth == 1


def test_whoever_hears_of_an_answer_finds_the_predictor_free(timed: tuple[Timed, PredictionWorker]) -> None:
    """A lone client that asks one request after the other is never told that the queue is full."""
    predictor, worker = timed
    waits: list[float] = []
    for _ in range(200):
        job = worker.submit(cloud_of(1000), deadline=predictor.now + 0.1)
        job.future.add_done_callback(lambda _: waits.append(worker.expected_wait))
        predictor.gate.release()
        with suppress(DeadlineExceeded):
            job.future.result(PATIENCE_S)
        assert worker.expected_wait == 0
    assert waits == [0.0] * 200


def test_what_is_known_of_times_is_looked_at_and_learnt_under_the_lock(
    start: StartWorker, made: list[Echo], query: GraspQuery, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers: list[PredictionWorker] = []
    seen: dict[str, list[bool]] = {"expected": [], "learn": []}

    def note(name: str) -> None:
        """Whether another thread could take the lock now."""

        def attempt() -> None:
            free = workers[0]._changed.acquire(blocking=False)
            if free:
                workers[0]._changed.release()
            seen[name].append(free)

        other = threading.Thread(target=attempt)
        other.start()
        other.join(PATIENCE_S)

    class Watched(Costs):
        def expected(self, query: GraspQuery, now: float) -> float:
            note("expected")
            return super().expected(query, now)

        def learn(self, queries: Sequence[GraspQuery], seconds: float, now: float) -> None:
            note("learn")
            super().learn(queries, seconds, now)

    monkeypatch.setattr(batching, "Costs", Watched)
    workers.append(start(capacity=2))
    made[0].gate.set()
    workers[0].submit(query).future.result(PATIENCE_S)
    for name, free in seen.items():
        assert free, name
        assert not any(free), name


def test_a_refusal_changes_nothing_that_was_learnt(busy: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = busy
    said = set()
    for _ in range(30):
        with pytest.raises(QueueFull) as refused:
            worker.submit(cloud_of(4000), deadline=predictor.now + 2)
        said.add(str(refused.value))
    assert len(said) == 1


def test_a_wrong_guess_at_a_querys_own_time_does_not_refuse_it_for_ever(busy: tuple[Timed, PredictionWorker]) -> None:
    """As after one slow prediction, while clouds of another size keep the predictor busy."""
    predictor, worker = busy
    with pytest.raises(QueueFull):
        worker.submit(cloud_of(4000), deadline=predictor.now + 2)
    predictor.now += REMEMBERED_S
    worker.submit(cloud_of(1000))
    worker.submit(cloud_of(4000), deadline=predictor.now + 2)


def test_cheap_queries_pass_expensive_ones_and_one_another_in_order(busy: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = busy
    jobs = [worker.submit(cloud_of(points, seed)) for seed, points in enumerate((4000, 4000, 1000, 1000), start=1)]
    predictor.gate.release(5)
    for job in jobs:
        job.future.result(PATIENCE_S)
    assert predictor.order == [0, 3, 4, 1, 2]


def test_what_a_prediction_took_is_expected_of_those_that_wait(timed: tuple[Timed, PredictionWorker]) -> None:
    """Not what was guessed when they came: two alike would be of different sizes, and the later one pass the other."""
    predictor, worker = timed
    jobs = [worker.submit(cloud_of(2000, seed)) for seed in range(3)]
    guessed = jobs[2].expected
    predictor.gate.release()
    jobs[0].future.result(PATIENCE_S)
    assert jobs[2].expected == pytest.approx(2.0)
    assert guessed != pytest.approx(2.0)


def test_a_cheaper_query_has_its_turn_in_the_middle_of_an_expensive_one(
    timed: tuple[Timed, PredictionWorker],
) -> None:
    predictor, worker = timed
    expensive = worker.submit(cloud_of(4000, seed=1))
    assert predictor.entered.acquire(timeout=PATIENCE_S)
    cheap, dear = worker.submit(cloud_of(500, seed=2)), worker.submit(cloud_of(4000, seed=3))
    predictor.gate.release(3)
    for job in (expensive, cheap, dear):
        job.future.result(PATIENCE_S)
    assert predictor.order == [2, 1, 3]
    worker.submit(cloud_of(4000))
    assert worker.expected_wait == pytest.approx(4)  # the time that another took in its middle was not learnt


def test_the_time_that_cheap_ones_take_in_the_middle_is_waited_for_and_not_learnt(
    timed: tuple[Timed, PredictionWorker],
) -> None:
    """However often: a median of the latest would hide it for a while."""
    predictor, worker = timed
    for _ in range(4):
        expensive = worker.submit(cloud_of(4000))
        assert predictor.entered.acquire(timeout=PATIENCE_S)
        cheap = worker.submit(cloud_of(1000))
        predictor.gate.release()
        assert predictor.entered.acquire(timeout=PATIENCE_S)
        assert worker.depth == 0
        assert worker.expected_wait == pytest.approx(2 + 1)  # the other half, and the one in its middle
        predictor.gate.release()
        for job in (expensive, cheap):
            job.future.result(PATIENCE_S)
        assert worker.expected_wait == 0
    worker.submit(cloud_of(4000))
    assert worker.expected_wait == pytest.approx(4)
    assert predictor.entered.acquire(timeout=PATIENCE_S)


def test_a_large_body_is_not_read_where_only_spare_places_are_left(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    for _ in range(2):
        worker.check_room(may_be_cheap=False)
        worker.submit(query)
    worker.check_room(may_be_cheap=True)
    with pytest.raises(QueueFull, match="limit 2"):
        worker.check_room(may_be_cheap=False)


def test_what_nobody_waits_for_is_given_up(timed: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = timed
    forsaken = worker.submit(cloud_of(4000, seed=1))
    assert predictor.entered.acquire(timeout=PATIENCE_S)
    worker.cancel(forsaken)
    late = worker.submit(cloud_of(4000, seed=2), deadline=predictor.now + 9)
    served = worker.submit(cloud_of(4000, seed=3))
    predictor.now += 6
    predictor.gate.release(3)
    served.future.result(PATIENCE_S)
    assert predictor.order == [3]
    for job in (forsaken, late):
        with pytest.raises(DeadlineExceeded):
            job.future.result(PATIENCE_S)


def test_one_client_has_no_more_places_than_it_may(start: StartWorker, made: list[Echo], query: GraspQuery) -> None:
    worker = start(capacity=8, client_capacity=2)
    worker.submit(query, client="a")
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    first, _ = worker.submit(query, client="a"), worker.submit(query, client="a")
    with pytest.raises(QueueFull, match="2 requests of yours wait"):
        worker.submit(query, client="a")
    with pytest.raises(QueueFull, match="2 requests of yours wait"):
        worker.check_room("a")
    worker.submit(query, client="b")
    worker.submit(query)
    worker.cancel(first)
    worker.submit(query, client="a")


def test_stopping_refuses_what_waits(worker: PredictionWorker, made: list[Echo], query: GraspQuery) -> None:
    running = worker.submit(query)
    assert made[0].entered.acquire(timeout=PATIENCE_S)
    waiting = worker.submit(query)
    stopping = threading.Thread(target=worker.stop)
    stopping.start()
    with pytest.raises(NotReady, match="repeat"):
        waiting.future.result(PATIENCE_S)
    made[0].gate.set()
    assert running.future.result(PATIENCE_S) is not None
    stopping.join(PATIENCE_S)
    assert worker.stop()
    with pytest.raises(NotReady, match="stopped"):
        worker.submit(query)


def test_a_predictor_that_cannot_be_made_is_reported_and_nothing_is_taken(query: GraspQuery) -> None:
    failures: list[BaseException] = []
    failed = threading.Event()

    def factory() -> Echo:
        raise OSError("no weights")

    def on_failure(error: BaseException) -> None:
        failures.append(error)
        failed.set()

    worker = PredictionWorker(factory, capacity=1, on_failure=on_failure)
    with pytest.raises(NotReady, match="loaded"):
        _ = worker.models
    worker.start()
    assert failed.wait(PATIENCE_S)
    assert worker.state == "failed"
    assert str(failures[0]) == "no weights"
    with pytest.raises(NotReady, match="failed"):
        worker.submit(query)
    worker.stop()


def test_several_that_interrupt_one_are_all_waited_for_and_not_learnt(timed: tuple[Timed, PredictionWorker]) -> None:
    predictor, worker = timed
    for _ in range(4):
        expensive = worker.submit(cloud_of(4000))
        assert predictor.entered.acquire(timeout=PATIENCE_S)
        cheap = [worker.submit(cloud_of(1000)) for _ in range(2)]
        began = predictor.now
        for _ in range(3):
            predictor.gate.release()
        for job in (expensive, *cheap):
            job.future.result(PATIENCE_S)
        assert predictor.now == began + 4 + 2
        for _ in range(2):
            assert predictor.entered.acquire(timeout=PATIENCE_S)
    worker.submit(cloud_of(4000))
    assert worker.expected_wait == pytest.approx(4)


@pytest.mark.parametrize(
    ("seconds", "told"), [(0.0, 1), (0.2, 1), (1.0, 1), (1.01, 2), (59.0, 59), (59.5, 60), (60.5, 60), (1e6, 60)]
)
def test_a_wait_is_told_in_whole_seconds_from_one_to_a_minute(seconds: float, told: int) -> None:
    assert batching._whole_seconds(seconds) == told
