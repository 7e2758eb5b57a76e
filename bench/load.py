"""The service under load: `python -m bench.load --seconds 30`.

First its capacity is measured with as many requests in flight as it takes to keep it busy. Then requests arrive at
random moments (a Poisson process, seeded) at half, once, twice and ten times that rate, whether answers come or not,
while `GET /health/live` is asked twenty times a second from a thread of its own. What sends shares the machine with the
service; the last column tells how much of it that took.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np

from bench.scene import SUPPORT_HEIGHT, UP, WORKSPACE_MAXIMUM, WORKSPACE_MINIMUM, five_objects
from bench.serve import memory_mb, running_service
from bench.table import processor
from client import GraspClient
from simharness.play.server import free_port

IN_FLIGHT = 4
"""Requests that keep the service busy: one is predicted while others are read, decoded or answered."""
HEALTH_PERIOD_S = 0.05
FACTORS = (0.5, 1.0, 2.0, 10.0)


@dataclass
class Outcome:
    """What became of the requests of one stretch.

    Args:
        seconds: from the first request to the last answer.
        statuses: how many answers of each status; 0 is a connection that failed.
        accepted_ms, rejected_ms: from sending to the answer's last byte, of 200s and of 429s and 503s.
        health_ms: of `GET /health/live`.
        sender_cores: cores that sending kept busy.
    """

    seconds: float = 0.0
    statuses: Counter[int] = field(default_factory=Counter)
    accepted_ms: list[float] = field(default_factory=list)
    rejected_ms: list[float] = field(default_factory=list)
    health_ms: list[float] = field(default_factory=list)
    sender_cores: float = 0.0

    @property
    def throughput(self) -> float:
        """Grasp answers a second."""
        return self.statuses[200] / self.seconds

    def share(self, *statuses: int) -> float:
        """Share of the requests that were answered so, in %."""
        return 100 * sum(self.statuses[status] for status in statuses) / max(1, sum(self.statuses.values()))


class Load:
    """Sends one cloud again and again.

    Args:
        url: of the service.
        points: in the cloud.
        candidates: most candidates.
        timeout: deadline of a request, seconds.
    """

    def __init__(self, url: str, points: int, candidates: int, timeout: float) -> None:
        scene = five_objects(points)
        box = f'{{"min": {list(WORKSPACE_MINIMUM)}, "max": {list(WORKSPACE_MAXIMUM)}}}'
        options = {
            "viewpoint": str(scene.viewpoint_world.tolist()),
            "up": str(list(UP)),
            "workspace": box,
            "support_height": str(SUPPORT_HEIGHT),
            "max_candidates": str(candidates),
        }
        self._url = url
        self._path = "/grasps?" + "&".join(f"{name}={quote(value)}" for name, value in options.items())
        self._body = scene.points_world.tobytes()
        self._headers = {"Content-Type": "application/octet-stream", "X-Request-Timeout": str(timeout)}
        self._patience = timeout + 30.0

    async def closed(self, seconds: float) -> Outcome:
        """`IN_FLIGHT` clients that each ask again when they are answered."""
        outcome = Outcome()
        async with self._client() as client:
            start = time.perf_counter()

            async def keep_asking() -> None:
                while time.perf_counter() - start < seconds:
                    await self._ask(client, outcome)

            await asyncio.gather(*(keep_asking() for _ in range(IN_FLIGHT)))
            outcome.seconds = time.perf_counter() - start
        return outcome

    async def open(self, rate: float, seconds: float, seed: int) -> Outcome:
        """Requests at random moments, `rate` a second on average, that wait for no answer."""
        outcome = Outcome()
        gaps = np.random.default_rng(seed).exponential(1 / rate, size=max(1, round(rate * seconds)))
        moments = np.cumsum(gaps)
        async with self._client() as client:
            start = time.perf_counter()
            asked = []
            for moment in moments:
                await asyncio.sleep(max(0.0, start + float(moment) - time.perf_counter()))
                asked.append(asyncio.create_task(self._ask(client, outcome)))
            await asyncio.gather(*asked)
            outcome.seconds = time.perf_counter() - start
        return outcome

    def _client(self) -> httpx.AsyncClient:
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
        return httpx.AsyncClient(base_url=self._url, timeout=self._patience, limits=limits)

    async def _ask(self, client: httpx.AsyncClient, outcome: Outcome) -> None:
        start = time.perf_counter()
        try:
            answer = await client.post(self._path, content=self._body, headers=self._headers)
            status = answer.status_code
        except httpx.TransportError:
            status = 0
        taken = 1e3 * (time.perf_counter() - start)
        outcome.statuses[status] += 1
        if status == 200:
            outcome.accepted_ms.append(taken)
        elif status in (429, 503):
            outcome.rejected_ms.append(taken)


def measured(url: str, sending: Coroutine[Any, Any, Outcome]) -> Outcome:
    """The outcome of sending, with what was seen meanwhile."""
    cpu = time.process_time()
    with probing(url) as health:
        outcome = asyncio.run(sending)
    outcome.health_ms = health
    outcome.sender_cores = (time.process_time() - cpu) / outcome.seconds
    return outcome


@contextmanager
def probing(url: str) -> Iterator[list[float]]:
    """Milliseconds of `GET /health/live`, asked in a thread for as long as the context lasts."""
    samples: list[float] = []

    def probe(ended: threading.Event) -> None:
        connection = http.client.HTTPConnection(url.removeprefix("http://"), timeout=60)
        while not ended.wait(HEALTH_PERIOD_S):
            start = time.perf_counter()
            connection.request("GET", "/health/live")
            connection.getresponse().read()
            samples.append(1e3 * (time.perf_counter() - start))
        connection.close()

    with beside(probe):
        yield samples


@contextmanager
def beside(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Work in a thread for as long as the context lasts, after which the event that it is given is set."""
    ended = threading.Event()
    thread = threading.Thread(target=work, args=(ended,))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def percentiles(samples: list[float]) -> str:
    """Median, 95th and 99th percentile, or a dash."""
    return "/".join(f"{value:.0f}" for value in np.percentile(samples, [50, 95, 99])) if samples else "-"


