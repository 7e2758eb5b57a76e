"""The hand's volume, at rest and swept along its straight approach, as a test of places in the grasp frame.

Knows no cloud. Vectorised torch; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tesnet.geometry import Extent, Gripper, Part


def inside_hand(
    x: Tensor, y: Tensor, z: Tensor, gripper: Gripper, width: Tensor | float, distance: float = 0.0, depth: float = 0.0
) -> Tensor:
    """Mask of the places that lie in the hand.

    Args:
        x: of the places in the grasp frame; `y` and `z` have its shape.
        y: the same.
        z: the same.
        gripper: the hand.
        width: opening of the fingers, one number or one for each place, so shaped that it goes with `y`.
        distance: length of the straight way, ending in the grasp, on which a place counts as in the hand.
        depth: only places at least so deep under the surface of a part count, measured along the frame's axes.
    """
    # Seen by |y|, one finger is both.
    return _inside_any([part for part in gripper.parts if part.side >= 0], x, y, z, width, distance, depth)


def inside_palm(x: Tensor, y: Tensor, z: Tensor, gripper: Gripper, distance: float) -> Tensor:
    """Mask of the places that lie in what of the hand does not move as it closes, as `inside_hand` has it."""
    return _inside_any([part for part in gripper.parts if not part.side], x, y, z, 0.0, distance, 0.0)


def boxes_of(
    gripper: Gripper, narrowest: float, widest: float, distance: float
) -> list[tuple[list[float], list[float]]]:
    """The least and largest |x|, |y| and z of each part all along its way, at all openings between two.

    One finger stands for both.
    """
    boxes = []
    for part in gripper.parts:
        if part.side >= 0:
            inner = max(part.span(part.thickness.full, narrowest)[0], 0.0)
            outer = part.span(part.thickness.full, widest)[1]
            boxes.append(([0.0, inner, part.back - distance], [part.breadth.full / 2, outer, part.front]))
    return boxes


def _inside_any(
    parts: Sequence[Part], x: Tensor, y: Tensor, z: Tensor, width: Tensor | float, distance: float, depth: float
) -> Tensor:
    x, y = x.abs(), y.abs()
    inside = torch.zeros_like(x, dtype=torch.bool)
    for part in parts:
        inside |= _inside_part(part, x, y, z, width, distance, depth)
    return inside


def _inside_part(
    part: Part, x: Tensor, y: Tensor, z: Tensor, width: Tensor | float, distance: float, depth: float
) -> Tensor:
    """Mask of the places (|x|, |y|, z) that a part passes.

    Swept along z, a tapered part is as wide at each place as where it comes to rest. The rounding of a finger's tip is
    left out: prepared points lie nearly as far apart as it is long.
    """
    inside = (
        (z < part.front - depth)
        & (z > part.back - distance + depth)
        & (x < _extent(part.breadth, part.front, z, 0.5) - depth)
    )
    if part.side:
        outer = _extent(part.thickness, part.front, z, 1.0) + width / 2
        return inside & (y > width / 2 + depth) & (y < outer - depth)
    return inside & (y < _extent(part.thickness, part.front, z, 0.5) - depth)


def _extent(extent: Extent, front: float, z: Tensor, share: float) -> Tensor | float:
    """A share of a part's extent at each z."""
    if not extent.taper:
        return share * extent.full
    slope = share * (extent.full - extent.front) / extent.taper
    return ((front - z) * slope + share * extent.front).clamp_(max=share * extent.full)
