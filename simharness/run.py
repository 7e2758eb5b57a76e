"""A whole run: worker processes play rounds, this process writes them down.

The service may be anywhere; with no address given, one is started for the run. Workers share nothing and each round is
played in a world of its own, so their number changes no result.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from simharness.errors import RunBroken, SimError
from simharness.folder import SERVICE_LOG, RunFolder
from simharness.objects import ObjectModel
from simharness.photographer import Photographer
from simharness.planner import HttpPlanner
from simharness.records import ModelRecord, RoundRecord, RunSettings, Serving
from simharness.round import Attempted, Observed, play_round
from simharness.server import NUM_THREADS, LocalService

_LOOK_AFTER_SERVICE_S = 1.0
_WORKER_STOPS_WITHIN_S = 5.0


@dataclass(frozen=True, slots=True)
class Run:
    """A run under way or over.

    Args:
        model: the network that answered; None until it was asked.
        serving: where; None until it was asked.
        rounds: the finished rounds by seed and number.
        stopped_by: what broke the run off; None when it was not.
    """

    settings: RunSettings
    workers: int
    model: ModelRecord | None
    serving: Serving | None
    rounds: tuple[RoundRecord, ...]
    stopped_by: str | None

    @property
    def complete(self) -> bool:
        """Whether every round was played."""
        return len(self.rounds) == len(self.settings.seeds) * self.settings.rounds


@dataclass(frozen=True, slots=True)
class Hooks:
    """What a run tells its caller as it happens.

    Args:
        started: once, with the rounds that an earlier run had finished.
        round_done: after each round.
        event: each observation and attempt; None when nobody watches, which saves sending them.
    """

    started: Callable[[Sequence[RoundRecord]], None]
    round_done: Callable[[RoundRecord], None]
    event: Callable[[Observed | Attempted], None] | None = None


def run(
    settings: RunSettings,
    objects: tuple[ObjectModel, ...],
    folder: RunFolder,
    *,
    workers: int,
    url: str | None,
    resume: bool,
    hooks: Hooks,
) -> Run:
    """Play every round that the folder does not hold yet; a run that breaks off comes back with what was done.

    Args:
        settings: what decides the results.
        objects: the object set.
        folder: where the rounds go.
        workers: processes that play rounds.
        url: the service; None starts one for the run.
        resume: whether to continue what the folder holds.
        hooks: who is told.

    Raises:
        UsageError: the folder, the address or the model's name cannot be used, or the recorded run was another.
    """
    done = {(record.seed, record.round): record for record in folder.prepare(settings, resume)}
    todo = deque(
        (seed, number) for seed in settings.seeds for number in range(settings.rounds) if (seed, number) not in done
    )
    model: ModelRecord | None = None
    serving: Serving | None = None
    stopped_by = None
    try:
        if todo:
            with ExitStack() as stack:
                service = (
                    stack.enter_context(LocalService(settings.model, folder.path / SERVICE_LOG))
                    if url is None
                    else None
                )
                address = service.url if service is not None else str(url)
                with HttpPlanner(address, settings.model, settings.max_grasps) as planner:
                    model, document = planner.model()
                serving = Serving(url, NUM_THREADS if service is not None else None, document.get("device"))
                folder.start(settings, model, serving)
                hooks.started(tuple(done.values()))
                task = _Task(settings, objects, address, folder, hooks.event is not None)
                for message in _play_in_workers(task, todo, min(workers, len(todo)), service):
                    if isinstance(message, RoundRecord):
                        folder.append(message)
                        done[message.seed, message.round] = message
                        hooks.round_done(message)
                    elif hooks.event is not None:
                        hooks.event(message)
        else:
            _, model, serving = folder.read_run()
            hooks.started(tuple(done.values()))
    except RunBroken as error:
        stopped_by = str(error)
    except KeyboardInterrupt:
        stopped_by = "interrupted"
    rounds = tuple(done[key] for key in sorted(done))
    folder.rewrite(rounds)
    return Run(settings, workers, model, serving, rounds, stopped_by)


@dataclass(frozen=True, slots=True)
class _Task:
    """What a worker needs to play any round."""

    settings: RunSettings
    objects: tuple[ObjectModel, ...]
    url: str
    folder: RunFolder
    watched: bool


@dataclass(slots=True)
class _Worker:
    """A worker process and the round it was given last."""

    process: BaseProcess
    connection: Connection
    playing: tuple[int, int] | None = None


_Message = tuple[Literal["event", "round", "broken"], Any]


def _play_in_workers(
    task: _Task, todo: deque[tuple[int, int]], count: int, service: LocalService | None
) -> Iterator[RoundRecord | Observed | Attempted]:
    """Rounds (and events, where they are wanted) as they come.

    Raises:
        RunBroken: the service or a worker failed.
    """
    with _workers(task, count) as workers:
        for worker in workers:
            _give(worker, todo)
        while busy := [worker for worker in workers if worker.playing is not None]:
            ready = wait([worker.connection for worker in busy], timeout=_LOOK_AFTER_SERVICE_S)
            if not ready and service is not None and service.died is not None:
                raise RunBroken(service.died)
            for worker in busy:
                if worker.connection not in ready:
                    continue
                kind, content = _receive(worker)
                if kind == "broken":
                    raise RunBroken(f"{service.died or content}" if service is not None else content)
                if kind == "round":
                    _give(worker, todo)
                yield content


def _give(worker: _Worker, todo: deque[tuple[int, int]]) -> None:
    worker.playing = todo.popleft() if todo else None
    if worker.playing is not None:
        try:
            worker.connection.send(worker.playing)
        except OSError:
            raise RunBroken(_how_it_ended(worker)) from None


def _receive(worker: _Worker) -> _Message:
    try:
        message: _Message = worker.connection.recv()
    except (EOFError, OSError):
        raise RunBroken(_how_it_ended(worker)) from None
    return message


def _how_it_ended(worker: _Worker) -> str:
    worker.process.join(_WORKER_STOPS_WITHIN_S)
    code = worker.process.exitcode
    how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
    where = "" if worker.playing is None else f" in round {worker.playing[1]} of seed {worker.playing[0]}"
    return f"a worker process {how}{where}; --resume continues the run"


@contextmanager
def _workers(task: _Task, count: int) -> Iterator[list[_Worker]]:
    """Processes that end with the context, however it is left."""
    context = multiprocessing.get_context("spawn")
    workers: list[_Worker] = []
    try:
        for number in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, task), name=f"round-worker-{number}", daemon=True)
            process.start()
            # Without our copy of its end, a dead worker's pipe reports the end of the file.
            theirs.close()
            workers.append(_Worker(process, ours))
        yield workers
    finally:
        for worker in workers:
            worker.connection.close()
            if worker.playing is not None:
                worker.process.terminate()
        for worker in workers:
            worker.process.join(_WORKER_STOPS_WITHIN_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()


def _work(connection: Connection, task: _Task) -> None:
    """A worker's life: rounds until the other end of the pipe is closed, by its owner or by its owner's death."""
    # Ctrl-C reaches every process of the terminal; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    photographer = Photographer(task.settings, task.folder.pictures)

    def listen(event: Observed | Attempted) -> None:
        photographer(event)
        if task.watched:
            connection.send(("event", event))

    try:
        with HttpPlanner(task.url, task.settings.model, task.settings.max_grasps) as planner:
            while True:
                seed, number = connection.recv()
                try:
                    segmentation = task.watched or photographer.wants(seed, number)
                    record = play_round(
                        task.settings, task.objects, planner, seed, number, listen, segmentation=segmentation
                    )
                except SimError as error:
                    connection.send(("broken", f"round {number} of seed {seed}: {error}"))
                    return
                connection.send(("round", record))
    except (EOFError, BrokenPipeError):
        return
