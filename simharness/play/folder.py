"""The folder a run leaves behind, and how a broken-off run is found again.

`run.json` holds what decides the results, `rounds.jsonl` one line for each finished round, `attempts.jsonl` one for
each attempt. A round's attempts are written before its own line, so that a round counts only when all of it is there.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from simharness.errors import UsageError
from simharness.play.records import AttemptRecord, ModelRecord, RoundRecord, Serving
from simharness.play.settings import RunSettings
from tesnet.whole_file import write_whole

T = TypeVar("T")

RUN_FILE = "run.json"
ROUNDS_FILE = "rounds.jsonl"
ATTEMPTS_FILE = "attempts.jsonl"
REPORT_FILE = "report.json"
PAGE_FILE = "report.html"
FAILURES_FILE = "failures.json"
SERVICE_LOG = "service.log"
PICTURES = "pictures"


class RunFolder:
    """A run's files.

    Args:
        path: the folder; made by `prepare`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    # Starting and continuing

    def make(self, inside: str = ".") -> None:
        """Make the folder, or one inside it, unless it is there.

        Raises:
            UsageError: it cannot be written.
        """
        try:
            self._file(inside).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--out {self.path}: {error.strerror}; give a folder that can be written") from error

    def prepare(self, settings: RunSettings, resume: bool) -> list[RoundRecord]:
        """Make the folder ready for a run and return the rounds that are already done.

        Without `resume` the files of an earlier run are moved to a subfolder `earlier-N`.

        Raises:
            UsageError: the folder cannot be written, or `resume` meets a run with other settings.
        """
        self.make(PICTURES)
        if not self._file(RUN_FILE).exists():
            return []
        if not resume:
            self._set_aside()
            return []
        recorded = self.read_run()[0].to_json()
        changes = "; ".join(
            f"{name} was {recorded[name]!r}, now {value!r}"
            for name, value in settings.to_json().items()
            if recorded[name] != value
        )
        if changes:
            raise UsageError(
                f"--resume {self.path}: the recorded run has other settings ({changes}); "
                "repeat them or give another --out"
            )
        done = self.read_rounds()
        self.rewrite(done)
        return done

    def start(self, settings: RunSettings, model: ModelRecord, serving: Serving) -> None:
        """Write down what decides the results, and where answers come from, which does not.

        Raises:
            UsageError: the folder's rounds were played with other weights or by another version of the harness.
        """
        version = metadata.version("tes-net")
        if self._file(RUN_FILE).exists():
            _, recorded, _, played_by = self._recorded()
            if played_by not in (None, version):
                raise UsageError(
                    f"--resume {self.path}: version {played_by} played its rounds, this is {version}, whose rounds are "
                    "not the same; give another --out"
                )
            if recorded != model:
                differing = [name for name, value in asdict(model).items() if asdict(recorded)[name] != value]
                raise UsageError(
                    f"--resume {self.path}: the service's model has another {', '.join(differing)} than the recorded "
                    f"one (was {recorded}, now {model}); serve the same weights or give another --out"
                )
        content = {"settings": settings.to_json(), "model": asdict(model), "serving": asdict(serving)}
        self.write_json(RUN_FILE, {**content, "version": version})

    # Reading

    def is_complete(self, settings: RunSettings) -> bool:
        """Whether every round of a run lies here."""
        return self._file(RUN_FILE).exists() and len(self.read_rounds()) >= settings.rounds * len(settings.seeds)

    def read_run(self) -> tuple[RunSettings, ModelRecord, Serving]:
        """Settings, model and service of the recorded run.

        Raises:
            UsageError: there is none, or it cannot be read.
        """
        return self._recorded()[:3]

    def _recorded(self) -> tuple[RunSettings, ModelRecord, Serving, str | None]:
        """The same, and the version that played it; None of older versions, which did not say."""
        try:
            values = json.loads(self._file(RUN_FILE).read_text(encoding="utf-8"))
            settings = RunSettings.from_json(values["settings"])
            model, serving = ModelRecord(**values["model"]), Serving(**values["serving"])
            return settings, model, serving, values.get("version")
        except (FileNotFoundError, NotADirectoryError):
            raise UsageError(f"{self.path} holds no run ({RUN_FILE} is missing); give the --out of a run") from None
        except (ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{self._file(RUN_FILE)} cannot be read ({error}); give another --out") from error

    def read_rounds(self) -> list[RoundRecord]:
        """Every round that was written completely, by seed and number.

        Lines that a crash cut short, and rounds that miss an attempt, are left out: they are played again.
        """
        attempts: dict[tuple[int, int], dict[int, AttemptRecord]] = defaultdict(dict)
        for attempt in _whole(self._file(ATTEMPTS_FILE), AttemptRecord.from_json):
            attempts[attempt.seed, attempt.round][attempt.attempt] = attempt

        def with_attempts(values: Mapping[str, Any]) -> RoundRecord:
            played = attempts[values["seed"], values["round"]]
            return RoundRecord.from_json(values, tuple(played[number] for number in range(values["attempts"])))

        rounds = {(record.seed, record.round): record for record in _whole(self._file(ROUNDS_FILE), with_attempts)}
        return [rounds[key] for key in sorted(rounds)]

    # Writing

    def append(self, record: RoundRecord) -> None:
        """Add a finished round; it is on the disk when this returns."""
        _append(self._file(ATTEMPTS_FILE), (attempt.to_json() for attempt in record.attempts))
        _append(self._file(ROUNDS_FILE), [record.to_json()])

    def add_picture(self, name: str, content: bytes) -> None:
        """Add a picture of an attempt."""
        (self.pictures / name).write_bytes(content)

    def rewrite(self, rounds: Iterable[RoundRecord]) -> None:
        """Replace both files by `rounds` in the order of seed, round and attempt."""
        ordered = sorted(rounds, key=lambda record: (record.seed, record.round))
        attempts = [attempt.to_json() for record in ordered for attempt in record.attempts]
        self.write_text(ATTEMPTS_FILE, _lines(attempts))
        self.write_text(ROUNDS_FILE, _lines(record.to_json() for record in ordered))

    def write_json(self, name: str, values: Mapping[str, Any]) -> None:
        """Write one JSON file, whole or not at all."""
        self.write_text(name, json.dumps(values, indent=1, allow_nan=False) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write one text file, whole or not at all."""
        write_whole(self._file(name), text.encode())

    @property
    def pictures(self) -> Path:
        """Where the pictures of attempts lie."""
        return self.path / PICTURES

    def _file(self, name: str) -> Path:
        return self.path / name

    def _set_aside(self) -> None:
        number = 1
        while (target := self.path / f"earlier-{number}").exists():
            number += 1
        target.mkdir()
        files = (RUN_FILE, ROUNDS_FILE, ATTEMPTS_FILE, REPORT_FILE, PAGE_FILE, FAILURES_FILE, SERVICE_LOG, PICTURES)
        for name in files:
            if self._file(name).exists():
                self._file(name).rename(target / name)
        self.pictures.mkdir()


def _whole(path: Path, parse: Callable[[Any], T]) -> Iterator[T]:
    """What the lines of a file hold, without those that a crash cut short."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for line in lines:
        with suppress(KeyError, TypeError, ValueError):
            yield parse(json.loads(line))


def _lines(values: Iterable[Mapping[str, Any]]) -> str:
    return "".join(json.dumps(value, allow_nan=False) + "\n" for value in values)


def _append(path: Path, values: Iterable[Mapping[str, Any]]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(_lines(values))
        file.flush()
        os.fsync(file.fileno())
