"""Whether a finger would first meet a slope, and with its tip alone. Torch; metres.

The tips of some hands swing far forward as they close. One that so meets a surface that leans towards the palm, such as
the inside of a bowl, holds it badly: what was pinched is dropped, and a network that saw few such hands scores it high.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud

FAR_SWING = 0.03
"""Hands whose tips advance less from open to closed do not drop what they hold so (training/NOTES.md)."""

_FIRST = 0.003
"""Points this near to the first that a pad meets count as met, too."""

_ASIDE = 0.001
"""So far beside a tip's breadth, and ahead of its end, points still count."""

_BEHIND_TIP = (0.002, 0.006)
"""As far behind the end of the finger lies, in the mean, what the tip alone meets; and from where on it is the pad."""

_LEANING = (0.15, 0.4)
"""Cosines of the normal there with the direction against the travel: that of a wall, and that of a slope."""

_FACING = 0.3
"""Cosine of the normal with the finger's way: less is no surface that the camera saw the finger's side of."""


def tip_on_slope(cloud: PreparedCloud, candidates: Candidates, index: Tensor) -> Tensor:
    """How much one of the two fingers first meets a slope with its tip alone, from 0 to 1 (C,).

    Zero for hands that swing less than `FAR_SWING`, and where nothing lies between the fingers or what a finger meets
    was not seen.

    Args:
        cloud: P points.
        candidates: C grasps of one hand, as their fingers come to rest.
        index: (C, M) of points near the fingers; of more than M some.
    """
    hand, poses = candidates.gripper, candidates.Ts_canonical_grasp
    if hand.travel < FAR_SWING:
        return candidates.widths.new_zeros(len(candidates))
    rotation = poses[:, :3, :3]
    x, y, z = ((cloud.points[index] - poses[:, None, :3, 3]) @ rotation).unbind(dim=2)
    normals = cloud.normals[index] @ rotation
    between = (x.abs() < hand.finger_tip_breadth / 2 + _ASIDE) & (z > hand.palm_front) & (z < hand.tip_offset + _ASIDE)
    between &= y.abs() < candidates.widths[:, None] / 2
    found = [
        _of_finger(side * y, hand.tip_offset - z, -normals[..., 2], side * normals[..., 1], between) for side in (1, -1)
    ]
    return torch.maximum(*found)


def _of_finger(outward: Tensor, behind: Tensor, leaning: Tensor, facing: Tensor, between: Tensor) -> Tensor:
    """The same (C,) of the finger that comes from where `outward` (C, M) is most."""
    outward = torch.where(between, outward, -torch.inf)
    met = between & (outward >= outward.amax(dim=1, keepdim=True) - _FIRST)
    number = met.sum(dim=1).clamp(min=1)
    behind, leaning, facing = (torch.where(met, value, 0.0).sum(dim=1) / number for value in (behind, leaning, facing))
    by_tip = ((_BEHIND_TIP[1] - behind) / (_BEHIND_TIP[1] - _BEHIND_TIP[0])).clamp(0, 1)
    on_slope = ((leaning - _LEANING[0]) / (_LEANING[1] - _LEANING[0])).clamp(0, 1)
    return by_tip * on_slope * (facing > _FACING)
