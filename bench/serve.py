"""Speed of the whole service over HTTP, with its memory and start-up: `python -m bench.serve --threads 2`.

Starts `python -m service` on a free loopback port and asks it by turns as any Python user would, through
`client.GraspClient`, and with the same bytes (`application/octet-stream`) over the standard library's HTTP connection:
the first adds what Python needs to write a request and to read the answer's grasps.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

import numpy as np

from bench.scene import SUPPORT_HEIGHT, UP, WORKSPACE_MAXIMUM, WORKSPACE_MINIMUM, five_objects
from bench.table import processor, table
from client import GraspClient, GraspOptions
from client.request import points_request
from simharness.play.server import free_port

READY_WITHIN_S = 60.0
STOPPED_WITHIN_S = 30.0
PREDICTOR_STAGES = ("prepare", "candidates", "network", "rank")


@contextmanager
def running_service(port: int, threads: int, **settings: str) -> Iterator[subprocess.Popen[bytes]]:
    """`python -m service` on the loopback interface for as long as the context lasts.

    Args:
        port: where it listens.
        threads: CPU threads of its predictor.
        settings: more `GRASP_*` variables.
    """
    environment = os.environ | {
        "GRASP_HOST": "127.0.0.1",
        "GRASP_PORT": str(port),
        "GRASP_DEVICE": "cpu",
        "GRASP_NUM_THREADS": str(threads),
        "GRASP_LOG_LEVEL": "warning",
        **settings,
    }
    with subprocess.Popen([sys.executable, "-m", "service"], env=environment) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOPPED_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()


def memory_mb(pid: int, field: str) -> float:
    """Resident memory of a process, MB: `VmRSS` now, `VmHWM` at its highest. NaN where the system has no /proc."""
    status = Path(f"/proc/{pid}/status")
    if status.exists():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith(f"{field}:"):
                return int(line.split()[1]) * 1024 / 1e6
    return float("nan")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the predictor")
    parser.add_argument("--runs", type=int, default=50, help="measured requests, after one that is not")
    parser.add_argument("--points", type=int, default=20_000, help="points in the cloud")
    parser.add_argument("--candidates", type=int, default=1_500, help="most candidates")
    arguments = parser.parse_args()

    scene = five_objects(arguments.points)
    options: GraspOptions = {
        "viewpoint": scene.viewpoint_world,
        "up": UP,
        "workspace": {"min": WORKSPACE_MINIMUM, "max": WORKSPACE_MAXIMUM},
        "support_height": SUPPORT_HEIGHT,
        "max_candidates": arguments.candidates,
    }
    samples: dict[str, list[float]] = defaultdict(list)

    def note(how: str, end_to_end: float, timings_ms: Mapping[str, float]) -> None:
        predictor = sum(timings_ms[stage] for stage in PREDICTOR_STAGES)
        samples[how].append(end_to_end)
        samples["  in the predictor"].append(predictor)
        samples[f"  overhead, {how}"].append(end_to_end - predictor)

    port = free_port()
    connection = HTTPConnection("127.0.0.1", port)
    start = time.perf_counter()
    with running_service(port, arguments.threads) as process, GraspClient(f"http://127.0.0.1:{port}") as client:
        client.wait_until_ready(READY_WITHIN_S)
        ready_s = time.perf_counter() - start
        ready_memory = memory_mb(process.pid, "VmRSS")
        request = points_request(scene.points_world, options)
        for run in range(arguments.runs + 1):
            start = time.perf_counter()
            reply = client.grasps(scene.points_world, **options)
            with_client = (time.perf_counter() - start) * 1e3
            start = time.perf_counter()
            connection.request(request.method, request.target, request.content, dict(request.headers))
            answer = connection.getresponse().read()
            over_http = (time.perf_counter() - start) * 1e3
            if run > 0:  # the first requests open the connections
                note("over HTTP", over_http, json.loads(answer)["timings_ms"])
                note("with GraspClient", with_client, reply.timings_ms)
        connection.close()
        memory, highest = memory_mb(process.pid, "VmRSS"), memory_mb(process.pid, "VmHWM")

    print(f"{processor()}, device cpu, {arguments.threads} threads; application/octet-stream over loopback")
    print(
        f"{reply.counts.points} points, {reply.counts.candidates} candidates, {reply.counts.returned} returned; "
        f"{arguments.runs} requests\n"
    )
    print(table(samples))
    overhead, whole = (float(np.median(samples[name])) for name in ("  overhead, over HTTP", "over HTTP"))
    print(f"\noverhead of HTTP, decoding and queueing: {100 * overhead / whole:.1f} % of the median over HTTP")
    print(f"\ntime to ready    {ready_s:8.2f} s")
    print(f"memory at ready  {ready_memory:8.0f} MB resident")
    print(f"memory at end    {memory:8.0f} MB resident, {highest:.0f} MB at its highest")


if __name__ == "__main__":
    main()
