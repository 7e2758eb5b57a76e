"""`python -m service` as an operator meets it: exit codes, messages, signals."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service import process
from service.protocol import KEEP_ALIVE_SECONDS
from service.settings import load_settings
from tesnet.weights import SUMS, default_weights
from tests.conftest import PATIENCE_S, SERVED_HERE, hears
from tests.service.wire import status_of

StartService = Callable[..., Any]

POINTS = np.zeros((20, 3), np.float32).tobytes()


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A service that is expected to end by itself."""
    return subprocess.run(
        [sys.executable, "-m", "service", *arguments],
        env={**os.environ, **SERVED_HERE, **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def half_a_request(url: str) -> socket.socket:
    """A connection on which a request was begun that the service now waits for."""
    parts = urllib.parse.urlsplit(url)
    connection = socket.create_connection((parts.hostname or "", parts.port or 0), timeout=PATIENCE_S)
    connection.sendall(
        f"POST /grasps HTTP/1.1\r\nHost: test\r\nContent-Type: application/octet-stream\r\n"
        f"Content-Length: {len(POINTS)}\r\nExpect: 100-continue\r\n\r\n".encode()
    )
    assert status_of(connection) == 100  # the service has begun to read the body
    return connection


def test_sigterm_refuses_what_is_new_finishes_what_was_taken_and_exits_with_0(start_service: StartService) -> None:
    with start_service() as service:
        service.wait_for("ready")
        with half_a_request(service.url) as connection:
            service.process.send_signal(signal.SIGTERM)
            service.wait_for("draining")
            assert httpx.get(f"{service.url}/health/ready").status_code == 503
            assert httpx.get(f"{service.url}/health/live").status_code == 200
            refused = httpx.post(f"{service.url}/grasps", json={"points": []})
            assert (refused.status_code, refused.headers["Retry-After"]) == (503, "1")
            connection.sendall(POINTS)
            assert status_of(connection) == 200
        assert service.process.wait(PATIENCE_S) == 0
        service.wait_for("stopped")
        assert service.process.stderr.read() == ""


def test_a_second_sigterm_ends_at_once(start_service: StartService) -> None:
    with start_service() as service:
        service.wait_for("ready")
        with half_a_request(service.url):
            service.process.send_signal(signal.SIGTERM)
            service.wait_for("draining")
            service.process.send_signal(signal.SIGTERM)
            assert service.process.wait(PATIENCE_S) == 128 + signal.SIGTERM
        assert not any(line["event"] == "stopped" for line in service.lines)


def test_the_drain_timeout_ends_a_request_that_never_ends(start_service: StartService) -> None:
    with start_service(GRASP_DRAIN_TIMEOUT="0.2") as service:
        service.wait_for("ready")
        with half_a_request(service.url) as connection:
            service.process.send_signal(signal.SIGINT)
            assert status_of(connection) == 503
            assert service.process.wait(PATIENCE_S) == 0
        service.wait_for("request", status=503)


def test_sigterm_before_the_port_is_open_exits_with_0(start_service: StartService) -> None:
    with start_service() as service:
        while not hears(service.process.pid, signal.SIGTERM):  # or, as PID 1 of a container, it would be lost
            assert service.process.poll() is None
            time.sleep(0.001)
        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(PATIENCE_S) == 0
    assert service.lines == []


def test_port_0_picks_a_free_port_and_the_log_tells_it(shared_service: Any) -> None:
    ready = next(line for line in shared_service.lines if line["event"] == "ready")
    assert ready["port"] > 0
    assert ready["url"] == f"http://127.0.0.1:{ready['port']}"
    assert ready["pid"] == shared_service.process.pid
    assert httpx.get(f"{ready['url']}/health/ready").status_code == 200


def test_missing_weights_end_it_with_the_path_and_an_unknown_setting_is_warned_of(tmp_path: Path) -> None:
    ended = run(GRASP_WEIGHTS=str(tmp_path / "none.safetensors"), GRASP_QUEUE_SISE="3")
    assert ended.returncode == 1
    assert str(tmp_path / "none.safetensors") in ended.stderr
    assert "did you mean GRASP_QUEUE_SIZE?" in ended.stdout
    assert "Traceback" not in ended.stderr + ended.stdout


@pytest.mark.parametrize("damage", ["a flipped bit", "cut off"])
def test_corrupted_weights_end_it_with_the_path_and_the_reason(tmp_path: Path, damage: str) -> None:
    weights = default_weights()
    content = bytearray(weights.read_bytes())
    if damage == "a flipped bit":
        content[-100] ^= 1
        (tmp_path / SUMS).write_bytes(weights.with_name(SUMS).read_bytes())
    else:  # and nothing beside it to compare with
        del content[len(content) // 2 :]
    damaged = tmp_path / weights.name
    damaged.write_bytes(content)

    ended = run(GRASP_WEIGHTS=str(damaged))

    assert ended.returncode == 1
    assert str(damaged) in ended.stderr
    assert "Traceback" not in ended.stderr + ended.stdout


def test_a_port_in_use_ends_it_before_anything_is_loaded() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = run(GRASP_PORT=str(port))
    assert ended.returncode == 2
    assert "GRASP_PORT" in ended.stderr
    assert str(port) in ended.stderr
    assert "another process" in ended.stderr
    assert ended.stdout == ""


def test_a_host_that_is_not_ours_ends_it() -> None:
    ended = run(GRASP_HOST="192.0.2.1")
    assert ended.returncode == 2
    assert "GRASP_HOST" in ended.stderr
    assert "127.0.0.1" in ended.stderr


def test_an_invalid_setting_ends_it_with_variable_value_and_remedy() -> None:
    ended = run(GRASP_QUEUE_SIZE="none")
    assert ended.returncode == 2
    for word in ("GRASP_QUEUE_SIZE", "'none'", "10,000"):
        assert word in ended.stderr
    assert ended.stdout == ""


def test_help_names_every_setting_and_version_is_told() -> None:
    helped = run("--help")
    assert helped.returncode == 0
    for name in ("GRASP_PORT", "GRASP_WEIGHTS", "GRASP_DEVICE", "GRASP_NUM_THREADS", "SIGTERM"):
        assert name in helped.stdout
    assert run("--version").stdout.startswith("tes-net ")
    assert run("--what").returncode == 2


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_files_that_nobody_opened_stop_nothing(closed: str) -> None:
    command = f'exec "{sys.executable}" -m service --version {closed}'
    ended = subprocess.run(["/bin/sh", "-c", command], stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        environment = {**os.environ, **SERVED_HERE, "GRASP_PORT": str(taken.getsockname()[1])}
        command = f'exec "{sys.executable}" -m service {closed}'
        ended = subprocess.run(
            ["/bin/sh", "-c", command], env=environment, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False
        )
        assert ended.returncode == 2
        assert b"Traceback" not in ended.stderr


@pytest.mark.parametrize("proxies", ["", "10.9.9.9", "127.0.0.1, 10.0.0.0/8"])
def test_the_server_is_set_up_as_the_settings_say(proxies: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is trusted for addresses above all: uvicorn by itself believes whoever asks from this machine."""
    made: list[process._Server] = []
    monkeypatch.setattr(process._Server, "run", lambda server, sockets: made.append(server))
    settings = load_settings({**SERVED_HERE, "GRASP_TRUSTED_PROXIES": proxies, "GRASP_DRAIN_TIMEOUT": "7"})
    with socket.create_server(("127.0.0.1", 0)) as listener, pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "_exit", lambda code: None)
        process._serve(settings, listener, 0.0)
    config = made[0].config
    trusted = [name for name in proxies.split(", ") if name]
    assert (config.proxy_headers, config.forwarded_allow_ips) == (bool(trusted), trusted)
    assert (config.timeout_keep_alive, config.timeout_graceful_shutdown, config.ws) == (
        KEEP_ALIVE_SECONDS,
        process.LAST_BYTES_SECONDS,
        "none",
    )
    assert (config.access_log, config.server_header, made[0]._drain_timeout) == (False, False, 7.0)
