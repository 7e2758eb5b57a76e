"""Light requests beside heavy clients: `python -m bench.turns --seconds 30`.

One client asks for small clouds at a steady pace, first alone and then beside clients that ask for the largest clouds
one after the other. The figure is how many times longer its median is then; the table says at which stage. The heavy
clients are a process of their own, so that they hold no lock of Python's that the light one needs, but they share the
machine.
"""

from __future__ import annotations

import argparse
import multiprocessing
import threading
import time
from collections import Counter, defaultdict
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.scene import UP, five_objects
from bench.serve import running_service
from bench.table import processor, table
from client import GraspClient, GraspClientError, Overloaded
from simharness.play.server import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.synchronize import Event

LIGHT_POINTS, PAUSE_S = 2_000, 0.25
WHOLE = "whole request"
JITTER = 0.0005
"""Metres by which the copies of a cloud's points differ in the heavy clients' clouds."""


@dataclass
class Answers:
    """What a client got: milliseconds of its 200s, in all and by stage, and how its other requests ended."""

    milliseconds: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    other: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        return f"{len(self.milliseconds[WHOLE])} answers, other {dict(self.other) or 'none'}"


def ask(url: str, points: NDArray[np.float32], pause: float, ended: Event | threading.Event, answers: Answers) -> None:
    """Ask for one cloud again and again, `pause` seconds apart, until `ended`."""
    with GraspClient(url, timeout=60) as client:
        while not ended.is_set():
            started = time.perf_counter()
            try:
                reply = client.grasps(points, up=UP)
                answers.milliseconds[WHOLE].append(1e3 * (time.perf_counter() - started))
                for stage, milliseconds in reply.timings_ms.items():
                    answers.milliseconds[f"  {stage}"].append(milliseconds)
            except Overloaded as refused:
                answers.other[f"{refused.status}"] += 1
            except GraspClientError as error:
                answers.other[type(error).__name__] += 1
            ended.wait(max(0.0, pause - (time.perf_counter() - started)))


def heavy_clients(url: str, number: int, points: int, began: Event, ended: Event) -> None:
    """Ask for large clouds with so many clients until `ended`; prints what they got."""
    cloud = np.resize(five_objects(20_000).points_world, (points, 3))
    cloud = cloud + np.random.default_rng(0).normal(0, JITTER, cloud.shape).astype(np.float32)
    answers = Answers()
    threads = [threading.Thread(target=ask, args=(url, cloud, 0.0, ended, answers)) for _ in range(number)]
    for thread in threads:
        thread.start()
    began.set()
    for thread in threads:
        thread.join()
    print(f"heavy clients: {answers}")


@contextmanager
def crowd(url: str, number: int, points: int) -> Iterator[None]:
    """So many heavy clients for as long as the context lasts."""
    spawn = multiprocessing.get_context("spawn")
    began, ended = spawn.Event(), spawn.Event()
    process = spawn.Process(target=heavy_clients, args=(url, number, points, began, ended))
    process.start()
    try:
        if not began.wait(60):
            raise SystemExit("the heavy clients did not start within 60 s")
        yield
    finally:
        ended.set()
        process.join()


def stretch(url: str, seconds: float, cloud: NDArray[np.float32]) -> Answers:
    """What the light client got in so many seconds."""
    ended, answers = threading.Event(), Answers()
    timer = threading.Timer(seconds, ended.set)
    timer.start()
    ask(url, cloud, PAUSE_S, ended, answers)
    return answers


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each of the two stretches")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of the predictor")
    parser.add_argument("--clients", type=int, default=8, help="heavy clients")
    parser.add_argument("--points", type=int, default=1_000_000, help="in a heavy client's cloud")
    arguments = parser.parse_args()

    light = np.ascontiguousarray(five_objects(20_000).points_world[:: 20_000 // LIGHT_POINTS])
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    with running_service(port, arguments.threads), GraspClient(url) as client:
        client.wait_until_ready(120)
        client.grasps(light, up=UP)
        alone = stretch(url, arguments.seconds, light)
        with crowd(url, arguments.clients, arguments.points):
            beside = stretch(url, arguments.seconds, light)
    print(
        f"{processor()}, {arguments.threads} threads, {len(light)} points a light cloud, {arguments.points} a heavy one"
    )
    for how, answers in {"alone": alone, f"beside {arguments.clients} heavy clients": beside}.items():
        print(f"\n{how}: {answers}\n{table(answers.milliseconds)}")
    ratio = np.median(beside.milliseconds[WHOLE]) / np.median(alone.milliseconds[WHOLE])
    print(f"\nmedian beside / alone: {ratio:.2f}")


if __name__ == "__main__":
    main()
