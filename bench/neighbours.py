"""Busy processes beside what is measured, as a robot's computer has them. Started, and ended again, by who measures."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

_BUSY = """
import os
parent = os.getppid()
print(flush=True)
while os.getppid() == parent:
    sum(range(1_000_000))
"""
"""Says that it is there, then computes without pause until it is ended, or who started it is gone."""


@contextmanager
def neighbours(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """So many busy processes, all of them running, for as long as the context lasts."""
    command = [sys.executable, "-c", _BUSY]
    with ExitStack() as stack:
        processes = [stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE)) for _ in range(count)]
        for process in processes:
            stack.callback(process.kill)  # before its `__exit__`, which waits for it
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield processes
