"""What tests of several packages share: the real service, in a process of its own; what to do without a needed program.

A test that waits, waits for at most `PATIENCE_S`: so long that only a test that hangs ever does, on any machine.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.needs import Part, missing, packages

PATIENCE_S = 300.0
"""For what takes a moment on a quiet machine: a service to start, an answer, a process to end."""

MISSING = pytest.StashKey[list[Part]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--no-gaps", action="store_true", help="fail where a program or system library is missing that a test needs"
    )


@pytest.hookimpl(tryfirst=True)  # before any fixture starts a service
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out a test whose program or system library this machine lacks; with `--no-gaps`, as in CI, it fails."""
    absent = missing(name for mark in item.iter_markers("needs") for name in mark.args)
    if not absent:
        return
    item.user_properties += [("missing", (part.name, part.package)) for part in absent]
    why = f"missing: {', '.join(part.name for part in absent)}; apt-get install {' '.join(packages(absent))}"
    if item.config.getoption("no_gaps"):
        pytest.fail(why, pytrace=False)
    pytest.skip(why)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One block of what was left out, and what would bring it."""
    reports = [report for outcome in ("skipped", "failed", "error") for report in terminalreporter.getreports(outcome)]
    gaps: dict[tuple[str, str], list[str]] = {}
    for report in reports:
        for name, part in getattr(report, "user_properties", ()):
            if name == "missing":
                gaps.setdefault(tuple(part), []).append(report.nodeid)
    if not gaps:
        return
    terminalreporter.section("left out: what they need is not on this machine")
    for (name, package), tests in sorted(gaps.items()):
        terminalreporter.line(f"{name} (Debian: {package}), for")
        for test in tests:
            terminalreporter.line(f"    {test}")
    line = " ".join(sorted({package for _, package in gaps}))
    terminalreporter.line(f"To run them all: apt-get install --no-install-recommends {line}", bold=True)


@dataclass
class ServiceProcess:
    """A `python -m service` on a free loopback port, and the log lines it has written."""

    process: subprocess.Popen[str]
    lines: list[dict[str, Any]] = field(default_factory=list)
    arrived: queue.Queue[dict[str, Any] | None] = field(default_factory=queue.Queue)

    def wait_for(self, event: str, **fields: Any) -> dict[str, Any]:
        """The first log line of this event with these fields that was not waited for before."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            line = self.arrived.get(timeout=max(0.0, deadline - time.monotonic()))
            if line is None:
                errors = self.process.stderr.read() if self.process.stderr else ""
                raise AssertionError(f"the service ended before {event!r}: {errors}\n{self.lines}")
            if line["event"] == event and all(line.get(name) == value for name, value in fields.items()):
                return line

    @property
    def url(self) -> str:
        """Where it listens."""
        return next(str(line["url"]) for line in self.lines if line["event"] == "listening")

    def parse(self, text: str) -> dict[str, Any] | None:
        """A line of the log; None for one to pass over, of which the service itself writes none."""
        return dict(json.loads(text))

    def read(self) -> None:
        assert self.process.stdout is not None
        for text in self.process.stdout:
            line = self.parse(text)
            if line is None:
                continue
            self.lines.append(line)
            self.arrived.put(line)
        self.arrived.put(None)


def hears(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


StartService = Callable[..., Any]


SERVED_HERE = {
    "GRASP_HOST": "127.0.0.1",
    "GRASP_PORT": "0",
    "GRASP_DEVICE": "cpu",
    "GRASP_REQUEST_TIMEOUT": f"{PATIENCE_S:g}",
}
"""Settings of services that tests start, unless a test says otherwise."""


@contextmanager
def running_service(
    command: list[str], environment: Mapping[str, str], kind: type[ServiceProcess] = ServiceProcess
) -> Iterator[ServiceProcess]:
    process = subprocess.Popen(
        command,
        env={**os.environ, **SERVED_HERE, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    service = kind(process)
    reader = threading.Thread(target=service.read, daemon=True)
    reader.start()
    try:
        yield service
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        reader.join(PATIENCE_S)
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


@pytest.fixture(scope="session")
def start_service() -> Callable[..., Any]:
    """Start a `python -m service` of one's own: `with start_service(GRASP_QUEUE_SIZE="1") as service`."""

    def start(**environment: str) -> Any:
        return running_service([sys.executable, "-m", "service"], environment)

    return start


@pytest.fixture(scope="session")
def shared_service(start_service: StartService) -> Iterator[ServiceProcess]:
    """A real server with the shipped weights, ready, shared by all tests of the session."""
    with start_service() as service:
        service.wait_for("ready")
        yield service


@pytest.fixture(scope="session")
def service_url(shared_service: ServiceProcess) -> str:
    """URL of `shared_service`."""
    return shared_service.url
