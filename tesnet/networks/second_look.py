"""A second look at the best candidates: what each finger will touch, cell by cell of its pad, and whether that holds.

The network looks at a choice of the points between the fingers and keeps the largest of what it makes of them. Whether
two faces that lean hold a thing or let it slide out depends on all of them together: where on the pads they lie and
how they face. So the best candidates are looked at again, finger by finger. Torch; metres.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Gripper
from tesnet.points import points_in_grasp_frames

CELL = 0.0055
ROWS, COLUMNS = 9, 11
"""Cells of a pad's picture across the finger's breadth, the middle one about the hand's middle plane, in which each
candidate's contact point lies; and along its length, the first ahead of its end."""

AHEAD = 0.0125
"""So far ahead of the fingertips a pad's picture begins."""

_BESIDE = 0.6
"""Points farther from the middle than this share of the opening are not looked at."""

_FIRST = 0.003
"""Points of a cell that lie this near to its outermost one have their normals averaged."""

_PLACE_UNIT = 0.04
_RADII = (0.03, 0.05, 0.08, 0.12)
_MANY = 300.0
_HEIGHT_UNIT, _BREADTH_UNIT, _DEPTH_UNIT, _WIDTH_UNIT, _TRAVEL_UNIT = 0.1, 0.02, 0.05, 0.08, 0.02

_BY_CELL = 5
_PICTURES = 2 * ROWS * COLUMNS * _BY_CELL
_ABOUT = 4 * len(_RADII) + 3 + 1 + 3 + 1 + 4
INPUTS = _PICTURES + _ABOUT

_AT_ONCE = 500_000
"""Places of points in grasp frames that are in memory at a time."""


def looks_again(hand: Gripper) -> bool:
    """Whether a hand is one that the second look tells more of.

    Hands whose tips swing far pinch otherwise, and among its samples there were too few: where it looks again at these,
    twice as much slips out of them (training/NOTES.md).
    """
    return not hand.swings_far


class SecondLook(nn.Module):
    """What a closer look changes of a candidate's logit.

    A hand turned by half a turn about its travel is the same hand, and a scene reflected in its plane has the same
    outcome: the change is the mean over the four ways to look.

    Args:
        hidden: units of the two layers in between.
        dropout: share of them that a training step leaves out.
    """

    mean: Tensor
    spread: Tensor
    order: Tensor
    signs: Tensor

    def __init__(self, hidden: tuple[int, int] = (256, 64), dropout: float = 0.25) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(INPUTS + 1))
        self.register_buffer("spread", torch.ones(INPUTS + 1))
        order, signs = ways_to_look()
        self.register_buffer("order", order, persistent=False)
        self.register_buffer("signs", signs, persistent=False)
        first, second = hidden
        self.trunk = nn.Sequential(
            nn.Linear(INPUTS + 1, first), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(first, second), nn.ReLU(), nn.Dropout(dropout),
        )  # fmt: skip
        self.change = nn.Linear(second, 1)
        nn.init.zeros_(self.change.weight)
        nn.init.zeros_(self.change.bias)

    def forward(self, seen: Tensor, logits: Tensor) -> Tensor:
        """Logits (C,) after the closer look.

        Args:
            seen: (C, INPUTS), of `seen_by_fingers`.
            logits: (C,) before.
        """
        ways = seen[:, self.order] * self.signs  # (C, 4, INPUTS)
        features = self.features(ways, logits[:, None].expand(-1, len(self.order)))
        changed: Tensor = logits + self.change(features)[..., 0].mean(dim=1)
        return changed

    def features(self, seen: Tensor, logits: Tensor) -> Tensor:
        """(..., hidden) from what is seen (..., INPUTS) in one way and the logits (...)."""
        told = torch.cat([seen, logits[..., None]], dim=-1)
        features: Tensor = self.trunk(((told - self.mean) / self.spread).clamp(-6, 6))
        return features


