from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest

from simharness.__main__ import main
from tests.simharness.commands import WAIT_S, lines, run_it, started, wait_for_a_round

pytestmark = pytest.mark.sim


def test_a_run_leaves_a_report_and_prints_a_table(two_rounds: Path) -> None:
    report = json.loads((two_rounds / "report.json").read_text())
    attempts = lines(two_rounds / "attempts.jsonl")
    assert report["complete"] is True
    assert report["attempts"] == len(attempts) >= 2
    assert report["successes"] == sum(attempt["outcome"] == "success" for attempt in attempts)
    assert report["settings"]["objects"] == "procedural"
    assert report["model"]["weights_sha256"] == "0" * 64
    assert {"T_world_grasp", "score", "outcome", "latency_ms", "counts", "objects"} <= set(attempts[0])
    assert "data:image/png;base64," in (two_rounds / "report.html").read_text()
    table = (two_rounds.parent / "stdout").read_text()
    assert table.startswith("packed scenes")
    assert f"{report['successes']} of {report['attempts']} attempts" in table
    progress = (two_rounds.parent / "stderr").read_text()
    assert "2/2" in progress
    assert "GSR" in progress


def test_an_attempt_is_replayed_with_the_recorded_outcome(two_rounds: Path) -> None:
    last = len(lines(two_rounds / "attempts.jsonl")) - 1
    recorded = lines(two_rounds / "attempts.jsonl")[last]
    done = run_it("replay", two_rounds, "--attempt", last)
    assert done.returncode == 0, done.stderr
    assert f"outcome {recorded['outcome']}" in done.stdout
    assert f"recorded {recorded['outcome']}" in done.stdout
    assert len(list((two_rounds / f"replay-{last}").glob("*.png"))) == 3
    beyond = run_it("replay", two_rounds, "--attempt", last + 1)
    assert beyond.returncode == 2
    assert f"give 0 to {last}" in beyond.stderr


def test_ctrl_c_ends_cleanly_and_leaves_no_process(start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started("--rounds", 500, "--url", start_stub("--nothing"), "--workers", 2, "--out", out) as process:
        wait_for_a_round(out)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        output, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == 130
        assert "Traceback" not in errors
    report = json.loads((out / "report.json").read_text())
    assert report["complete"] is False
    assert report["stopped_by"] == "interrupted"
    assert 1 <= report["rounds"] < 500
    assert report["no_grasps"] == {"no_candidates": 3 * report["rounds"]}
    assert "INCOMPLETE: interrupted" in output


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("open3d", "fusion", ["--camera", "multi3"]),
        ("scipy.ndimage", "sensors", ["--camera", "giga"]),
        ("scipy.ndimage", "sensors", ["--dex-noise"]),
        ("scipy.ndimage", "sensors", ["--sensor", "d435"]),
        ("viser", "watch", ["--watch"]),
    ],
)
def test_an_option_whose_extra_is_missing_names_it_before_anything_is_played(
    module: str, extra: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # to Python: not installed
    done = run_it("--rounds", 1, "--url", "http://127.0.0.1:9", "--out", tmp_path / "out", *arguments)
    assert done.returncode == 2
    assert f"pip install -e '.[{extra}]'" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rounds", "0"], "give 1 or more"),
        (["--rounds", "many"], "no whole number"),
        (["--scene", "heap"], "invalid choice"),
        (["--camera", "fisheye"], "invalid choice"),
        (["--noise-std", "-1"], "out of range"),
        (["--noise-std", "nan"], "out of range"),
        (["--polar-deg", "90"], "0 or more and less than 90"),
        (["--voxel-size", "0"], "out of range"),
        (["failures", "nowhere"], "holds no run"),
        (["robustness", "--camera", "giga"], "unrecognized"),
        (["robustness", "--against", "fog"], "invalid choice"),
        (["--watch", "--watch-port", "70000"], "give 0 to 65535"),
        (["--seeds", "1", "1"], "named twice"),
        (["--watch", "--ray", "auto"], "leave out --ray"),
        (["--seed", "0", "--seeds", "1"], "not allowed with"),
        (["--resume"], "--out"),
        (["--round", "3"], "unrecognized"),
        (["replay", "nowhere", "--attempt", "0"], "holds no run"),
        (["--url", "ftp://x", "--out", "OUT"], "ftp://x"),
        (["--objects", "no-such-set"], "no-such-set"),
    ],
)
def test_a_command_that_cannot_be_carried_out_exits_2_and_says_why(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(tmp_path / "out") if argument == "OUT" else argument for argument in arguments]
    try:
        code: Any = main(given)
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert words in capsys.readouterr().err


def test_a_folder_without_objects_exits_2_and_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["--objects", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert str(tmp_path / "empty") in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_service_that_nobody_runs_exits_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--rounds", "1", "--url", "http://127.0.0.1:9", "--out", str(tmp_path)]) == 3
    assert "http://127.0.0.1:9" in capsys.readouterr().err
    assert json.loads((tmp_path / "report.json").read_text())["complete"] is False


def test_camera_giga_plays_the_rounds_again_with_the_published_crop(start_stub: Any, tmp_path: Path) -> None:
    giga = ("--camera", "giga", "--rounds", 1, "--workers", 1, "--url")
    done = run_it(*giga, start_stub("--nothing"), "--out", tmp_path / "whole")
    assert done.returncode == 0, done.stderr
    of_both = [tmp_path / "whole" / name / "report.json" for name in ("", "published-crop")]
    assert [json.loads(path.read_text())["settings"]["calibrate"] for path in of_both] == [True, False]
    assert done.stdout.count("published-crop:") == 1

    broken = run_it(*giga, "http://127.0.0.1:9", "--out", tmp_path / "broken")
    assert broken.returncode == 3
    assert "published-crop" not in broken.stdout
    assert not (tmp_path / "broken" / "published-crop").exists()


def test_weights_that_are_missing_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GRASP_WEIGHTS", str(tmp_path / "missing.safetensors"))
    assert main(["--rounds", "1", "--out", str(tmp_path / "out")]) == 3
    assert "missing.safetensors" in capsys.readouterr().err


@pytest.mark.slow
def test_tables_are_cleared_through_the_real_service(service_url: str, tmp_path: Path) -> None:
    done = run_it("--rounds", 2, "--scene", "packed", "--url", service_url, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    attempts = lines(tmp_path / "attempts.jsonl")
    served = httpx.get(service_url + "/model", trust_env=False).json()["models"][0]
    assert report["complete"] is True
    assert report["model"] == {name: served[name] for name in ("name", "version", "weights_sha256")}
    assert report["successes"] >= 1
    assert all(0 <= attempt["score"] <= 1 for attempt in attempts)
    assert all(attempt["counts"]["candidates"] > 0 for attempt in attempts)
    assert report["latencies"]["service_total_ms"]["median"] > 0
