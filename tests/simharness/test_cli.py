from __future__ import annotations

import functools
import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from simharness.__main__ import main
from simharness.errors import RunBroken
from simharness.play.records import TIMING_KEYS
from simharness.play.server import LocalService, free_port

pytestmark = pytest.mark.sim

WAIT_S = 300.0


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


@pytest.fixture(scope="module")
def two_rounds(tmp_path_factory: pytest.TempPathFactory, stub_command: tuple[str, ...]) -> Path:
    """A finished run of two rounds by one worker."""
    out = tmp_path_factory.mktemp("run") / "out"
    stub = subprocess.Popen(stub_command, stdout=subprocess.PIPE, text=True)
    assert stub.stdout is not None
    try:
        done = run_it("--rounds", 2, "--url", stub.stdout.readline().strip(), "--workers", 1, "--out", out)
    finally:
        stub.terminate()
        stub.communicate()
    assert done.returncode == 0, done.stderr
    (out.parent / "stdout").write_text(done.stdout)
    (out.parent / "stderr").write_text(done.stderr)
    return out


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


def test_the_run_can_be_watched(start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ("--rounds", 2, "--url", start_stub(), "--out", out, "--watch", "--watch-port", 0)
    with started(*command) as process:
        assert process.stderr is not None
        line = next(line for line in process.stderr if line.startswith("watch: "))
        page = httpx.get(line.removeprefix("watch: ").strip(), trust_env=False, timeout=30)
        output, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == 0, errors
    assert page.status_code == 200
    assert "<html" in page.text
    assert output.startswith("packed scenes")
    report = json.loads((out / "report.json").read_text())
    assert report["complete"] is True
    assert (report["settings"]["workers"], report["settings"]["max_grasps"]) == (1, 10)


def test_only_watching_needs_the_viewer() -> None:
    heavy = "{'viser', 'matplotlib', 'open3d', 'torch', 'fastapi'} & set(sys.modules)"
    script = f"import sys; import simharness.__main__; sys.exit(str({heavy}) if {heavy} else 0)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rounds", "0"], "give 1 or more"),
        (["--rounds", "many"], "no whole number"),
        (["--scene", "heap"], "invalid choice"),
        (["--camera", "fisheye"], "invalid choice"),
        (["--noise-std", "-1"], "out of range"),
        (["--noise-std", "nan"], "out of range"),
        (["--polar-deg", "90"], "more than 0 and less than 90"),
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


# The service that the harness starts itself


def test_the_service_is_started_and_stopped(
    stub_command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRASP_NUM_THREADS", "7")
    with LocalService("tesnet", tmp_path / "log", stub_command) as service:
        assert httpx.get(service.url + "/model", trust_env=False).status_code == 200
        assert service.died is None
    with pytest.raises(httpx.ConnectError):
        httpx.get(service.url + "/model", trust_env=False)


def test_the_service_ends_when_the_harness_is_killed(stub_command: tuple[str, ...], tmp_path: Path) -> None:
    script = (
        "import sys, time, pathlib\n"
        "from simharness.play.server import LocalService\n"
        "with LocalService('tesnet', pathlib.Path(sys.argv[1]), tuple(sys.argv[2:])) as service:\n"
        "    print(service.url, flush=True)\n"
        "    time.sleep(600)\n"
    )
    harness = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "log"), *stub_command], stdout=subprocess.PIPE, text=True
    )
    assert harness.stdout is not None
    url = harness.stdout.readline().strip()
    assert httpx.get(url + "/health/ready", trust_env=False).status_code == 200
    harness.kill()
    harness.communicate()

    def gone() -> bool:
        try:
            httpx.get(url + "/health/ready", trust_env=False)
        except httpx.TransportError:
            return True
        return False

    wait_for(gone, "the service to end")


def test_another_port_is_tried_when_one_was_taken_meanwhile(
    stub_command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        ports = [taken.getsockname()[1], free_port()]
        monkeypatch.setattr("simharness.play.server.free_port", functools.partial(ports.pop, 0))
        # The service finds out whether the port is free before it loads anything; the stub serves where it is.
        command = ("bash", "-c", f"{sys.executable} -c '{_LISTEN_AS_THE_SERVICE}' && exec {' '.join(stub_command)}")
        with LocalService("tesnet", tmp_path / "log", command) as service:
            assert httpx.get(service.url + "/model", trust_env=False).status_code == 200
    assert ports == []


_LISTEN_AS_THE_SERVICE = """
import os, sys
from service import process
from service.settings import InvalidSetting, load_settings
try:
    process._listen(load_settings(os.environ)).close()
except InvalidSetting as error:
    sys.exit(process._fail(str(error), 2))
"""


def test_the_service_gets_fixed_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GRASP_NUM_THREADS", "GRASP_HOST", "GRASP_PORT"):
        monkeypatch.setenv(name, "7")
    monkeypatch.setenv("GRASP_WEIGHTS", "mine.safetensors")
    show = (
        "import os; print(sorted((k, v) for k, v in os.environ.items() if k.startswith('GRASP_'))); raise SystemExit(1)"
    )
    with pytest.raises(RunBroken) as broken, LocalService("tesnet", tmp_path / "log", (sys.executable, "-c", show)):
        pass
    for setting in (("GRASP_HOST", "127.0.0.1"), ("GRASP_NUM_THREADS", "1"), ("GRASP_WEIGHTS", "mine.safetensors")):
        assert str(setting) in str(broken.value)


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
