"""The worst legal requests, in time and memory: `python -m bench.worst`.

Each is predicted, or decoded, in a process of its own by one thread; its time is told as a multiple of what
`bench.predict` takes for 20,000 points in the same sitting with the default weights, its memory as what the process
needed more than before, and as unseen the longest time in which a prediction did not look whether anybody waits for it.
What is tried follows from the limits and from the types of `tesnet.query.GraspQuery`, so that a new option is tried.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from bench import predict
from bench.scene import five_objects
from bench.serve import memory_mb
from bench.table import processor
from client.request import Intrinsics, depth_request
from service.errors import ServiceError
from service.payloads import decoder_for, most_rows
from service.settings import Settings
from tesnet.errors import InvalidQuery, TesnetError
from tesnet.geometry import WIDEST, Box, Gripper
from tesnet.hands import HANDS
from tesnet.predictor import FURTHER_SEARCHES, MOST_SCORED, GraspPredictor
from tesnet.query import MAX_APPROACH_POINTS, MAX_CANDIDATES, MAX_GRASPS, MAX_VIEWPOINTS, GraspQuery
from tesnet.weights import default_weights

MOST_POINTS = Settings().max_points
MOST_BYTES = Settings().max_body_bytes
LONGEST_PART = 0.5
"""Metres: of a hand."""
MOST_WIDE = 4000
"""Pixels."""
RUNS = 11

Array = NDArray[Any]
EVERYTHING = "everything"


def clouds() -> Mapping[str, Callable[[], GraspQuery]]:
    """The clouds that take longest, asked about with the most effort."""
    rng = np.random.default_rng(0)
    small = predict.query(five_objects(20_000), MAX_CANDIDATES, MAX_APPROACH_POINTS)
    bare = replace(small, workspace=None, support_height=None, up=None)

    def of(points: Array) -> GraspQuery:
        return replace(bare, points=points.astype(np.float32))

    def sheet() -> GraspQuery:
        """Along a side of the workspace, where the most places are taken for occupied."""
        points = np.column_stack([np.full(40_000, 0.0005), rng.uniform(0, 0.5, (40_000, 2))]).astype(np.float32)
        box = Box(np.zeros(3), np.array([0.5, 0.5, 0.5]))
        return replace(small, points=points, workspace=box, support_height=None)

    def table() -> GraspQuery:
        """Two metres wide, and what lies on it."""
        top = np.column_stack([rng.uniform(-1, 1, (MOST_POINTS // 2, 2)), rng.normal(0, 0.001, MOST_POINTS // 2)])
        things = rng.uniform([-0.5, -0.5, 0], [0.5, 0.5, 0.1], (MOST_POINTS - len(top), 3))
        return of(np.concatenate([top, things]))

    def image() -> GraspQuery:
        """Of the most pixels, of which the workspace keeps little."""
        points = rng.uniform([-0.2, -0.15, 0.5], [0.2, 0.15, 1.5], (most_rows(MOST_POINTS), 3))
        return replace(of(points), workspace=Box(np.array([-0.05, -0.05, 0.1]), np.array([0.05, 0.05, 2.0])))

    return {
        "20,000 points": lambda: small,
        "a sheet along a side": sheet,
        "most points, 0.3 m wide": lambda: of(rng.uniform(-0.15, 0.15, (MOST_POINTS, 3))),
        "most points, 4 m wide": lambda: of(rng.uniform(-2, 2, (MOST_POINTS, 3))),
        "most points, a table": table,
        "most pixels, of which few matter": image,
    }


def options(query: GraspQuery) -> Mapping[str, Mapping[str, Any]]:
    """Each option of a query at what should cost most: words, switches and known hands as its types name them."""
    rng = np.random.default_rng(1)
    count = len(query.points)
    views = rng.normal(0, 1, (MAX_VIEWPOINTS, 3)) + np.array([0, 0, 2])
    given: dict[str, Mapping[str, Any]] = {
        f"{field.name} {word}": {field.name: word}
        for field in fields(GraspQuery)
        for word in _words(get_type_hints(GraspQuery)[field.name])
        if word != field.default
    }
    given |= {f"gripper {name}": {"gripper": hand.gripper} for name, hand in HANDS.items()}
    return given | {
        "gripper, the largest": {"gripper": _largest_hand()},
        "viewpoints": {"viewpoints": views},
        "view_index": {"viewpoints": views, "view_index": np.arange(count) % MAX_VIEWPOINTS},
        "normals": {"normals": rng.normal(0, 1, (count, 3))},
        "target": {"target": rng.random(count) < 0.5},
        "most searches": {"max_candidates": MOST_SCORED // FURTHER_SEARCHES, "num_approach_points": 1},
        "most grasps": {"max_grasps": MAX_GRASPS, "separation_translation": 0.0},
    }


def _words(kind: Any) -> tuple[Any, ...]:
    """What an option of this type may be where that is a word or a switch."""
    if kind is bool:
        return (True, False)
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(word for part in get_args(kind) for word in _words(part))


def _largest_hand() -> Gripper:
    sizes: dict[str, Any] = {
        name: LONGEST_PART for name, size in Gripper().sizes().items() if size and name != "max_width"
    }
    return Gripper(**sizes | {"max_width": WIDEST, "tip_offset": Gripper().tip_offset})


def queries() -> Mapping[str, Callable[[], GraspQuery]]:
    """Every option by itself on the smallest cloud, and every cloud with nothing and with everything."""
    smallest = next(iter(clouds()))

    def with_option(cloud: str, name: str) -> GraspQuery:
        query = clouds()[cloud]()
        if name != EVERYTHING:
            return replace(query, **{"support_height": None, **options(query)[name]})
        for option in options(query).values():
            if "max_candidates" not in option and ("up" not in option or query.up is None):
                with contextlib.suppress(InvalidQuery):  # beside another option
                    query = replace(query, **option)
        return query

    cases: dict[str, Callable[[], GraspQuery]] = dict(clouds())
    cases |= {f"{smallest}, {name}": partial(with_option, smallest, name) for name in options(clouds()[smallest]())}
    return cases | {f"{cloud}, {EVERYTHING}": partial(with_option, cloud, EVERYTHING) for cloud in clouds()}


def bodies() -> Mapping[str, Callable[[], tuple[str, bytes]]]:
    """The bodies that take longest to decode, each with its content type before it."""
    form, text = "multipart/form-data; boundary=b", "application/json"
    part = b'--b\r\nContent-Disposition: form-data; name="cloud"\r\n\r\n'
    triples = b"[0.123456,0.123456,1.123456]"
    ply = b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n"

    def padded(start: bytes, fill: bytes, end: bytes = b"") -> bytes:
        return start + fill * ((MOST_BYTES - len(start) - len(end)) // len(fill)) + end

    def image(sent: Callable[[Array], Array | bytes]) -> tuple[str, bytes]:
        """Of the most pixels, of which the workspace keeps little; `sent` makes of their counts what is sent."""
        width, height = MOST_WIDE, most_rows(MOST_POINTS) // MOST_WIDE
        counts = np.random.default_rng(2).integers(500, 1500, (height, width), dtype=np.uint16)
        camera: Intrinsics = {"fx": 3000.0, "fy": 3000.0, "cx": width / 2, "cy": height / 2}
        workspace = {"min": [-0.05, -0.05, 0.1], "max": [0.05, 0.05, 2.0]}
        request = depth_request(sent(counts), camera, {"workspace": workspace})
        return request.headers["Content-Type"], request.content

    return {
        "a PNG of the most pixels": lambda: image(lambda counts: counts),
        "an .npy of the most pixels, in metres": lambda: image(_npy_in_metres),
        "JSON of the most points": lambda: (text, b'{"points": [' + b",".join([triples] * MOST_POINTS) + b"]}"),
        "JSON of backslashes": lambda: (text, padded(b'{"model": "', b"\\\\", b'"}')),
        "JSON of quotes": lambda: (text, padded(b'{"model": "', b'\\"', b'"}')),
        "a PLY of blank lines": lambda: (form, padded(part + ply, b"\n", b"\r\n--b--\r\n")),
        "a form with a long header": lambda: (form, padded(b"--b\r\nX: ", b"a")),
        "bytes behind a form": lambda: (form, padded(part + b"\r\n--b--\r\n", b"a")),
    }


def _npy_in_metres(counts: Array) -> bytes:
    file = io.BytesIO()
    np.save(file, counts.astype(np.float32) / 1000)
    return file.getvalue()


def _memory_now() -> float:
    """MB that this process holds, from which its peak is counted from now on (proc_pid_clear_refs(5))."""
    Path("/proc/self/clear_refs").write_text("5")
    return memory_mb(os.getpid(), "VmHWM")


def measure(name: str, weights: Path) -> dict[str, float]:
    """Seconds and MB of one case, in this process."""
    if name in bodies():
        content_type, content = bodies()[name]()
        body = bytearray(content)
        del content
        before, started = _memory_now(), time.perf_counter()
        with contextlib.suppress(ServiceError, TesnetError):
            decoder_for(content_type)(body, MOST_POINTS)
        return {"seconds": time.perf_counter() - started, "mb": memory_mb(os.getpid(), "VmHWM") - before}
    predictor = GraspPredictor.load(weights, num_threads=1)
    predictor.warm_up()
    asked, looks = queries()[name](), [time.perf_counter()]

    def give_up() -> bool:
        looks.append(time.perf_counter())
        return False

    before, looks[0] = _memory_now(), time.perf_counter()
    predictor.predict(asked, give_up)
    looks.append(time.perf_counter())
    return {
        "seconds": looks[-1] - looks[0],
        "mb": memory_mb(os.getpid(), "VmHWM") - before,
        "unseen": float(np.diff(looks).max()),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--case", help="measure this one here and print JSON")
    parser.add_argument("--only", default="", metavar="TEXT", help="cases whose name holds this text")
    parser.add_argument("--weights", type=Path, default=default_weights(), help="of the network that is asked")
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(measure(arguments.case, arguments.weights)))
        return

    predictor = GraspPredictor.load(default_weights(), num_threads=1)
    predictor.warm_up()
    _, samples = predict.measure(predictor, predict.query(five_objects(20_000), 1_500, 32), RUNS)
    usual = float(np.median(samples["total"])) / 1e3
    print(f"{processor()}, one thread; 20,000 points take a median of {1e3 * usual:.0f} ms ({RUNS} runs)\n")
    print(f"{'':48} {'seconds':>8} {'times':>7} {'more MB':>8} {'unseen ms':>10}")
    for name in (*queries(), *bodies()):
        if arguments.only not in name:
            continue
        command = [sys.executable, "-m", "bench.worst", "--case", name, "--weights", str(arguments.weights)]
        found = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
        seconds = found["seconds"]
        unseen = f"{1e3 * found['unseen']:10.0f}" if "unseen" in found else ""
        print(f"{name:48} {seconds:8.2f} {seconds / usual:7.1f} {found['mb']:8.0f} {unseen}", flush=True)


if __name__ == "__main__":
    main()
