from __future__ import annotations

import functools
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from simharness.__main__ import main
from simharness.play.server import LocalService
from tests.simharness.commands import WAIT_S, lines, results, run_it, started, wait_for_a_round

pytestmark = pytest.mark.sim


def test_results_do_not_depend_on_the_number_of_workers(two_rounds: Path, start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run_it("--rounds", 2, "--url", start_stub(), "--workers", 2, "--out", out)
    assert done.returncode == 0, done.stderr
    assert results(out) == results(two_rounds)


def test_a_service_that_dies_breaks_the_run_and_resume_finishes_it(
    two_rounds: Path, start_stub: Any, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    first = len([line for line in lines(two_rounds / "attempts.jsonl") if line["round"] == 0])
    command = ("--rounds", 2, "--workers", 1, "--out", out)
    broken = run_it(*command, "--url", start_stub("--die-after", str(first + 1)))
    assert broken.returncode == 3
    assert "gave no answer" in broken.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["complete"] is False
    assert "gave no answer" in report["stopped_by"]
    assert len(lines(out / "attempts.jsonl")) == report["attempts"] == first
    assert "Incomplete" in (out / "report.html").read_text()

    refused = run_it(*command, "--url", start_stub(), "--resume", "--executor", "strict")
    assert refused.returncode == 2
    assert "executor was 'edge', now 'strict'" in refused.stderr

    resumed = run_it(*command, "--url", start_stub(), "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert results(out) == results(two_rounds)


def test_a_finished_run_needs_no_service_to_be_resumed(two_rounds: Path) -> None:
    before = results(two_rounds)
    assert run_it("--rounds", 2, "--out", two_rounds, "--resume").returncode == 0
    assert results(two_rounds) == before


def test_workers_end_when_their_parent_is_killed(start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started("--rounds", 500, "--url", start_stub("--nothing"), "--workers", 2, "--out", out) as process:
        wait_for_a_round(out)
        process.kill()


def test_a_worker_that_dies_is_noticed(start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started("--rounds", 500, "--url", start_stub("--nothing"), "--workers", 2, "--out", out) as process:
        wait_for_a_round(out)
        os.kill(worker_of(process.pid), signal.SIGKILL)
        _, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == 3
        assert "a worker process was killed by signal 9" in errors
    assert json.loads((out / "report.json").read_text())["complete"] is False


def worker_of(parent: int) -> int:
    for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    raise AssertionError("no worker")


def test_a_service_that_cannot_start_is_reported_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = (sys.executable, "-c", "raise SystemExit('weights are missing')")
    monkeypatch.setattr("simharness.play.run.LocalService", functools.partial(LocalService, command=command))
    assert main(["--rounds", "1", "--out", str(tmp_path)]) == 3
    errors = capsys.readouterr().err
    assert "ended with code 1 before it was ready" in errors
    assert "weights are missing" in errors


def test_a_service_of_ours_that_dies_in_mid_run_is_reported_with_its_last_words(
    stub_command: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = (*stub_command, "--nothing", "--die-after", "4")
    monkeypatch.setattr("simharness.play.run.LocalService", functools.partial(LocalService, command=command))
    assert main(["--rounds", "50", "--workers", "1", "--out", str(tmp_path)]) == 3
    errors = capsys.readouterr().err
    assert "the service ended with code 1" in errors
    assert "the stub dies as it was told" in errors
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["complete"], report["rounds"]) == (False, 1)
