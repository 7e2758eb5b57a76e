"""The worst legal requests, in time and memory: `python -m bench.worst`.

Each is predicted, or decoded, in a process of its own by one thread; its time is told as a multiple of what
`bench.predict` takes for 20,000 points in the same sitting, its memory as what the process needed more than before.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bench import predict
from bench.scene import five_objects
from bench.serve import memory_mb
from bench.table import processor
from service.errors import ServiceError
from service.payloads import decoder_for
from service.settings import Settings
from tesnet.errors import TesnetError
from tesnet.geometry import Box
from tesnet.predictor import GraspPredictor
from tesnet.query import MAX_APPROACH_POINTS, MAX_CANDIDATES, MAX_VIEWPOINTS, GraspQuery
from tesnet.weights import default_weights

MOST_POINTS = Settings().max_points
MOST_BYTES = Settings().max_body_bytes
RUNS = 11


def queries() -> Mapping[str, Callable[[], GraspQuery]]:
    """The queries that take longest, by what is the most of each."""
    rng = np.random.default_rng(0)
    base = predict.query(five_objects(20_000), MAX_CANDIDATES, MAX_APPROACH_POINTS)
    views = rng.normal(0, 1, (MAX_VIEWPOINTS, 3)) + np.array([0, 0, 2])

    def sheet() -> GraspQuery:
        """Along a side of the workspace, where the most places are taken for occupied."""
        points = np.column_stack([np.full(40_000, 0.0005), rng.uniform(0, 0.5, (40_000, 2))]).astype(np.float32)
        box = Box(np.zeros(3), np.array([0.5, 0.5, 0.5]))
        return replace(base, points=points, workspace=box, support_height=None)

    def everywhere(width: float) -> GraspQuery:
        points = rng.uniform(-width / 2, width / 2, (MOST_POINTS, 3)).astype(np.float32)
        return replace(base, points=points, workspace=None, support_height=None, viewpoints=views, unseen="occupied")

    return {
        "20,000 points, most effort": lambda: base,
        "the same, 64 viewpoints, occupied": lambda: replace(base, viewpoints=views, unseen="occupied"),
        "a sheet along a side, most effort": sheet,
        "most points in 0.3 m, all of it": lambda: everywhere(0.3),
        "most points in 4 m, all of it": lambda: everywhere(4.0),
    }


def bodies() -> Mapping[str, tuple[str, Callable[[], bytes]]]:
    """The bodies that take longest to decode, each with its content type."""
    form = "multipart/form-data; boundary=b"
    part = b'--b\r\nContent-Disposition: form-data; name="cloud"\r\n\r\n'
    triples = b"[0.123456,0.123456,1.123456]"
    ply = b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n"

    def padded(start: bytes, fill: bytes, end: bytes = b"") -> bytes:
        return start + fill * ((MOST_BYTES - len(start) - len(end)) // len(fill)) + end

    return {
        "JSON of the most points": (
            "application/json",
            lambda: b'{"points": [' + b",".join([triples] * MOST_POINTS) + b"]}",
        ),
        "JSON of backslashes": ("application/json", lambda: padded(b'{"model": "', b"\\\\", b'"}')),
        "JSON of quotes": ("application/json", lambda: padded(b'{"model": "', b'\\"', b'"}')),
        "a PLY of blank lines": (form, lambda: padded(part + ply, b"\n", b"\r\n--b--\r\n")),
        "a form with a long header": (form, lambda: padded(b"--b\r\nX: ", b"a")),
        "bytes behind a form": (form, lambda: padded(part + b"\r\n--b--\r\n", b"a")),
    }


def measure(name: str) -> dict[str, float]:
    """Seconds and MB of one case, in this process."""
    if name in bodies():
        content_type, make = bodies()[name]
        body = bytearray(make())
        before, started = memory_mb(os.getpid(), "VmHWM"), time.perf_counter()
        with contextlib.suppress(ServiceError, TesnetError):
            decoder_for(content_type)(body, MOST_POINTS)
        return {"seconds": time.perf_counter() - started, "mb": memory_mb(os.getpid(), "VmHWM") - before}
    predictor = GraspPredictor.load(default_weights(), num_threads=1)
    predictor.warm_up()
    asked = queries()[name]()
    before, started = memory_mb(os.getpid(), "VmHWM"), time.perf_counter()
    predictor.predict(asked)
    return {"seconds": time.perf_counter() - started, "mb": memory_mb(os.getpid(), "VmHWM") - before}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--case", help="measure this one here and print JSON")
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(measure(arguments.case)))
        return

    predictor = GraspPredictor.load(default_weights(), num_threads=1)
    predictor.warm_up()
    _, samples = predict.measure(predictor, predict.query(five_objects(20_000), 1_500, 32), RUNS)
    usual = float(np.median(samples["total"])) / 1e3
    print(f"{processor()}, one thread; 20,000 points take a median of {1e3 * usual:.0f} ms ({RUNS} runs)\n")
    print(f"{'':36} {'seconds':>8} {'times':>7} {'more MB':>8}")
    for name in (*queries(), *bodies()):
        command = [sys.executable, "-m", "bench.worst", "--case", name]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        print(f"{name:36} {found['seconds']:8.2f} {found['seconds'] / usual:7.1f} {found['mb']:8.0f}", flush=True)


if __name__ == "__main__":
    main()
