"""The service at capacity for a long time, and its memory: `python -m bench.soak --minutes 20`."""

from __future__ import annotations

import argparse
import asyncio
import time

from bench.load import Load, Outcome, percentiles
from bench.serve import memory_mb, running_service
from bench.table import processor
from client import GraspClient
from simharness.play.server import free_port

WARM_UP_S = 120.0
"""Before memory is first read: allocators take what they need once."""


def main() -> None:
    """Measure and print a line a minute."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0, help="after a warm-up of at most two minutes")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the predictor")
    parser.add_argument("--points", type=int, default=20_000, help="points in the cloud")
    parser.add_argument("--candidates", type=int, default=1_500, help="most candidates")
    arguments = parser.parse_args()

    port = free_port()
    url = f"http://127.0.0.1:{port}"
    total = Outcome()
    with running_service(port, arguments.threads) as process, GraspClient(url) as client:
        client.wait_until_ready(120)
        load = Load(url, arguments.points, arguments.candidates, timeout=30.0)
        asyncio.run(load.closed(min(WARM_UP_S, 60 * arguments.minutes)))
        first = last = memory_mb(process.pid, "VmRSS")
        print(f"{processor()}, {arguments.threads} threads, {arguments.points} points\n")
        print("minute   resident MB")
        start = time.perf_counter()
        while (left := 60 * arguments.minutes - (time.perf_counter() - start)) > 0:
            outcome = asyncio.run(load.closed(min(60.0, left)))
            total.statuses += outcome.statuses
            total.accepted_ms += outcome.accepted_ms
            last = memory_mb(process.pid, "VmRSS")
            print(f"{(time.perf_counter() - start) / 60:6.1f}   {last:11.1f}", flush=True)
        total.seconds = time.perf_counter() - start
    print(f"\nanswers {dict(total.statuses)}, {total.throughput:.2f}/s, p50/95/99 {percentiles(total.accepted_ms)} ms")
    print(f"memory  {first:.1f} MB after the warm-up, {last:.1f} MB at the end: {100 * (last / first - 1):+.2f} %")


if __name__ == "__main__":
    main()
