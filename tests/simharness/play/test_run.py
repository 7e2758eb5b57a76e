from __future__ import annotations

import functools
import inspect
import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from simharness.__main__ import main
from simharness.errors import RunBroken
from simharness.play import run as running
from simharness.play.folder import RunFolder
from simharness.play.planner import HttpPlanner
from simharness.play.records import ModelRecord, RoundRecord, Serving
from simharness.play.run import Hooks, _Log, _Rounds
from simharness.play.server import LocalService
from simharness.sim.objects import ObjectModel
from tests.simharness.commands import WAIT_S, lines, results, run_it, started, wait_for_a_round

pytestmark = pytest.mark.sim


def test_results_do_not_depend_on_the_number_of_workers(two_rounds: Path, start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run_it("--rounds", 2, "--url", start_stub(), "--workers", 2, "--out", out)
    assert done.returncode == 0, done.stderr
    assert results(out) == results(two_rounds)


def test_pictures_of_a_run_that_nobody_watches_tell_objects_apart(two_rounds: Path) -> None:
    pictures = list((two_rounds / "pictures").glob("*-segmentation.png"))
    assert pictures
    for path in pictures:
        with Image.open(path) as image:
            assert len(image.convert("RGB").getcolors(1 << 16) or ()) >= 2, path.name


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


def test_a_worker_whose_own_service_serves_another_model_is_refused(
    stub_command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, make_settings: Any, objects: tuple[ObjectModel, ...]
) -> None:
    monkeypatch.setattr("simharness.play.run.LocalService", functools.partial(LocalService, command=stub_command))
    stub = ModelRecord("tesnet", "stub", "0" * 64)
    with _Rounds(make_settings(), objects, None, stub, watched=False).begin() as play:
        assert callable(play)
    for name, value in (("version", "other"), ("weights_sha256", "1" * 64)):
        other = replace(stub, **{name: value})
        with (
            pytest.raises(RunBroken, match="another model than this machine's"),
            _Rounds(make_settings(), objects, None, other, watched=False).begin(),
        ):
            pass


def test_rounds_are_written_in_their_order_whatever_the_order_they_finish_in(
    tmp_path: Path, make_settings: Any, make_round: Any
) -> None:
    settings = make_settings(rounds=3, seeds=(1, 0))
    heard: list[RoundRecord] = []
    log = _Log(settings, RunFolder(tmp_path), Hooks(lambda _: None, heard.append), resume=False)
    log.open(ModelRecord("tesnet", "1", "0" * 64), Serving(None, 1, "cpu"))
    assert log.todo == [(1, 0), (1, 1), (1, 2), (0, 0), (0, 1), (0, 2)]
    arriving = [(1, 2), (0, 1), (1, 0), (0, 0), (0, 2), (1, 1)]
    for key in arriving:
        log.take(make_round(*key, ["success", "slip"]))
    assert [(record.seed, record.round) for record in heard] == arriving
    assert log.todo == []
    assert [(record.seed, record.round) for record in log.close()] == sorted(arriving)
    for name, each in (("rounds.jsonl", 1), ("attempts.jsonl", 2)):
        written = [(line["seed"], line["round"]) for line in lines(tmp_path / name)]
        assert written == [key for key in sorted(arriving) for _ in range(each)]


def test_the_service_is_asked_as_the_settings_say(make_settings: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = make_settings(model="gpd", max_grasps=7, gripper="rg2", calibrate=True, min_score=0.7)
    told: list[dict[str, Any]] = []

    def noted(*arguments: Any, **options: Any) -> None:
        told.append(inspect.signature(HttpPlanner).bind(*arguments, **options).arguments)

    monkeypatch.setattr(running, "HttpPlanner", noted)
    for asked in (settings, make_settings()):
        running._planner("http://service.test", asked)
    expected = {
        "url": "http://service.test",
        "model": "gpd",
        "max_grasps": 7,
        "gripper": "rg2",
        "calibrate": True,
        "min_score": 0.7,
    }
    plain = {"model": "tesnet", "max_grasps": 1, "gripper": "franka", "calibrate": False, "min_score": None}
    assert told == [expected, expected | plain]
