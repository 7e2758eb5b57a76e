"""What `docs/reliability.md` says of a killed process, a full disk, a wrong clock, and slow or silent clients."""

from __future__ import annotations

import concurrent.futures
import os
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from client import GraspClient
from client.retry import RetryPolicy
from simharness.play.server import free_port
from tests.conftest import PATIENCE_S, SERVED_HERE
from tests.service.wire import POINTS, connect, status_of

Cloud = NDArray[np.float32]
Eventually = Callable[[Callable[[], bool]], None]

HEAD = (
    b"POST /grasps HTTP/1.1\r\nHost: test\r\nContent-Type: application/octet-stream\r\n"
    b"Content-Length: 240\r\nExpect: 100-continue\r\n\r\n"
)

JUMPING_CLOCK = """
import itertools, runpy, sys, time
true, jumps = time.time, itertools.cycle([0, 86400, -86400])
time.time = lambda: true() + next(jumps)
time.time_ns = lambda: int(1e9 * time.time())
sys.argv = ["service"]
runpy.run_module("service", run_name="__main__")
"""


def begin(url: str) -> socket.socket:
    """A connection whose request was taken and whose body is awaited."""
    connection = connect(url)
    connection.sendall(HEAD)
    assert status_of(connection) == 100
    return connection


@contextmanager
def service(*arguments: str, **options: Any) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A service whose standard output is not read; its URL and its process."""
    port = free_port()
    environment = {**os.environ, **SERVED_HERE, "GRASP_PORT": str(port)}
    url = f"http://127.0.0.1:{port}"
    with subprocess.Popen([sys.executable, *arguments], env=environment, **options) as process:
        try:
            with GraspClient(url) as client:
                client.wait_until_ready(PATIENCE_S)
            yield url, process
        finally:
            process.kill()


def test_after_kill_9_the_client_is_told_at_once_and_its_retry_reaches_the_next_process(
    start_service: Callable[..., Any], cloud: Cloud
) -> None:
    port = free_port()
    with start_service(GRASP_PORT=str(port)) as first:
        first.wait_for("ready")
        with begin(first.url) as connection:
            first.process.send_signal(signal.SIGKILL)
            with suppress(ConnectionResetError):
                assert connection.recv(4096) == b""
        first.process.wait(PATIENCE_S)
    patient = RetryPolicy(max_retries=10_000, max_delay=2.0)
    with (
        concurrent.futures.ThreadPoolExecutor() as pool,
        GraspClient(first.url, timeout=PATIENCE_S, retry=patient) as client,
    ):
        asked = pool.submit(client.grasps, cloud, up=(0, 0, 1), max_candidates=50)
        with start_service(GRASP_PORT=str(port)) as second:
            second.wait_for("ready")
            assert asked.result().counts.points == len(cloud)


def test_a_full_disk_under_the_log_stops_neither_answers_nor_an_orderly_end() -> None:
    with (
        Path("/dev/full").open("wb", buffering=0) as full,
        service("-m", "service", stdout=full, stderr=subprocess.PIPE) as (url, process),
    ):
        for _ in range(3):
            answer = httpx.post(f"{url}/grasps", json={"points": [[0, 0, 1]]}, timeout=PATIENCE_S)
            assert answer.status_code == 200
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""


def test_a_wall_clock_that_jumps_by_days_moves_no_deadline() -> None:
    with service("-c", JUMPING_CLOCK, stdout=subprocess.DEVNULL) as (url, process):
        for _ in range(6):
            answer = httpx.post(f"{url}/grasps", json={"points": [[0, 0, 1]]}, timeout=PATIENCE_S)
            assert answer.status_code == 200
            assert 0 <= answer.json()["timings_ms"]["total"] < 1e3 * PATIENCE_S
        with begin(url):
            assert httpx.get(f"{url}/health/ready").status_code == 200
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def test_a_hundred_bodies_that_trickle_take_no_place_in_the_queue_and_end_at_their_deadline(
    serve: Callable[..., Any], eventually: Eventually
) -> None:
    server = serve(queue_size=1, request_timeout=2.0)
    server.predictor.gate.set()
    with ExitStack() as stack:
        slow = []
        for _ in range(100):
            slow.append(stack.enter_context(begin(server.url)))
            slow[-1].sendall(b"\0")
        patient = {"Content-Type": "application/octet-stream", "X-Request-Timeout": f"{PATIENCE_S:g}"}
        answered = httpx.post(f"{server.url}/grasps", content=POINTS, headers=patient, timeout=PATIENCE_S)
        assert answered.status_code == 200
        for connection in slow:
            answer = b"".join(iter(partial(connection.recv, 4096), b""))
            assert answer.startswith(b"HTTP/1.1 504 ")
            assert b"Only 1 bytes of the body had come" in answer
    eventually(lambda: server.endpoint.active == 0)


@pytest.fixture
def many_files() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = max(soft, 4096)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_thousand_idle_connections_disturb_nobody(
    many_files: None, service_url: str, http: httpx.Client, cloud: Cloud
) -> None:
    with ExitStack() as stack:
        for _ in range(1000):
            stack.enter_context(connect(service_url))
        assert httpx.get(f"{service_url}/health/ready").status_code == 200
        answer = http.post(
            "/grasps?max_candidates=50",
            content=cloud.tobytes(),
            headers={"Content-Type": "application/octet-stream"},
        )
        assert answer.status_code == 200
