"""Workers that carry out independent jobs: processes on this machine, or actors on a Ray cluster.

It knows nothing of rounds or scenes. Which worker does a job, and when, must change no result; on a cluster a job whose
worker died is even done again.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from simharness.errors import RunBroken, SimError, UsageError

if TYPE_CHECKING:
    from ray import ObjectRef
    from ray.actor import ActorHandle

_STOPS_WITHIN_S = 5.0
_ANSWERS_WITHIN_S = 5.0
_RESTARTS = 3
"""How often Ray replaces a worker that died, with the job it was at."""

Job = TypeVar("Job")
Job_contra = TypeVar("Job_contra", contravariant=True)
Emit = Callable[[Any], None]
Work = Callable[[Job, Emit], Any]


class Task(Protocol[Job_contra]):
    """What the workers of a crew do. It is sent to them, so it can be pickled."""

    def name(self, job: Job_contra) -> str:
        """A job in words, for messages."""
        ...

    def begin(self) -> AbstractContextManager[Work[Job_contra]]:
        """Make a worker ready, in its process. `work(job, emit)` then does a job; `emit` tells what happens meanwhile.

        Raises:
            SimError: from here or from a job; it breaks the run with its message.
        """
        ...


@dataclass(frozen=True, slots=True)
class Event:
    """What a job emitted."""

    content: Any


@dataclass(frozen=True, slots=True)
class Done(Generic[Job]):
    """A job is done."""

    job: Job
    result: Any


class Crew(Protocol[Job]):
    """Workers at work."""

    def give(self, job: Job) -> None:
        """Add a job; a free worker begins it at once, else the next that is free.

        Raises:
            RunBroken: a worker ended.
        """
        ...

    def hear(self, timeout: float) -> Sequence[Event | Done[Job]]:
        """What the workers say next; nothing when they are silent for `timeout` seconds.

        Raises:
            RunBroken: a job failed, or a worker ended.
        """
        ...


def crew(task: Task[Job], count: int, ray: str | None) -> AbstractContextManager[Crew[Job]]:
    """A crew of `count` workers; they end with the context, however it is left.

    Args:
        task: what they do.
        count: how many.
        ray: address of a Ray cluster, of which each worker takes one CPU; None for processes on this machine.

    Raises:
        UsageError: there is no cluster at the address.
    """
    return _processes(task, count) if ray is None else _actors(task, count, ray)


# Processes on this machine


@dataclass(slots=True)
class _Process(Generic[Job]):
    """A worker process and the job it was given last."""

    process: BaseProcess
    connection: Connection
    job: Job | None = None


class _Processes(Generic[Job]):
    """A crew of processes."""

    def __init__(self, task: Task[Job], workers: list[_Process[Job]]) -> None:
        self._task = task
        self._workers = workers
        self._waiting: deque[Job] = deque()

    def give(self, job: Job) -> None:
        self._waiting.append(job)
        for worker in self._workers:
            if worker.job is None:
                self._hand_out(worker)
                break

    def hear(self, timeout: float) -> list[Event | Done[Job]]:
        busy = [worker for worker in self._workers if worker.job is not None]
        ready = wait([worker.connection for worker in busy], timeout=timeout)
        return [self._receive(worker) for worker in busy if worker.connection in ready]

    def _hand_out(self, worker: _Process[Job]) -> None:
        worker.job = self._waiting.popleft() if self._waiting else None
        if worker.job is not None:
            try:
                worker.connection.send(worker.job)
            except OSError:
                raise RunBroken(self._how_it_ended(worker)) from None

    def _receive(self, worker: _Process[Job]) -> Event | Done[Job]:
        try:
            message: Event | Done[Job] | RunBroken = worker.connection.recv()
        except (EOFError, OSError):
            raise RunBroken(self._how_it_ended(worker)) from None
        if isinstance(message, RunBroken):
            raise message
        if isinstance(message, Done):
            self._hand_out(worker)
        return message

    def _how_it_ended(self, worker: _Process[Job]) -> str:
        worker.process.join(_STOPS_WITHIN_S)
        code = worker.process.exitcode
        how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
        where = "" if worker.job is None else f" in {self._task.name(worker.job)}"
        return f"a worker process {how}{where}; --resume continues the run"


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Libraries of the processes that are started inside compute with one thread, unless the user chose otherwise.

    The workers are there to use the cores. NumPy's threads would only wait for each other, and do so by spinning: two
    workers on two cores rendered scenes three times slower with them.
    """
    added = [name for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS") if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that are started inside inherit a blocked SIGINT: Ctrl-C does not end one that still imports modules.

    Our own waits meanwhile.
    """
    resource_tracker.ensure_running()  # it unblocks the signal when it starts, which the first process would have it do
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _processes(task: Task[Job], count: int) -> Iterator[_Processes[Job]]:
    context = multiprocessing.get_context("spawn")
    workers: list[_Process[Job]] = []
    try:
        with _one_thread_each(), _deaf_to_ctrl_c():
            for number in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_live, args=(theirs, task), name=f"worker-{number}", daemon=True)
                process.start()
                # Without our copy of its end, a dead worker's pipe reports the end of the file.
                theirs.close()
                workers.append(_Process(process, ours))
        yield _Processes(task, workers)
    finally:
        for worker in workers:
            worker.connection.close()
            if worker.job is not None:
                worker.process.terminate()
        for worker in workers:
            worker.process.join(_STOPS_WITHIN_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()


def _live(connection: Connection, task: Task[Any]) -> None:
    """A worker's life: jobs until the other end of the pipe is closed, by its owner or by its owner's death."""
    # Ctrl-C reaches every process of the terminal; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        try:
            with task.begin() as work:
                while True:
                    job = connection.recv()
                    connection.send(Done(job, work(job, lambda content: connection.send(Event(content)))))
        except SimError as error:
            connection.send(RunBroken(str(error)))
    except (EOFError, BrokenPipeError):
        return


# Actors on a Ray cluster


class _Actor:
    """What runs on the cluster: one worker, ready when its first job comes."""

    def __init__(self, task: Task[Any]) -> None:
        self._task = task
        self._stack = ExitStack()
        self._work: Work[Any] | None = None

    def arrived(self) -> list[Any]:
        """Nothing to say, which is heard when the cluster has found a place for the worker."""
        return []

    def do(self, job: Any) -> list[Event | Done[Any] | RunBroken]:
        """Everything that a job emits, and its result at the end."""
        heard: list[Event | Done[Any] | RunBroken] = []
        try:
            self._work = self._work or self._stack.enter_context(self._task.begin())
            heard.append(Done(job, self._work(job, lambda content: heard.append(Event(content)))))
        except SimError as error:
            heard.append(RunBroken(str(error)))
        return heard

    def end(self) -> None:
        """Give back what `begin` took."""
        self._stack.close()


class _Actors(Generic[Job]):
    """A crew of Ray actors. One that the cluster has no place for yet is given no job."""

    def __init__(self, task: Task[Job], actors: Sequence[ActorHandle[_Actor]]) -> None:
        self._task = task
        self._busy: dict[ObjectRef[Any], tuple[ActorHandle[_Actor], Job | None]] = {
            actor.arrived.remote(): (actor, None) for actor in actors
        }
        self._free: list[ActorHandle[_Actor]] = []
        self._waiting: deque[Job] = deque()

    def give(self, job: Job) -> None:
        self._waiting.append(job)
        self._hand_out()

    def hear(self, timeout: float) -> list[Event | Done[Job]]:
        import ray  # noqa: PLC0415 - an optional dependency
        from ray.exceptions import RayError  # noqa: PLC0415 - the same

        heard: list[Event | Done[Job] | RunBroken] = []
        for said in ray.wait(list(self._busy), timeout=timeout)[0]:
            actor, job = self._busy.pop(said)
            try:
                heard += ray.get(said)
            except RayError as error:
                where = "" if job is None else f" in {self._task.name(job)}"
                raise RunBroken(
                    f"a worker on the cluster failed{where}: {error}; --resume continues the run"
                ) from error
            self._free.append(actor)
        self._hand_out()
        for message in heard:
            if isinstance(message, RunBroken):
                raise message
        return [message for message in heard if not isinstance(message, RunBroken)]

    def _hand_out(self) -> None:
        while self._free and self._waiting:
            actor, job = self._free.pop(), self._waiting.popleft()
            self._busy[actor.do.remote(job)] = (actor, job)


@contextmanager
def _actors(task: Task[Job], count: int, address: str) -> Iterator[_Actors[Job]]:
    try:
        import ray  # noqa: PLC0415 - an optional dependency
    except ModuleNotFoundError:
        raise UsageError("--ray needs Ray: pip install 'tes-net[ray]'") from None
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _check_listens(address)
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, runtime_env={"env_vars": _settings_of_the_service(os.environ)})
    except (ConnectionError, ValueError) as error:
        raise UsageError(f"--ray {address}: {error}") from error
    try:
        signal.signal(signal.SIGTERM, on_sigterm)  # Ray's own would end the process before the run is written down
        worker: Any = ray.remote(num_cpus=1, max_restarts=_RESTARTS, max_task_retries=_RESTARTS)(_Actor)
        actors: list[ActorHandle[_Actor]] = [worker.remote(task) for _ in range(count)]
        try:
            yield _Actors(task, actors)
        finally:
            ended: list[ObjectRef[None]] = [actor.end.remote() for actor in actors]
            ray.wait(ended, num_returns=count, timeout=_STOPS_WITHIN_S)
    finally:
        ray.shutdown()  # which ends the actors


def _check_listens(address: str) -> None:
    """Whether anything listens at HOST:PORT, which Ray would try for minutes; other addresses are Ray's to judge.

    Raises:
        UsageError: nothing does.
    """
    host, _, port = address.rpartition(":")
    if host and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout=_ANSWERS_WITHIN_S).close()
        except (OSError, OverflowError) as error:
            why = f"no cluster answers there ({error}); start one with `ray start`"
            raise UsageError(f"--ray {address}: {why}") from error


def _settings_of_the_service(environment: Mapping[str, str]) -> dict[str, str]:
    """Variables that decide what a service answers that a worker starts."""
    return {name: value for name, value in environment.items() if name.startswith("GRASP_")}
