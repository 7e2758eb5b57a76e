"""The worker by itself: one thread, a bounded queue, no HTTP."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
import pytest

from service.batching import PredictionWorker
from service.errors import NotReady, QueueFull
from tesnet.query import GraspQuery


class Echo:
    """Answers with the thread it ran in, when its gate is open."""

    model: Any = "a model"
    device = "cpu"

    def __init__(self) -> None:
        self.made_in = threading.current_thread()
        self.gate = threading.Event()
        self.entered = threading.Semaphore(0)

    def warm_up(self) -> None:
        assert threading.current_thread() is self.made_in

    def predict(self, query: GraspQuery) -> Any:
        self.entered.release()
        assert self.gate.wait(30)
        if query.seed == 13:
            raise ValueError("unlucky")
        return threading.current_thread()


@pytest.fixture
def query() -> GraspQuery:
    return GraspQuery(np.zeros((4, 3), np.float32))


@pytest.fixture
def made() -> list[Echo]:
    return []


@pytest.fixture
def worker(made: list[Echo]) -> Iterator[PredictionWorker]:
    ready = threading.Event()

    def factory() -> Echo:
        made.append(Echo())
        return made[0]

    worker = PredictionWorker(factory, capacity=2, on_ready=ready.set)
    worker.start()
    assert ready.wait(30)
    yield worker
    made[0].gate.set()
    worker.stop()


def test_one_thread_makes_and_uses_the_predictor(worker: PredictionWorker, made: list[Echo], query: GraspQuery) -> None:
    made[0].gate.set()
    answers = [worker.submit(query).future.result(30) for _ in range(2)]
    assert {id(answer.result) for answer in answers} == {id(made[0].made_in)}
    assert all(answer.queue_ms >= 0 for answer in answers)


def test_the_queue_is_bounded_and_cancelling_frees_a_place(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    running = worker.submit(query)
    assert made[0].entered.acquire(timeout=30)
    first, _ = worker.submit(query), worker.submit(query)
    with pytest.raises(QueueFull, match="limit 2") as refused:
        worker.submit(query)
    assert refused.value.retry_after >= 1

    worker.cancel(first)
    worker.cancel(running)  # too late: it runs to its end

    assert worker.depth == 1
    worker.submit(query)
    made[0].gate.set()
    assert running.future.result(30) is not None
    with pytest.raises(CancelledError):
        first.future.result(30)


def test_a_query_that_fails_does_not_end_the_worker(
    worker: PredictionWorker, made: list[Echo], query: GraspQuery
) -> None:
    made[0].gate.set()
    with pytest.raises(ValueError, match="unlucky"):
        worker.submit(GraspQuery(query.points, seed=13)).future.result(30)
    assert worker.submit(query).future.result(30) is not None


def test_stopping_cancels_what_waits(worker: PredictionWorker, made: list[Echo], query: GraspQuery) -> None:
    running = worker.submit(query)
    assert made[0].entered.acquire(timeout=30)
    waiting = worker.submit(query)
    stopping = threading.Thread(target=worker.stop)
    stopping.start()
    with pytest.raises(CancelledError):
        waiting.future.result(30)
    made[0].gate.set()
    assert running.future.result(30) is not None
    stopping.join(30)
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
        _ = worker.model
    worker.start()
    assert failed.wait(30)
    assert worker.state == "failed"
    assert str(failures[0]) == "no weights"
    with pytest.raises(NotReady, match="failed"):
        worker.submit(query)
    worker.stop()
