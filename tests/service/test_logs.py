"""The log's own thread: what cannot be written is lost, counted and told; nobody waits for it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from service import logs
from service.logs import BackgroundHandler, JsonFormatter


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    logger = logging.getLogger("tests.log")
    logger.propagate = False
    yield logger
    for handler in list(logger.handlers):
        logger.removeHandler(handler)
        handler.close()


def attach(logger: logging.Logger, descriptor: int) -> BackgroundHandler:
    handler = BackgroundHandler(descriptor)
    handler.setFormatter(JsonFormatter())
    logger.addHandler(handler)
    return handler


def fill(pipe: int) -> None:
    """Write empty lines until no byte more goes in."""
    os.set_blocking(pipe, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(pipe, b"\n")
    os.set_blocking(pipe, True)


def test_lines_arrive_whole_and_in_order(logger: logging.Logger, tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb") as file:
        handler = attach(logger, file.fileno())
        for number in range(100):
            logger.warning("line", extra={"fields": {"number": number, "path": tmp_path}})
        handler.close()
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert [line["number"] for line in lines] == list(range(100))
    assert {line["path"] for line in lines} == {str(tmp_path)}


def test_a_reader_that_stopped_costs_lines_which_are_counted_when_it_goes_on(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch, eventually: Callable[[Callable[[], bool]], None]
) -> None:
    monkeypatch.setattr(logs, "QUEUED_BYTES", 2000)
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    fill(writing)
    handler = attach(logger, writing)
    for _ in range(100):
        logger.warning("nobody reads")
    assert handler._lost > 0
    assert handler._queued <= 2000

    received = b""

    def all_accounted_for() -> bool:
        nonlocal received
        with contextlib.suppress(BlockingIOError):
            received += os.read(reading, 2**20)
        whole, _, _ = received.rpartition(b"\n")
        lines = [json.loads(line) for line in whole.splitlines() if line]
        total: int = sum(line.get("lines", 1) for line in lines)
        return total == 100

    eventually(all_accounted_for)
    handler.close()
    os.close(reading)
    os.close(writing)


def test_a_full_disk_loses_lines_and_raises_nothing(logger: logging.Logger) -> None:
    with Path("/dev/full").open("wb", buffering=0) as full:
        handler = attach(logger, full.fileno())
        for _ in range(10):
            logger.warning("lost")
        handler.close()
        assert handler._lost == 10


def test_what_was_written_makes_room_for_as_many_bytes_again(
    logger: logging.Logger,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    eventually: Callable[[Callable[[], bool]], None],
) -> None:
    """A service that runs for long logs many times what may wait."""
    monkeypatch.setattr(logs, "QUEUED_BYTES", 1000)
    path = tmp_path / "log"

    def is_settled(lines: int) -> bool:
        return handler._lost > 0 or path.read_bytes().count(b"\n") == lines

    with path.open("wb") as file:
        handler = attach(logger, file.fileno())
        for number in range(50):
            logger.warning("line", extra={"fields": {"number": number}})
            eventually(partial(is_settled, number + 1))
        handler.close()
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert [line["number"] for line in lines] == list(range(50))
    assert path.stat().st_size > 4 * 1000
    assert handler._lost == 0


@pytest.mark.parametrize("kept", [0, 1, 7])
def test_as_many_bytes_wait_as_may_and_not_one_more(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    reading, writing = os.pipe()
    fill(writing)
    handler = attach(logger, writing)
    handler.setFormatter(logging.Formatter("%(message)s"))
    monkeypatch.setattr(logs, "QUEUED_BYTES", 20 * kept)
    for _ in range(kept + 3):
        logger.warning("n" * 19)
    assert (handler._queued, handler._lost) == (20 * kept, 3)
    os.close(reading)  # what waits is lost, and the thread ends
    handler.close()
    assert (handler._queued, handler._lost) == (0, kept + 3)
    os.close(writing)


def test_a_line_tells_when_how_grave_who_and_what(logger: logging.Logger) -> None:
    record = logger.makeRecord("robot", logging.ERROR, "file", 1, "went %s", ("wrong",), None)
    record.created = 1_700_000_000.25
    line = json.loads(JsonFormatter().format(record))
    assert line == {
        "time": "2023-11-14T22:13:20.250+00:00",
        "level": "error",
        "logger": "robot",
        "event": "went wrong",
    }
    error = ValueError("the cause")
    record.exc_info = (ValueError, error, None)
    assert "ValueError: the cause" in json.loads(JsonFormatter().format(record))["traceback"]
