"""A whole run: workers play rounds, this process writes them down.

The service may be anywhere; with no address given, one is started for the run. Workers share nothing and each round is
played in a world of its own, so their number changes no result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from simharness.errors import RunBroken, SimError, UsageError
from simharness.play.crew import Crew, Done, Emit, Event, Work, crew
from simharness.play.folder import SERVICE_LOG, RunFolder
from simharness.play.photographer import Photographer, Picture
from simharness.play.planner import HttpPlanner
from simharness.play.records import ModelRecord, RoundRecord, Run, Serving
from simharness.play.round import Attempted, Observed, play_round
from simharness.play.server import NUM_THREADS, LocalService
from simharness.play.settings import RunSettings
from simharness.sim.objects import ObjectModel

_LOOK_AFTER_SERVICE_S = 1.0

_RoundKey = tuple[int, int]
"""A run seed and a round's number."""


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
    ray: str | None = None,
    resume: bool,
    hooks: Hooks,
    weights: Path | None = None,
) -> Run:
    """Play every round that the folder does not hold yet; a run that breaks off comes back with what was done.

    Args:
        settings: what decides the results.
        objects: the object set.
        folder: where the rounds go.
        workers: processes that play rounds.
        ray: address of a Ray cluster that they run on; None for this machine.
        url: the service; None starts one for the run.
        resume: whether to continue what the folder holds.
        hooks: who is told.
        weights: file of the model, for services that are started; None for the one that they would load by themselves.

    Raises:
        UsageError: the folder, the address or the model's name cannot be used, or the recorded run was another.
    """
    log = _Log(settings, folder, hooks, resume=resume)
    stopped_by = None
    try:
        if log.todo:
            _play(log, settings, objects, workers, url, ray, weights, watched=hooks.event is not None)
        else:
            log.reopen()
    except RunBroken as error:
        stopped_by = str(error)
    except KeyboardInterrupt:
        stopped_by = "interrupted"
    return Run(settings, workers, log.model, log.serving, log.close(), stopped_by)


class _Log:
    """A run's folder and listeners while it is played: what is done, what is left, and who answers.

    Args:
        settings: of the run.
        folder: where everything is written down.
        hooks: who is told.
        resume: whether the folder's rounds count.

    Raises:
        UsageError: the folder cannot be used, or the recorded run was another.
    """

    def __init__(self, settings: RunSettings, folder: RunFolder, hooks: Hooks, *, resume: bool) -> None:
        self._settings = settings
        self._folder = folder
        self._hooks = hooks
        self._done = {(record.seed, record.round): record for record in folder.prepare(settings, resume)}
        self.model: ModelRecord | None = None
        self.serving: Serving | None = None

    @property
    def service_log(self) -> Path:
        """File for the output of a service that is started for the run."""
        return self._folder.path / SERVICE_LOG

    @property
    def todo(self) -> list[_RoundKey]:
        """The rounds that are left, in order."""
        keys = [(seed, number) for seed in self._settings.seeds for number in range(self._settings.rounds)]
        return [key for key in keys if key not in self._done]

    def open(self, model: ModelRecord, serving: Serving) -> None:
        """Begin to play, with who answers.

        Raises:
            UsageError: the folder's rounds were played with other weights.
        """
        self.model, self.serving = model, serving
        self._folder.start(self._settings, model, serving)
        self._hooks.started(tuple(self._done.values()))

    def reopen(self) -> None:
        """Nothing is left to play; who answered is what the folder says."""
        _, self.model, self.serving = self._folder.read_run()
        self._hooks.started(tuple(self._done.values()))

    def take(self, message: RoundRecord | Picture | Observed | Attempted) -> None:
        """What a worker said: a finished round, or something on the way to one."""
        if isinstance(message, RoundRecord):
            self._done[message.seed, message.round] = message  # first: `close` writes it where Ctrl-C comes between
            self._folder.append(message)
            self._hooks.round_done(message)
        elif isinstance(message, Picture):
            self._folder.add_picture(message.name, message.content)
        elif self._hooks.event is not None:
            self._hooks.event(message)

    def close(self) -> tuple[RoundRecord, ...]:
        """Put the files in the order of seeds and rounds, in which rounds seldom finish; the finished rounds."""
        records = tuple(self._done[key] for key in sorted(self._done))
        self._folder.rewrite(records)
        return records


