"""What runs on Ray, on one real cluster of this machine: replicas of the service, rounds, scenes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from client import GraspClient, RetryPolicy
from tests.conftest import ServiceProcess, running_service

ROOT = Path(__file__).resolve().parents[1]
TIMES = {"timings_ms", "latency", "latency_ms", "this_run"}
REPLICA = b"ray::ServeReplica"
OCTETS = "application/octet-stream"
CLIENTS = 3
REQUESTS = 4
"""Of each client, once a replica was killed."""

pytestmark = [pytest.mark.slow, pytest.mark.sim]


class OnRay(ServiceProcess):
    """Ray puts lines of its own between those of the command."""

    def parse(self, text: str) -> dict[str, Any] | None:
        return super().parse(text) if text.startswith("{") else None


@pytest.fixture(scope="module")
def settings_of_ray() -> dict[str, str]:
    """A cluster of our own that tells nobody of itself, and keeps the replicas' output out of ours."""
    return {
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # to Ray this means: one machine, 127.0.0.1
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": uuid.uuid4().hex,
        "RAY_LOG_TO_DRIVER": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        "GRASP_NUM_THREADS": "1",
    }


@pytest.fixture(scope="module")
def served(settings_of_ray: dict[str, str]) -> Iterator[ServiceProcess]:
    """Two replicas on a local cluster; `ray` in its line `ready` is the cluster's address."""
    port = str(_free_port())
    command = [sys.executable, "-m", "service.deploy.ray", "--min-replicas", "2", "--cpus", "0.1"]
    with running_service(command, {**settings_of_ray, "GRASP_PORT": port}, OnRay) as service:
        service.wait_for("ready")
        yield service


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def ready(served: ServiceProcess) -> dict[str, Any]:
    return next(line for line in served.lines if line["event"] == "ready")


