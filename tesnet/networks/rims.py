"""Whether a hand would pinch a rim, such as a bowl's, that it then drops. Torch; metres.

Hands whose tips swing far forward as they close do so where a finger first meets a slope, the inside of a bowl, with
its tip alone, or where they close on a thin wall of which the camera saw one face: a network that saw few such hands
scores these as high as others.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud

_FIRST = 0.003
"""Points this near to the first that a pad meets count as met, too."""

_ASIDE = 0.001
"""So far beside a tip's breadth, and ahead of its end, points still count."""

_BEHIND_TIP = (0.006, 0.002)
"""As far behind the end of the finger lies, in the mean, what the pad meets, and what the tip alone meets."""

_LEANING = (0.15, 0.4)
"""Cosines of the normal with the direction against the travel, of a wall and of a slope."""

_FACING = 0.3
"""Cosine of the normal with the finger's way: less, and it was not seen what the finger meets."""

_AWAY = (-0.4, -0.8)
"""The same of what was seen from one side alone: a little, and wholly."""

_THIN = (0.026, 0.018)
"""Between the fingers, of things, and of thin walls."""


def poor_pinch(cloud: PreparedCloud, candidates: Candidates, index: Tensor) -> Tensor:
    """How much each hand would hold something by a rim that it drops, from 0 to 1 (C,).

    Zero for hands that do not swing far (`Gripper.swings_far`), and where nothing lies between the fingers.

    Args:
        cloud: P points.
        candidates: C grasps of one hand, as their fingers come to rest.
        index: (C, M) of points near the fingers; of more than M some.
    """
    hand, poses = candidates.gripper, candidates.Ts_canonical_grasp
    if not hand.swings_far:
        return candidates.widths.new_zeros(len(candidates))
    rotation = poses[:, :3, :3]
    x, y, z = ((cloud.points[index] - poses[:, None, :3, 3]) @ rotation).unbind(dim=2)
    _, facing, along = (cloud.normals[index] @ rotation).unbind(dim=2)
    between = (x.abs() < hand.finger_tip_breadth / 2 + _ASIDE) & (z > hand.palm_front) & (z < hand.tip_offset + _ASIDE)
    between &= y.abs() < candidates.widths[:, None] / 2
    found = [_met(side * y, between, hand.tip_offset - z, -along, side * facing) for side in (1, -1)]
    by_tip = [
        _share(behind, _BEHIND_TIP) * _share(leaning, _LEANING) * (towards > _FACING)
        for _, behind, leaning, towards in found
    ]
    (first, _, _, one), (last, _, _, other) = found
    thin_wall = _share(first + last, _THIN) * _share(torch.minimum(one, other), _AWAY)
    return torch.stack([*by_tip, thin_wall]).amax(dim=0) * between.any(dim=1)


def _met(outward: Tensor, between: Tensor, *values: Tensor) -> list[Tensor]:
    """What the finger meets first that comes from where `outward` (C, M) is most: how far out (C,), means of values."""
    outward = torch.where(between, outward, -torch.inf)
    first = outward.amax(dim=1)
    met = between & (outward >= first[:, None] - _FIRST)
    number = met.sum(dim=1).clamp(min=1)
    return [first, *(torch.where(met, value, 0.0).sum(dim=1) / number for value in values)]


def _share(value: Tensor, limits: tuple[float, float]) -> Tensor:
    """How far a value has come from the first limit, 0, to the second, 1."""
    begin, end = limits
    return ((value - begin) / (end - begin)).clamp(0, 1)
