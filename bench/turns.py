"""Light requests beside heavy clients: `python -m bench.turns --seconds 30`.

One client asks for small clouds at a steady pace, first alone and then beside clients that ask for the largest clouds
one after the other. The figure is how many times longer its median is then. What sends shares the machine.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bench.scene import UP, five_objects
from bench.serve import running_service
from bench.table import processor, table
from client import GraspClient, GraspClientError, Overloaded
from simharness.play.server import free_port

JITTER = 0.0005
"""Metres by which the copies of a cloud's points differ in the heavy clients' clouds."""


@dataclass
class Answers:
    """What a client got: milliseconds of its 200s, and how its other requests ended."""

    milliseconds: list[float] = field(default_factory=list)
    other: Counter[str] = field(default_factory=Counter)


def ask(url: str, points: NDArray[np.float32], pause: float, ended: threading.Event, answers: Answers) -> None:
    """Ask for one cloud again and again, `pause` seconds apart, until `ended`."""
    with GraspClient(url, timeout=60) as client:
        while not ended.is_set():
            started = time.perf_counter()
            try:
                client.grasps(points, up=UP)
                answers.milliseconds.append(1e3 * (time.perf_counter() - started))
            except Overloaded as refused:
                answers.other[f"{refused.status}"] += 1
            except GraspClientError as error:
                answers.other[type(error).__name__] += 1
            ended.wait(max(0.0, pause - (time.perf_counter() - started)))


def stretch(url: str, seconds: float, light: NDArray[np.float32], heavy: NDArray[np.float32], clients: int) -> Answers:
    """What the light client got in so many seconds beside heavy clients."""
    ended, answers, heavy_answers = threading.Event(), Answers(), Answers()
    threads = [threading.Thread(target=ask, args=(url, heavy, 0.0, ended, heavy_answers)) for _ in range(clients)]
    threads.append(threading.Thread(target=ask, args=(url, light, 0.25, ended, answers)))
    for thread in threads:
        thread.start()
    time.sleep(seconds)
    ended.set()
    for thread in threads:
        thread.join()
    if clients:
        print(f"heavy: {len(heavy_answers.milliseconds)} answers, other {dict(heavy_answers.other)}")
    return answers


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each of the two stretches")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of the predictor")
    parser.add_argument("--clients", type=int, default=8, help="heavy clients")
    parser.add_argument("--points", type=int, default=1_000_000, help="in a heavy client's cloud")
    arguments = parser.parse_args()

    rng = np.random.default_rng(0)
    light = five_objects(20_000).points_world[::10].copy()
    copies = -(-arguments.points // 20_000)
    heavy = np.tile(five_objects(20_000).points_world, (copies, 1))[: arguments.points]
    heavy = heavy + rng.normal(0, JITTER, heavy.shape).astype(np.float32)
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    with running_service(port, arguments.threads), GraspClient(url) as client:
        client.wait_until_ready(120)
        client.grasps(light, up=UP)
        quiet = stretch(url, arguments.seconds, light, heavy, 0)
        beside = stretch(url, arguments.seconds, light, heavy, arguments.clients)
    print(f"{processor()}, {arguments.threads} threads, {len(light)} points a light cloud, {len(heavy)} a heavy one\n")
    name = f"beside {arguments.clients} heavy clients"
    print(table({"alone": quiet.milliseconds, name: beside.milliseconds}))
    print(f"\nlight requests that ended otherwise: {dict(quiet.other + beside.other) or 'none'}")
    print(f"median beside / alone: {np.median(beside.milliseconds) / np.median(quiet.milliseconds):.2f}")


if __name__ == "__main__":
    main()
