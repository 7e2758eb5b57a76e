"""Which sizes of things a run cleared, for runs on made sets such as `wide` and `flat`.

A thing's size is the least distance between two parallel planes that hold it, as scaled in its scene: the thickness of
what lies flat, the width of what is upright. Scenes are made again from the run's seeds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from simharness.errors import UsageError
from simharness.play.metrics import Rate
from simharness.play.records import RoundRecord
from simharness.play.round import round_scene
from simharness.play.settings import RunSettings
from simharness.sim.objects import ObjectModel
from simharness.sim.shapes.sets import SETS
from simharness.sim.world import World


def narrowest(corners: npt.NDArray[np.float64]) -> float:
    """The least distance between a face of the convex hull of corners (K, 3) and the corner farthest behind it."""
    from scipy.spatial import ConvexHull  # noqa: PLC0415 - takes longer to import than all else here

    hull = ConvexHull(corners)
    heights = corners[hull.vertices] @ hull.equations[:, :3].T + hull.equations[:, 3]
    return float(-heights.min(axis=0).max())


def sizes(
    settings: RunSettings, objects: Sequence[ObjectModel], rounds: Sequence[RoundRecord]
) -> list[tuple[float, bool]]:
    """Of every thing of a run's scenes: its size, metres, and whether it was grasped.

    Args:
        settings: of the run.
        objects: the run's object set.
        rounds: the recorded rounds.

    Raises:
        UsageError: the objects come from files, or no round was written yet.
    """
    if settings.objects not in SETS:
        raise UsageError(
            f"--objects {settings.objects}: sizes are known of {', '.join(SETS)}; give a run on one of them"
        )
    if not rounds:
        raise UsageError("the run has no round yet; wait for one, or go on with --resume")
    made = SETS[settings.objects]
    size_of: dict[str, float] = {}  # unscaled, of the things that were met so far
    found = []
    for record in rounds:
        with World() as world:
            placed = round_scene(world, settings, objects, record.seed, record.round).placed
        grasped = Counter(name for attempt in record.attempts for name in attempt.grasped)
        for thing in placed:
            if thing.name not in size_of:
                parts = [part for body in made.make(thing.name).bodies for part in body.parts]
                size_of[thing.name] = narrowest(np.concatenate([part.vertices for part in parts]))
            found.append((size_of[thing.name] * thing.scale, grasped[thing.name] > 0))
            grasped[thing.name] -= 1
    return found


def sizes_table(found: Sequence[tuple[float, bool]], bins: int) -> str:
    """Markdown: how many of the things in each of so many bins of size were grasped."""
    millimetres = 1e3 * np.array([size for size, _ in found])
    grasped = np.array([taken for _, taken in found])
    limits = np.linspace(np.floor(millimetres.min()), np.ceil(millimetres.max()), bins + 1)
    lines = ["| narrowest, mm | grasped, % | things |", "| --- | --- | --- |"]
    for number, (low, high) in enumerate(pairwise(limits)):
        within = (millimetres >= low) & ((millimetres < high) | (number == bins - 1))
        rate = Rate(int(grasped[within].sum()), int(within.sum()))
        least, most = rate.interval
        percent = "" if rate.value is None else f"{100 * rate.value:.1f} [{100 * least:.1f}, {100 * most:.1f}]"
        lines.append(f"| {low:.1f} to {high:.1f} | {percent} | {rate.count} of {rate.total} |")
    return "\n".join(lines)
