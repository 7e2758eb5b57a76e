"""Scores become ranked, diverse grasps: threshold, order, suppression of near-duplicates.

Knows no network and no cloud. Works in numpy on the CPU wherever the scores lie: each step touches a few thousand
numbers, for which starting a kernel would take longer than the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor


@dataclass(frozen=True, eq=False, slots=True)
class Ranking:
    """Which candidates are returned, and what became of the others.

    Args:
        indices: (M,) into the candidates, best first, on the CPU.
        below_min_score: candidates under the threshold.
        duplicates: candidates suppressed by a returned grasp. What `max_grasps` cut off is in neither count.
    """

    indices: Int64[Tensor, " returned"]
    below_min_score: int
    duplicates: int


def rank(
    scores: Float[Tensor, " candidates"],
    Ts_cloud_grasp: Float[Tensor, "candidates 4 4"],
    *,
    max_grasps: int,
    min_score: float,
    separation_translation: float,
    separation_rotation_deg: float,
) -> Ranking:
    """The best grasps of which no two are the same, by greedy non-maximum suppression.

    Two grasps are the same when their TCPs are less than `separation_translation` (metres) apart and their hands are
    turned by at most `separation_rotation_deg`, half a turn about z being no turn at all. So a translation of 0 makes
    no two grasps the same, and a rotation of 180 leaves the translation to decide.

    A score equal to `min_score` passes. Of equal scores the candidate with the lower index comes first. No score may be
    NaN. The work grows with candidates times grasps returned.
    """
    values = scores.detach().cpu().double().numpy()
    passing = np.flatnonzero(values >= min_score)
    order = passing[np.argsort(-values[passing], kind="stable")]
    Ts = Ts_cloud_grasp.detach().cpu().double().numpy()[order]
    positions, rotations = np.ascontiguousarray(Ts[:, :3, 3].T), np.ascontiguousarray(Ts[:, :3, :3])
    free = np.ones(len(order), dtype=bool)
    taken: list[int] = []
    while len(taken) < max_grasps and free.any():
        best = int(free.argmax())
        free[best] = False
        taken.append(best)
        # Whatever is better than this one has been decided.
        worse = _same_as_first(positions[:, best:], rotations[best:], separation_translation, separation_rotation_deg)
        free[best + worse] = False
    return Ranking(
        indices=torch.from_numpy(order[taken]),
        below_min_score=len(values) - len(order),
        duplicates=len(order) - len(taken) - int(free.sum()),
    )


def _same_as_first(
    positions: Float64[np.ndarray, "3 candidates"],
    rotations: Float64[np.ndarray, "candidates 3 3"],
    separation_translation: float,
    separation_rotation_deg: float,
) -> Int64[np.ndarray, " same"]:
    """Indices of the candidates that are the same grasp as the first.

    The angle t between two rotations has 1 + 2 cos t = x.x' + y.y' + z.z'. A parallel hand turned by half a turn about
    z is the same hand with x' and y' reversed, so the smaller of the two angles has 1 + 2 cos t = |x.x' + y.y'| + z.z'.
    """
    offsets = positions - positions[:, :1]
    near = np.flatnonzero(np.einsum("ij,ij->j", offsets, offsets) < separation_translation**2)
    x, y, z = (rotations[near] * rotations[0]).sum(axis=1).T  # of the few that are near
    # Rounding may put the trace of a half turn just under its least value, -1.
    limit = 1 + 2 * math.cos(math.radians(separation_rotation_deg)) - 1e-9
    same: np.ndarray = near[np.abs(x + y) + z >= limit]
    return same
