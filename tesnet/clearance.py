"""Where hands stop short of the support plane, so that the tips of those that grasp thin things stay over it.

Knows no cloud and no rule by which candidates are made. Vectorised torch; lengths in metres.
"""

from __future__ import annotations

import torch
from torch import Tensor

NEAREST = 0.0015
"""Over a plane whose height is known exactly tips come as near as this, where a thing is too thin for more."""

WANTED_REACH = 0.005
"""Tips that reach less far past a face hold it less well: for that they come nearer to the support."""

LEAST_REACH = 0.0013
"""Tips that reach less far past a face slip off it: a thing of 3 mm under tips 1.5 mm over the plane."""

_FLATTEST_TRAVEL = 0.5
"""Stopping short gets no hand clear of the support whose travel has a smaller cosine with straight down."""

_ROUNDING = 1e-5


def stopping_short(
    down: Tensor, clearance: Tensor, reach: Tensor, *, wanted: float, error: float, farthest: Tensor
) -> tuple[Tensor, Tensor]:
    """How far (C,) hands stop short of where they would come too near to the support, and which still come too near.

    Hands keep the clearance `wanted`. Where their tips would then reach less than `WANTED_REACH` past the face that
    they travel to, they come nearer, at the nearest to `NEAREST` and the plane's error; where that does not leave
    `LEAST_REACH`, the thing is too thin for them.

    Args:
        down: (C,) cosine of the travel with straight down.
        clearance: (C,) of the hands that do not stop short.
        reach: (C,) of their tips past the face, along the travel.
        wanted: the clearance to keep.
        error: of the height of the plane.
        farthest: (C,) no hand stops farther short than this.

    Returns:
        (C,) along the travel, zero where the hand is clear or cannot get clear; and (C,) a mask of the latter.
    """
    nearest = min(wanted, NEAREST + error)
    gain = torch.where(down >= _FLATTEST_TRAVEL, down, torch.nan)
    least, most = (((limit + _ROUNDING - clearance) / gain).clamp(min=0) for limit in (nearest, wanted))
    back = torch.minimum(most, torch.maximum(least, reach - WANTED_REACH))
    low = clearance < wanted
    too_near = low & ~((reach - back >= LEAST_REACH) & (back <= farthest))
    return torch.where(low & ~too_near, back, 0.0), too_near
