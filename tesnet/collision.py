"""The hand's volume, swept along its approach, against what was seen, what may go on unseen and what is hidden.

`blocked` is the one judgement of it, the predictor's and that of the training's labels. Vectorised torch; lengths in
metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from tesnet.cloud import PreparedCloud
from tesnet.geometry import Extent, Gripper, Part
from tesnet.points import points_in_grasp_frames
from tesnet.visibility import depth_behind

APPROACH_DISTANCE = 0.05
"""Length of the straight approach that is kept clear of observed points, metres."""

SHADOW_MARGIN = 0.01
"""A place is hidden when it lies this far behind the surface that covers it."""

BORDER = 0.005
"""Points this near to a side of the workspace are taken to be cut off by it: as far as prepared points are apart."""

REACH_BEYOND = 0.04
"""How far beyond the workspace things are taken to go on."""

_BLOCK = 4_000_000
_COARSE_STRIDE = 6


def blocked(
    cloud: PreparedCloud, Ts_canonical_grasp: Tensor, gripper: Gripper, unseen: Literal["free", "occupied"]
) -> Tensor:
    """Mask (C,): the open hand meets an observed point on its way, or what a side of the workspace cuts off.

    The latter is a guess, which counts only while it leaves a candidate.

    Args:
        cloud: what was observed.
        Ts_canonical_grasp: (C, 4, 4) TCP poses.
        gripper: the hand.
        unseen: whether the shadow behind observed points counts as `free` or `occupied`.
    """
    width = gripper.max_width
    mask = in_collision(cloud.points, Ts_canonical_grasp, gripper, width, APPROACH_DISTANCE)
    unsafe = in_collision(beyond(cloud), Ts_canonical_grasp, gripper, width, APPROACH_DISTANCE)
    if not bool((mask | unsafe).all()):
        mask |= unsafe
    if unseen == "occupied":
        mask |= in_shadow(cloud, Ts_canonical_grasp, gripper, width)
    return mask


def in_collision(
    points: Tensor, Ts_canonical_grasp: Tensor, gripper: Gripper, width: float, approach_distance: float
) -> Tensor:
    """Mask (C,): a point lies in the hand anywhere on its way to the grasp.

    Args:
        points: (P, 3) that the hand shall not meet.
        Ts_canonical_grasp: (C, 4, 4) TCP poses.
        gripper: the hand.
        width: opening of the fingers.
        approach_distance: length of the straight approach, which ends in the grasp.
    """
    hit = torch.zeros(len(Ts_canonical_grasp), dtype=torch.bool, device=points.device)
    # Most collisions show with a few points already; the others are looked for with all of them.
    for some in (points[::_COARSE_STRIDE], points):
        open_rows = (~hit).nonzero()[:, 0]
        for rows in open_rows.split(max(1, _BLOCK // max(1, len(some)))):
            hit[rows] = _hit(some, Ts_canonical_grasp[rows], gripper, width, approach_distance)
    return hit


def _hit(points: Tensor, poses: Tensor, gripper: Gripper, width: float, approach_distance: float) -> Tensor:
    x, y, z = points_in_grasp_frames(points, poses)
    x, y = x.abs_(), y.abs_()
    hit = torch.zeros(len(poses), dtype=torch.bool, device=points.device)
    for part in gripper.parts:
        if part.side >= 0:  # seen by |y|, one finger is both
            hit |= _swept(part, x, y, z, width, approach_distance).any(dim=1)
    return hit


def _swept(part: Part, x: Tensor, y: Tensor, z: Tensor, width: float, distance: float) -> Tensor:
    """Mask (C, P) of the places (|x|, |y|, z), each (C, P), that a part passes on the last `distance` of its way.

    Swept along z, a tapered part is as wide at each place as where it comes to rest. The rounding of a finger's tip is
    left out: prepared points lie nearly as far apart as it is long.
    """
    inside = (z < part.front) & (z > part.back - distance) & (x < _extent(part.breadth, part.front, z, 0.5))
    if part.side:
        return inside & (y > width / 2) & (y < _extent(part.thickness, part.front, z, 1.0) + width / 2)
    return inside & (y < _extent(part.thickness, part.front, z, 0.5))


def _extent(extent: Extent, front: float, z: Tensor, share: float) -> Tensor | float:
    """A share of a part's extent at each z (C, P)."""
    if not extent.taper:
        return share * extent.full
    slope = share * (extent.full - extent.front) / extent.taper
    return ((front - z) * slope + share * extent.front).clamp_(max=share * extent.full)


def beyond(cloud: PreparedCloud) -> Tensor:
    """Places (B, 3) where things that a side of the workspace cuts off are taken to go on, straight out of it."""
    steps = torch.arange(BORDER, REACH_BEYOND, BORDER, device=cloud.points.device)
    distance = cloud.points @ cloud.sides[:, :3].T - cloud.sides[:, 3]
    point, side = (distance.abs() < BORDER).nonzero(as_tuple=True)
    places = cloud.points[point][:, None] + steps[:, None] * cloud.sides[side, None, :3]
    return places.reshape(-1, 3)


def in_shadow(cloud: PreparedCloud, Ts_canonical_grasp: Tensor, gripper: Gripper, width: float) -> Tensor:
    """Mask (C,): part of the hand at the grasp lies where every viewpoint's sight is blocked by observed points.

    The fingers and the palm's front are sampled.
    """
    samples = torch.tensor(
        [place for part in gripper.parts for place in _samples(part, width)],
        dtype=torch.float32,
        device=cloud.points.device,
    )
    places = samples @ Ts_canonical_grasp[:, :3, :3].transpose(1, 2) + Ts_canonical_grasp[:, None, :3, 3]
    return (depth_behind(cloud, places) > SHADOW_MARGIN).any(dim=1)


def _samples(part: Part, width: float) -> list[tuple[float, float, float]]:
    """Places in the middle plane of a finger, or 5 mm behind the front of the palm."""
    if not part.side:
        return [(0.0, share * part.thickness.full / 2, part.front - 0.005) for share in (-0.9, -0.45, 0.0, 0.45, 0.9)]
    depths = [part.back + (part.front - part.back) * step / 4 for step in range(5)]
    return [
        (0.0, part.side * (width / 2 + share * part.thickness.at(part.front - z)), z)
        for share in (0.1, 0.5, 0.9)
        for z in depths
    ]
