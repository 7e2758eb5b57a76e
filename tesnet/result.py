"""What the predictor answers: ranked grasps, and the account of how many candidates fell where. numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tesnet.geometry import GraspSet

Reason = Literal["no_points_in_workspace", "too_few_points", "no_candidates", "all_in_collision", "below_min_score"]

REJECTIONS = ("support", "from_below", "approach", "target", "collision", "min_score", "duplicates")
"""The steps that drop candidates; one that several would drop counts for the first that looks at it."""


@dataclass(frozen=True, slots=True)
class GraspCounts:
    """How many points and candidates each step left; `rejected` has every name of `REJECTIONS`.

    `ignored_points` were posted, but are not finite and not among `points`.
    """

    points: int
    prepared_points: int
    candidates: int
    collision_free: int
    returned: int
    rejected: Mapping[str, int]
    ignored_points: int = 0


@dataclass(frozen=True, slots=True)
class GraspResult:
    """The predictor's answer.

    Args:
        grasps: best first, in the frame of the query's points.
        counts: the account of points and candidates.
        reason: why there is no grasp, or None when there is one.
        warnings: what the caller should know about the query.
        timings_ms: milliseconds spent in `prepare`, `candidates`, `network` and `rank`.
    """

    grasps: GraspSet
    counts: GraspCounts
    reason: Reason | None
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]
