"""How many CPU threads to compute with: as many as are wanted, fewer where other processes keep the cores busy.

OpenMP's threads wait for each other after each operation. Where another process has the core of one of them, the others
wait until the scheduler gives it back, a thousand times in a prediction; one thread waits for nobody. That a core is
shared shows in what this thread was given of it. Knows nothing of what is computed.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

FREE = 0.8
"""A core is this thread's own where it had at least this share of the time, and idle where nobody had it as long.
Waiting for other threads counts as computing, unless it lasts."""

STRETCH_S = 0.05
"""Seconds of work after which the number of threads is judged."""

LONGEST_PAUSE = 128
"""Such stretches with one thread, at most, before more are tried again on cores that looked idle and were not."""

Clock = Callable[[], float]

_JIFFIES = 100
"""In a second of /proc/stat."""
_IDLE = 4
"""Its column, behind the core's name."""


def idle_seconds(statistics: Path = Path("/proc/stat")) -> float:
    """Seconds that the cores which this process may use have been idle, all together; NaN where nobody tells."""
    try:
        rows = [line.split() for line in statistics.read_text(encoding="ascii").splitlines() if line.startswith("cpu")]
        ours = {f"cpu{number}" for number in os.sched_getaffinity(0)}
    except (AttributeError, OSError):  # another system than Linux
        return math.nan
    return sum(int(row[_IDLE]) for row in rows if row[0] in ours) / _JIFFIES


class Threads:
    """The number of threads for the pieces of work that one thread of the process does one after the other.

    Args:
        most: when the cores are free; None is torch's number at this moment.
        wall: seconds that have passed.
        cpu: seconds that the calling thread has computed.
        idle: seconds that the cores have been idle, all together; NaN where nobody tells.
    """

    def __init__(
        self,
        most: int | None = None,
        wall: Clock = time.perf_counter,
        cpu: Clock = time.thread_time,
        idle: Clock = idle_seconds,
    ) -> None:
        self.most = torch.get_num_threads() if most is None else most
        self.number = self.most
        self._clocks = (wall, cpu, idle)
        self._stretch = (0.0, 0.0, 0.0)
        self._pause, self._left = 1, 0

    @contextmanager
    def working(self) -> Iterator[None]:
        """A piece of work: sets torch's number of threads, and learns from it the number for what comes next."""
        torch.set_num_threads(self.number)
        before = self._read()
        yield
        wall, cpu, idle = (
            sofar + now - then for sofar, now, then in zip(self._stretch, self._read(), before, strict=True)
        )
        self._stretch = (wall, cpu, idle)
        if wall >= STRETCH_S:
            self._learn(cpu / wall, idle / wall)
            self._stretch = (0.0, 0.0, 0.0)

    def _read(self) -> tuple[float, float, float]:
        wall, cpu, idle = self._clocks
        return wall(), cpu(), idle() if self.number < self.most else 0.0

    def _learn(self, share: float, idle_cores: float) -> None:
        """Choose the number of threads by the share of a core that this thread had, and the cores that nobody had."""
        if share < FREE:
            if self.number > 1:
                self._left, self._pause = self._pause, min(2 * self._pause, LONGEST_PAUSE)
            self.number = 1
            return
        if self.number > 1:
            self._pause = 1
        self._left = max(0, self._left - 1)
        if self.number < self.most and not self._left:
            more = self.most if math.isnan(idle_cores) else int(idle_cores + 1 - FREE)
            self.number = min(self.most, self.number + more)