def _play(
    log: _Log,
    settings: RunSettings,
    objects: tuple[ObjectModel, ...],
    workers: int,
    url: str | None,
    ray: str | None,
    weights: Path | None,
    *,
    watched: bool,
) -> None:
    """Play the rounds that are left.

    Raises:
        RunBroken: the service or a worker failed.
        UsageError: the address or the model's name cannot be used, or other weights played the folder's rounds.
    """
    todo = log.todo
    with ExitStack() as stack:
        service = None
        if url is None:
            service = stack.enter_context(LocalService(settings.model, log.service_log, weights=weights))
        address = service.url if service is not None else str(url)
        with _planner(address, settings) as planner:
            model, document = planner.model()
        log.open(model, Serving(url, NUM_THREADS if service is not None else None, document.get("device")))
        # On a cluster nobody reaches this machine's service, so workers there have their own.
        task = _Rounds(settings, objects, address if ray is None else url, model, watched, weights)
        rounds = stack.enter_context(crew(task, min(workers, len(todo)), ray))
        for message in _messages(rounds, todo, service):
            log.take(message)


def check_that_it_answers(settings: RunSettings, url: str | None, weights: Path | None, log: Path) -> None:
    """Make sure that a run would find its network, before anything is played.

    Args:
        settings: of the run.
        url: the service; None starts one, as the run would.
        weights: file of the model for a service that is started.
        log: file for its output.

    Raises:
        RunBroken: the service at `url` does not answer.
        UsageError: it has no such network, or none can be started with it.
    """
    with ExitStack() as stack:
        if url is None:
            try:
                url = stack.enter_context(LocalService(settings.model, log, weights=weights)).url
            except RunBroken as error:
                asked = settings.model if weights is None else f"{settings.model}={weights}"
                raise UsageError(f"{asked} cannot be played: {error}") from error
        stack.enter_context(_planner(url, settings)).model()


def _planner(url: str, settings: RunSettings) -> HttpPlanner:
    return HttpPlanner(
        url,
        settings.model,
        settings.max_grasps,
        gripper=settings.gripper,
        calibrate=bool(settings.calibrate),
        min_score=settings.min_score,
    )


@dataclass(frozen=True, slots=True)
class _Rounds:
    """What a worker needs to play any round.

    Args:
        settings, objects: of the run.
        url: the service; None where each worker has one of its own.
        model: the network that must answer.
        watched: whether every observation and attempt is wanted.
        weights: file of the model, for a service of the worker's own.
    """

    settings: RunSettings
    objects: tuple[ObjectModel, ...]
    url: str | None
    model: ModelRecord
    watched: bool
    weights: Path | None = None

    def name(self, job: _RoundKey) -> str:
        """A round in words."""
        seed, number = job
        return f"round {number} of seed {seed}"

    @contextmanager
    def begin(self) -> Iterator[Work[_RoundKey]]:
        """A planner and what plays rounds with it.

        Raises:
            RunBroken: a service of the worker's own does not start, or serves another network.
        """
        photographer = Photographer(self.settings)
        with ExitStack() as stack:
            planner = stack.enter_context(_planner(self._service(stack), self.settings))
            self._check(planner)

            def play(job: _RoundKey, emit: Emit) -> RoundRecord:
                def listen(event: Observed | Attempted) -> None:
                    for picture in photographer(event):
                        emit(picture)
                    if self.watched:
                        emit(event)

                segmentation = self.watched or photographer.wants(*job)
                try:
                    return play_round(self.settings, self.objects, planner, *job, listen, segmentation=segmentation)
                except SimError as error:
                    raise RunBroken(f"{self.name(job)}: {error}") from error

            yield play

    def _service(self, stack: ExitStack) -> str:
        """URL of the service that the worker asks."""
        if self.url is not None:
            return self.url
        folder = stack.enter_context(TemporaryDirectory(prefix="simharness-"))
        log = Path(folder) / SERVICE_LOG
        return stack.enter_context(LocalService(self.settings.model, log, weights=self.weights)).url

    def _check(self, planner: HttpPlanner) -> None:
        if self.url is None and (model := planner.model()[0]) != self.model:
            raise RunBroken(
                f"a worker's service has another model than this machine's ({model}, here {self.model}); install the "
                "same version and weights on every machine of the cluster"
            )


def _messages(rounds: Crew[_RoundKey], todo: Sequence[_RoundKey], service: LocalService | None) -> Iterator[Any]:
    """Records of the rounds, and what was emitted on the way, as they come.

    Raises:
        RunBroken: the service or a worker failed.
    """
    for job in todo:
        rounds.give(job)
    left = len(todo)
    while left:
        for message in _hear(rounds, service):
            left -= isinstance(message, Done)
            yield message.result if isinstance(message, Done) else message.content


def _hear(rounds: Crew[_RoundKey], service: LocalService | None) -> Sequence[Event | Done[_RoundKey]]:
    """What the workers say next.

    Raises:
        RunBroken: a worker failed, or the service, which is then the one whose last words are told.
    """
    try:
        heard = rounds.hear(_LOOK_AFTER_SERVICE_S)
    except RunBroken as error:
        raise RunBroken((service.died if service is not None else None) or str(error)) from error
    if not heard and service is not None and service.died is not None:
        raise RunBroken(service.died)
    return heard