def seen_by_fingers(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C, INPUTS): the pictures of the two pads, what lies about the hand, and the hand.

    Of each cell of a pad (+y first): whether a point lies before it, how far out the outermost one, and the mean normal
    there along x, outward and along z. About the hand: of the points within four distances of the TCP their mean place
    and number; up; the height over the support; the direction to the camera; the opening; and the hand's sizes. What is
    not known is 0.

    Args:
        cloud: P points.
        candidates: C grasps of one hand, as their fingers come to rest.
    """
    some = max(1, _AT_ONCE // max(1, len(cloud)))
    rows = torch.arange(len(candidates), device=cloud.points.device).split(some)
    return torch.cat([_seen(cloud, candidates.select(few)) for few in rows])


def _seen(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    poses, hand = candidates.Ts_canonical_grasp, candidates.gripper
    x, y, z = points_in_grasp_frames(cloud.points, poses)
    across = (x / CELL + ROWS / 2).floor()
    along = ((hand.tip_offset + AHEAD - z) / CELL).floor()
    before = (across >= 0) & (across < ROWS) & (along >= 0) & (along < COLUMNS)
    row, index = (before & (y.abs() < _BESIDE * hand.max_width)).nonzero(as_tuple=True)
    slot = ((row * ROWS + across[row, index].long()) * COLUMNS) + along[row, index].long()
    normals = (cloud.normals[index, None] @ poses[row, :3, :3])[:, 0]
    pictures = [_picture(side, slot, y[row, index], normals, len(poses)) for side in (1.0, -1.0)]
    return torch.cat([*pictures, _about(cloud, candidates, torch.stack([x, y, z], dim=2))], dim=1)


def _picture(side: float, slot: Tensor, y: Tensor, normals: Tensor, count: int) -> Tensor:
    """(C, ROWS * COLUMNS * 5) of the pad on one side."""
    outward, cells = side * y, count * ROWS * COLUMNS
    outermost = outward.new_full((cells,), -torch.inf).scatter_reduce_(0, slot, outward, "amax")
    first = outward >= outermost[slot] - _FIRST
    facing = normals[first] * normals.new_tensor([1.0, side, 1.0])
    sums = normals.new_zeros(cells, 4)
    sums.index_add_(0, slot[first], torch.cat([facing, torch.ones_like(facing[:, :1])], dim=1))
    number = sums[:, 3:]
    place = torch.where(number > 0, outermost[:, None] / _PLACE_UNIT, 0.0)
    return torch.cat([(number > 0).float(), place, sums[:, :3] / number.clamp(min=1)], dim=1).view(count, -1)


def _about(cloud: PreparedCloud, candidates: Candidates, places: Tensor) -> Tensor:
    """(C, 28) of the places (C, P, 3) of the cloud's points in the grasp frames."""
    poses, hand = candidates.Ts_canonical_grasp, candidates.gripper
    distance, told = places.norm(dim=2), []
    for radius in _RADII:
        within = (distance < radius).float()
        number = within.sum(dim=1, keepdim=True)
        mean = (within[:, None] @ places)[:, 0] / number.clamp(min=1)
        told += [mean / radius, number / _MANY]
    up = height = places.new_zeros(len(poses), 1)
    up = up.expand(-1, 3)
    if cloud.up is not None:
        up = cloud.up @ poses[:, :3, :3]
        if cloud.support_height is not None:
            height = ((poses[:, :3, 3] @ cloud.up - cloud.support_height) / _HEIGHT_UNIT)[:, None]
    view = (cloud.view_directions[candidates.contact, None] @ poses[:, :3, :3])[:, 0]
    sizes = (
        hand.finger_breadth / _BREADTH_UNIT,
        (hand.tip_offset - hand.palm_front) / _DEPTH_UNIT,
        hand.max_width / _WIDTH_UNIT,
        hand.travel / _TRAVEL_UNIT,
    )
    opening = candidates.widths[:, None] / _WIDTH_UNIT
    return torch.cat([*told, up, height, view, opening, places.new_tensor(sizes).expand(len(poses), 4)], dim=1)


def ways_to_look() -> tuple[Tensor, Tensor]:
    """Order and signs (4, INPUTS) of what is seen: as it is, reflected (x), turned by half a turn (x, y), and both."""
    picture = torch.arange(_PICTURES).view(2, ROWS, COLUMNS, _BY_CELL)
    about = torch.arange(_PICTURES, INPUTS)
    of_cell = torch.ones(_BY_CELL)
    of_cell[2] = -1.0  # a normal along x
    starts = torch.tensor([*(4 * number for number in range(len(_RADII))), 4 * len(_RADII), 4 * len(_RADII) + 4])
    orders, signs = [], []
    for turned in (False, True):
        for reflected in (False, True):
            shown = picture.flip(0) if turned else picture
            about_signs = torch.ones(_ABOUT)
            if turned:
                about_signs[starts + 1] = -1.0
            if turned != reflected:  # either alone reverses x
                shown = shown.flip(1)
                about_signs[starts] = -1.0
            cell_signs = of_cell if turned != reflected else torch.ones(_BY_CELL)
            orders.append(torch.cat([shown.flatten(), about]))
            signs.append(torch.cat([cell_signs.repeat(_PICTURES // _BY_CELL), about_signs]))
    return torch.stack(orders), torch.stack(signs)
