"""Crews of processes; those on a Ray cluster are in tests/test_ray_cluster.py."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from simharness.errors import RunBroken, SimError, UsageError
from simharness.play import crew as crew_module
from simharness.play.crew import Crew, Done, Emit, Event, Work, crew


@dataclass(frozen=True)
class Squares:
    """Squares numbers; 13 is refused, 99 kills."""

    offset: int = 0

    def name(self, job: int) -> str:
        return f"the square of {job}"

    @contextmanager
    def begin(self) -> Iterator[Work[int]]:
        if self.offset < 0:
            raise SimError("the offset is negative")

        def work(job: int, emit: Emit) -> int:
            emit(f"began {job}")
            if job == 13:
                raise SimError("13 has no square here")
            if job == 99:
                os.kill(os.getpid(), signal.SIGKILL)
            return job**2 + self.offset

        yield work


def hear(workers: Crew[int], results: int) -> tuple[dict[int, int], list[Any]]:
    done: dict[int, int] = {}
    events = []
    while len(done) < results:
        for message in workers.hear(60):
            if isinstance(message, Done):
                done[message.job] = message.result
            else:
                assert isinstance(message, Event)
                events.append(message.content)
    return done, events


def test_every_job_is_done_and_what_it_emits_is_heard() -> None:
    with crew(Squares(1), 2, None) as workers:
        for job in range(5):
            workers.give(job)
        done, events = hear(workers, 5)
        assert done == {job: job**2 + 1 for job in range(5)}
        assert sorted(events) == [f"began {job}" for job in range(5)]
        assert workers.hear(0) == []
        workers.give(7)
        assert hear(workers, 1)[0] == {7: 50}


@dataclass(frozen=True)
class NeverReady:
    """Takes an hour to begin."""

    def name(self, job: int) -> str:
        return f"job {job}"

    @contextmanager
    def begin(self) -> Iterator[Work[int]]:
        time.sleep(3600)
        yield lambda job, emit: job


def test_a_worker_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew_module, "_STOPS_WITHIN_S", 0.2)
    with crew(NeverReady(), 1, None):
        assert multiprocessing.active_children()
    assert not multiprocessing.active_children()


def test_ctrl_c_does_not_end_a_worker_that_still_imports() -> None:
    with crew(Squares(), 2, None) as workers:
        young = multiprocessing.active_children()
        for _ in range(3):
            for process in young:
                os.kill(process.pid or 0, signal.SIGINT)
        for job in (2, 3):
            workers.give(job)
        assert hear(workers, 2)[0] == {2: 4, 3: 9}
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize(
    ("task", "job", "words"),
    [
        (Squares(), 13, "13 has no square here"),
        (Squares(-1), 1, "the offset is negative"),
        (Squares(), 99, "was killed by signal 9 in the square of 99; --resume continues the run"),
    ],
)
def test_a_job_or_worker_that_fails_breaks_the_run_and_says_how(task: Squares, job: int, words: str) -> None:
    with crew(task, 1, None) as workers:
        workers.give(job)
        with pytest.raises(RunBroken, match=words):
            hear(workers, 1)


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:9", "127.0.0.1:99999"])
def test_an_address_that_is_no_clusters_is_named(address: str) -> None:
    with pytest.raises(UsageError, match=f"--ray {address}: "), crew(Squares(), 1, address):
        pass


@pytest.mark.parametrize("chosen", [None, "3"])
def test_workers_compute_with_one_thread_unless_the_user_chose(
    chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    if chosen is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
    with crew_module._one_thread_each():
        assert os.environ["OMP_NUM_THREADS"] == (chosen or "1")
        assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ.get("OMP_NUM_THREADS") == chosen
    assert "OPENBLAS_NUM_THREADS" not in os.environ
