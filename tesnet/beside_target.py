"""Whether a hand that is to grasp one thing would close on another as well. Vectorised torch; metres."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.points import points_in_grasp_frames

MARGIN = 0.005
"""What lies no farther beside the target is taken to be of it: marks end a few pixels short of a thing's edge."""

FEWEST = 2
"""So many points beside the target are another thing."""

_BESIDE_PAD = 0.001
_PLACES_AT_ONCE = 2_000_000


def closes_on_others(
    cloud: PreparedCloud, candidates: Candidates, between: Callable[[], None] = lambda: None
) -> Tensor:
    """Mask (C,): between the fingers and farther out than the target lies what is not of it.

    The fingers would meet that first. What lies under, over or amid the target is no matter.

    Args:
        cloud: P points, of which some are on the target.
        candidates: C grasps of one hand, open.
        between: called between blocks of work of some milliseconds.
    """
    assert cloud.on_target is not None
    found = torch.zeros(len(candidates), dtype=torch.bool, device=cloud.points.device)
    for rows in torch.arange(len(candidates), device=found.device).split(max(1, _PLACES_AT_ONCE // len(cloud))):
        between()
        found[rows] = _closes_on_others(cloud.points, cloud.on_target, candidates.select(rows))
    return found


def _closes_on_others(points: Tensor, on_target: Tensor, candidates: Candidates) -> Tensor:
    hand = candidates.gripper
    x, y, z = points_in_grasp_frames(points, candidates.Ts_canonical_grasp)
    inside = (x.abs() < hand.finger_tip_breadth / 2 + _BESIDE_PAD) & (y.abs() < candidates.widths[:, None] / 2)
    inside &= (z > hand.palm_front) & (z < hand.tip_offset)
    of_target = inside & on_target
    low = torch.where(of_target, y, torch.inf).amin(dim=1, keepdim=True) - MARGIN
    high = torch.where(of_target, y, -torch.inf).amax(dim=1, keepdim=True) + MARGIN
    others = inside & ~on_target & ((y < low) | (y > high))
    return others.sum(dim=1) >= FEWEST
