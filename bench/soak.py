"""The service at capacity for a long time, and its memory: `python -m bench.soak --minutes 30 --hostile`.

Beside the honest load, hostile requests of `bench.fuzz` are sent without pause where that is asked for. An honest
request that is lost (neither grasps nor a refusal in good order, which a machine busy with other work may need), a
hostile one that gets what `bench.fuzz` calls a finding, and memory that does not come back to what it was after the
warm-up are told, and the command ends with 1 then.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

from bench.fuzz import Findings, attack
from bench.load import Load, Outcome, beside, percentiles
from bench.serve import memory_mb, running_service
from bench.table import processor
from client import GraspClient
from simharness.play.server import free_port

WARM_UP_S = 120.0
"""Before memory is first read: allocators take what they need once."""
HOSTILE_AT_A_TIME = 100
"""Requests of one seed; the next begins when the load is not over then."""
MEMORY_WITHIN = 0.02
REFUSALS = (429, 503, 504)


@contextmanager
def attacked(url: str, seed: int) -> Iterator[Findings]:
    """Hostile requests, one after the other, for as long as the context lasts, and what came of them."""
    all_findings = Findings()

    def keep_attacking(ended: threading.Event) -> None:
        for number in count(seed):
            if ended.is_set():
                return
            found = attack(url, HOSTILE_AT_A_TIME, number)
            all_findings.statuses += found.statuses
            all_findings.wrong += found.wrong

    with beside(keep_attacking):
        yield all_findings


@contextmanager
def left_alone() -> Iterator[Findings]:
    """No hostile requests."""
    yield Findings()


def main() -> int:
    """Measure and print a line a minute."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0, help="after a warm-up of at most two minutes")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the predictor")
    parser.add_argument("--points", type=int, default=20_000, help="points in the cloud")
    parser.add_argument("--candidates", type=int, default=1_500, help="most candidates")
    parser.add_argument("--hostile", action="store_true", help="send hostile requests beside the load")
    parser.add_argument("--seed", type=int, default=0, help="of the hostile requests")
    arguments = parser.parse_args()

    port = free_port()
    url = f"http://127.0.0.1:{port}"
    total = Outcome()
    with running_service(port, arguments.threads) as process, GraspClient(url) as client:
        client.wait_until_ready(120)
        load = Load(url, arguments.points, arguments.candidates, timeout=30.0)
        print(f"{processor()}, {arguments.threads} threads, {arguments.points} points\n")
        print("minute   resident MB")
        with attacked(url, arguments.seed) if arguments.hostile else left_alone() as hostile:
            asyncio.run(load.closed(min(WARM_UP_S, 60 * arguments.minutes)))
            first = last = memory_mb(process.pid, "VmRSS")
            start = time.perf_counter()
            while (left := 60 * arguments.minutes - (time.perf_counter() - start)) > 0:
                outcome = asyncio.run(load.closed(min(60.0, left)))
                total.statuses += outcome.statuses
                total.accepted_ms += outcome.accepted_ms
                last = memory_mb(process.pid, "VmRSS")
                print(f"{(time.perf_counter() - start) / 60:6.1f}   {last:11.1f}", flush=True)
            total.seconds = time.perf_counter() - start
        client.wait_until_ready(5)
        highest = memory_mb(process.pid, "VmHWM")
    print(f"\nanswers {dict(total.statuses)}, {total.throughput:.2f}/s, p50/95/99 {percentiles(total.accepted_ms)} ms")
    print(f"hostile {dict(sorted(hostile.statuses.items()))}")
    growth = last / first - 1
    print(f"memory  {first:.1f} MB after the warm-up, {last:.1f} MB at the end: {100 * growth:+.2f} %")
    print(f"        {highest:.1f} MB at its highest")
    lost = sum(count for status, count in total.statuses.items() if status not in (200, *REFUSALS))
    wrong = hostile.wrong + [f"{lost} honest requests were lost"] * bool(lost)
    wrong += [f"memory grew by more than {100 * MEMORY_WITHIN:g} %"] * (growth > MEMORY_WITHIN)
    print("\n".join(wrong) or "nothing wrong found")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