def run(module: str, *arguments: object, environment: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", module, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMES}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def lines(path: Path) -> Any:
    return without_times([json.loads(line) for line in path.read_text().splitlines()])


def test_rounds_end_the_same_on_a_cluster_where_every_worker_has_a_service(
    served: ServiceProcess, settings_of_ray: dict[str, str], tmp_path: Path
) -> None:
    run("simharness", "--rounds", 2, "--workers", 1, "--out", tmp_path / "here", environment=settings_of_ray)
    there = ["--rounds", 2, "--workers", 2, "--ray", ready(served)["ray"], "--out", tmp_path / "there"]
    run("simharness", *there, environment=settings_of_ray)
    for name in ("attempts.jsonl", "rounds.jsonl"):
        assert lines(tmp_path / "there" / name) == lines(tmp_path / "here" / name)
    pictures = [
        {path.name: path.read_bytes() for path in (tmp_path / side / "pictures").iterdir()}
        for side in ("here", "there")
    ]
    assert pictures[0] == pictures[1] != {}


def test_scenes_are_labelled_the_same_on_a_cluster(
    served: ServiceProcess, settings_of_ray: dict[str, str], tmp_path: Path
) -> None:
    asked = ["generate", "--scene", "packed", "--objects", "procedural-train", "--labels", 7, "--views", 1]
    asked += ["--labels-per-view", 6, "--seed", 5]
    run("training", *asked, "--workers", 1, "--out", tmp_path / "here", environment=settings_of_ray)
    on_ray = ["--workers", 2, "--ray", ready(served)["ray"], "--out", tmp_path / "there"]
    run("training", *asked, *on_ray, environment=settings_of_ray)
    names = [sorted(path.name for path in (tmp_path / side).iterdir()) for side in ("here", "there")]
    assert names[0] == names[1]
    assert sum(name.endswith(".npz") for name in names[0]) == 2
    for name in names[0]:
        here, there = tmp_path / "here" / name, tmp_path / "there" / name
        if name.endswith(".npz"):
            with np.load(here, allow_pickle=False) as one, np.load(there, allow_pickle=False) as other:
                assert {key: one[key].tobytes() for key in one} == {key: other[key].tobytes() for key in other}
        else:
            assert without_times(json.loads(here.read_text())) == without_times(json.loads(there.read_text()))


def test_an_answer_has_one_request_id_whatever_the_client_sends(served: ServiceProcess) -> None:
    for given, kept in (("robot-7/42", True), ("bad%20id|x", False)):
        answer = httpx.get(ready(served)["url"] + "/nowhere", headers={"X-Request-ID": given})
        assert answer.status_code == 404
        assert answer.headers.get_list("X-Request-ID") == [answer.json()["request_id"]]
        assert (answer.json()["request_id"] == given) is kept


def test_a_killed_replica_loses_no_request_and_sigterm_ends_in_order(served: ServiceProcess) -> None:
    points = np.load(ROOT / "examples" / "clutter.npy", allow_pickle=False)[::8]
    replies: list[int] = []
    errors: list[Exception] = []
    killed = threading.Event()

    def ask() -> None:
        after = 0
        try:
            with GraspClient(ready(served)["url"], timeout=300, retry=RetryPolicy(max_retries=5)) as client:
                while after < REQUESTS:
                    after += killed.is_set()
                    reply = client.grasps(points, viewpoint=(0.38, 0.55, 0.48), up=(0, 0, 1))
                    replies.append(len(reply.grasps))
        except Exception as error:  # noqa: BLE001 - whatever it is, the test fails of it
            errors.append(error)

    threads = [threading.Thread(target=ask) for _ in range(CLIENTS)]
    for thread in threads:
        thread.start()
    before = replicas(served.process.pid)
    assert len(before) == 2
    while len(replies) < CLIENTS and not errors:
        threads[0].join(0.05)
    os.kill(before[0], signal.SIGKILL)
    killed.set()
    for thread in threads:
        thread.join(300)
    assert errors == []
    assert len(replies) >= CLIENTS * REQUESTS
    assert set(replies) == {10}
    assert httpx.get(ready(served)["url"] + "/health/ready").status_code == 200

    served.process.terminate()
    refusals: list[httpx.Response] = []
    with httpx.Client(base_url=ready(served)["url"], timeout=60) as http, suppress(httpx.TransportError):
        while True:  # until there is nothing to connect to
            answer = http.post("/grasps", content=points.tobytes(), headers={"Content-Type": OCTETS})
            if answer.status_code != 200:
                refusals.append(answer)
    assert served.process.wait(120) == 0
    served.wait_for("stopped")
    assert {(answer.status_code, answer.headers["Retry-After"]) for answer in refusals} == {(503, "1")}
    assert {answer.json()["type"] for answer in refusals} == {"urn:tes-net:problem:not-ready"}


@pytest.mark.parametrize("stage", [b"gcs_server", b"ray::ServeController", REPLICA])
def test_sigterm_while_it_starts_ends_in_order_and_leaves_no_process(
    stage: bytes, settings_of_ray: dict[str, str]
) -> None:
    token = uuid.uuid4().hex
    settings = {**settings_of_ray, "RAY_AUTH_TOKEN": token, "GRASP_PORT": str(_free_port())}
    command = [sys.executable, "-m", "service.deploy.ray", "--cpus", "0.1"]
    with running_service(command, settings, OnRay) as service:
        while not any(stage in command for command in descendants(service.process.pid).values()):
            assert service.process.poll() is None
            time.sleep(0.001)
        service.process.terminate()
        assert service.process.wait(120) == 0
        while any(f"RAY_AUTH_TOKEN={token}".encode() in environment for environment in environments()):
            time.sleep(0.1)


def environments() -> Iterator[bytes]:
    """Of all processes that may be looked at."""
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            yield path.read_bytes()


def replicas(parent: int) -> list[int]:
    """Process ids of the replicas among the descendants of a process."""
    return [child for child, command in descendants(parent).items() if command.startswith(REPLICA)]


def descendants(parent: int) -> dict[int, bytes]:
    """Process ids of the descendants of a process, with their command lines."""
    found: dict[int, bytes] = {}
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        with suppress(OSError):  # it ended meanwhile
            for child in map(int, task.read_text().split()):
                found[child] = Path(f"/proc/{child}/cmdline").read_bytes()
                found |= descendants(child)
    return found
