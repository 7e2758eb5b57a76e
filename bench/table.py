"""Samples of milliseconds -> a table of medians and 95th percentiles, and the machine they were taken on."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np


def table(samples_ms: Mapping[str, Sequence[float]]) -> str:
    """One line per name: median and 95th percentile of its samples, in milliseconds."""
    width = max(len(name) for name in samples_ms)
    lines = [f"{'':{width}}  {'median ms':>10}  {'p95 ms':>10}"]
    for name, samples in samples_ms.items():
        median, p95 = np.percentile(samples, [50, 95])
        lines.append(f"{name:{width}}  {median:10.1f}  {p95:10.1f}")
    return "\n".join(lines)


def processor() -> str:
    """The processor's name, as far as the operating system tells."""
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
