"""Whether low things between the fingers may be several, of which a closing hand holds none. Torch; metres."""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud

LOW = 0.03
"""What lies no higher over the support is low: side by side or on one another, such things look like one."""

_STEP = 0.002
"""Lower than the highest by more: another height."""

_CELL = 0.004
"""Across the opening, what lies in one such cell is one height."""

_CELLS_OF_GAP = 8
"""So many empty cells between two that are not weigh as much as different heights throughout."""

_STEEP = 0.9
"""Cosine with straight down of the travel of hands that stand over what they hold."""


def unevenness(cloud: PreparedCloud, candidates: Candidates, index: Tensor) -> Tensor:
    """How much the height of low things differs along the line on which the fingers close, from 0 (C,).

    The share of the occupied cells that are lower than the highest, and an eighth for every empty one among them. Zero
    where up or the support is unknown, where anything higher than `LOW` stands between the fingers, and for hands that
    do not come from above.

    Args:
        cloud: P points.
        candidates: C grasps.
        index: (C, M) of points near the fingers; of more than M some.
    """
    found = candidates.widths.new_zeros(len(candidates))
    if cloud.up is None or cloud.support_height is None:
        return found
    heights = cloud.points @ cloud.up - cloud.support_height
    down = -candidates.Ts_canonical_grasp[:, :3, 2] @ cloud.up
    rows = ((heights[candidates.approach] <= LOW) & (down > _STEEP)).nonzero()[:, 0]
    if len(rows):
        found[rows] = _unevenness(cloud.points, heights, candidates.select(rows), index[rows])
    return found


def _unevenness(points: Tensor, heights: Tensor, candidates: Candidates, index: Tensor) -> Tensor:
    poses, half = candidates.Ts_canonical_grasp, candidates.widths[:, None] / 2
    across = ((points[index] - poses[:, None, :3, 3]) * poses[:, None, :3, 1]).sum(dim=2)
    height = torch.where(across.abs() < half, heights[index], 0.0)
    count = int(torch.ceil(candidates.widths.max() / _CELL))
    cell = ((across + half) / _CELL).long().clamp(0, count - 1)
    tops = height.new_zeros(len(candidates), count).scatter_reduce(1, cell, height, "amax")
    occupied, highest = tops > 0, tops.amax(dim=1, keepdim=True)
    number = occupied.sum(dim=1)
    lower = (occupied & (tops < highest - _STEP)).sum(dim=1) / number.clamp(min=1)
    last = count - 1 - occupied.flip(1).int().argmax(dim=1)
    empty = (last - occupied.int().argmax(dim=1) + 1 - number) * (number > 0)
    return torch.where(highest[:, 0] <= LOW, lower + empty / _CELLS_OF_GAP, 0.0)
