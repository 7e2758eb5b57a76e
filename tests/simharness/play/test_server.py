from __future__ import annotations

import functools
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from simharness.errors import RunBroken
from simharness.play import server
from simharness.play.server import LocalService, free_port
from tests.simharness.commands import wait_for

pytestmark = pytest.mark.sim


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


def test_a_service_that_does_not_end_is_killed(
    stub_command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "STOPPED_WITHIN_S", 0.5)
    deaf = (
        "import runpy, signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"runpy.run_path({stub_command[1]!r}, run_name='__main__')"
    )
    with LocalService("tesnet", tmp_path / "log", (stub_command[0], "-c", deaf)) as service:
        assert httpx.get(service.url + "/model", trust_env=False).status_code == 200
    assert service.died is not None
    assert "signal 9" in service.died


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
    command = (sys.executable, "-c", show)
    with (
        pytest.raises(RunBroken, match=r"'GRASP_WEIGHTS', '/of/the/run\.safetensors'"),
        LocalService("gpd", tmp_path / "log", command, weights=Path("/of/the/run.safetensors")),
    ):
        pass


def test_a_service_of_the_harness_wants_no_key_whatever_this_machine_has_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRASP_API_KEYS", "secret")
    show = "import os; print('keys', os.environ.get('GRASP_API_KEYS')); raise SystemExit(1)"
    with (
        pytest.raises(RunBroken, match="keys None"),
        LocalService("tesnet", tmp_path / "log", (sys.executable, "-c", show)),
    ):
        pass
