"""The command line as tests use it, and what its runs leave."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simharness.__main__ import main
from simharness.play.records import TIMING_KEYS
from tests.conftest import PATIENCE_S

WAIT_S = PATIENCE_S


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


def run_it(*arguments: object) -> Done:
    """A command in this process; the workers it starts are processes all the same."""
    output, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(errors):
        code = main([str(argument) for argument in arguments])
    return Done(code, output.getvalue(), errors.getvalue())


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A run in a process group of its own, which must be empty in the end."""
    command = [sys.executable, "-m", "simharness", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        yield process
        process.communicate(timeout=WAIT_S)
        wait_for(lambda: not group_lives(process.pid), "every process of the run to end")
    finally:
        if group_lives(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited {WAIT_S:.0f} s for {what}")


def wait_for_a_round(out: Path) -> None:
    """Until a round is on the disk: the file appears a moment before its first line."""
    path = out / "rounds.jsonl"
    wait_for(lambda: path.exists() and path.read_text().endswith("\n"), "the first round")


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMING_KEYS}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def results(out: Path) -> Any:
    """Everything of a run that must repeat bit for bit."""
    report = json.loads((out / "report.json").read_text())
    for part in (report, *report["by_seed"].values()):
        del part["latencies"]
    del report["settings"]["workers"], report["settings"]["url"]
    pictures = {path.name: path.read_bytes() for path in (out / "pictures").iterdir()}
    return without_times(lines(out / "attempts.jsonl")), without_times(lines(out / "rounds.jsonl")), report, pictures