def row(name: str, offered: float, outcome: Outcome) -> str:
    """A line of the table."""
    other = 100 - outcome.share(200) - outcome.share(429, 503) - outcome.share(504)
    return (
        f"{name:>9}  {offered:9.2f}  {outcome.throughput:9.2f}  {outcome.share(200):6.1f}  "
        f"{outcome.share(429, 503):8.1f}  {outcome.share(504):6.1f}  {abs(other):6.1f}  "
        f"{percentiles(outcome.accepted_ms):>18}  {percentiles(outcome.rejected_ms):>14}  "
        f"{percentiles(outcome.health_ms):>12}  {outcome.sender_cores:6.2f}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each stretch (default 30)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the predictor (default 2)")
    parser.add_argument("--points", type=int, default=20_000, help="points in the cloud (default 20000)")
    parser.add_argument("--candidates", type=int, default=1_500, help="most candidates (default 1500)")
    parser.add_argument("--timeout", type=float, default=30.0, help="X-Request-Timeout, seconds (default 30)")
    parser.add_argument("--queue-size", type=int, default=32, help="GRASP_QUEUE_SIZE (default 32)")
    parser.add_argument("--max-batch", type=int, default=1, help="GRASP_MAX_BATCH (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the arrivals (default 0)")
    arguments = parser.parse_args()

    port = free_port()
    url = f"http://127.0.0.1:{port}"
    settings = {"GRASP_QUEUE_SIZE": str(arguments.queue_size), "GRASP_MAX_BATCH": str(arguments.max_batch)}
    print(
        f"{processor()}, {arguments.threads} threads, {arguments.points} points, {arguments.candidates} candidates, "
        f"queue {arguments.queue_size}, batch {arguments.max_batch}, deadline {arguments.timeout:g} s, "
        f"{arguments.seconds:g} s each\n"
    )
    print(
        f"{'load':>9}  {'offered/s':>9}  {'answers/s':>9}  {'200 %':>6}  {'429+503':>8}  {'504 %':>6}  {'else %':>6}  "
        f"{'200: p50/95/99 ms':>18}  {'refusal: ms':>14}  {'health: ms':>12}  {'sender':>6}"
    )
    with running_service(port, arguments.threads, **settings) as process, GraspClient(url) as client:
        client.wait_until_ready(120)
        load = Load(url, arguments.points, arguments.candidates, arguments.timeout)
        asyncio.run(load.closed(min(5.0, arguments.seconds)))  # not measured: what is slow the first time
        outcome = measured(url, load.closed(arguments.seconds))
        capacity = outcome.throughput
        print(row("capacity", capacity, outcome), flush=True)
        for factor in FACTORS:
            outcome = measured(url, load.open(factor * capacity, arguments.seconds, arguments.seed))
            print(row(f"{factor:g} x", factor * capacity, outcome), flush=True)
        print(f"\nmemory at its highest: {memory_mb(process.pid, 'VmHWM'):.0f} MB resident")


if __name__ == "__main__":
    main()
