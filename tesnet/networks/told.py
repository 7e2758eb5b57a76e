"""What a network is told beside the cloud: the hand, each candidate's opening and the room in it, and the noise.

Every number is about one or less for hands of today, and zero for what has the Franka hand's size. None changes with a
rigid motion of the scene.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.geometry import PANDA, Gripper

SIZES = (
    "max_width",
    "finger_depth",
    "finger_thickness",
    "finger_tip_thickness",
    "finger_taper",
    "finger_breadth",
    "finger_tip_breadth",
    "tip_offset",
    "palm_depth",
    "palm_length",
    "palm_breadth",
    "palm_front_breadth",
    "palm_taper",
)
"""The lengths that give a hand its shape: each is told as its ratio to the Franka hand's, less one."""

TOLD_INPUTS = len(SIZES) + 1 + 1 + 2 + 1 + 1

_LENGTH = 0.02
"""Metres that count as 1 where no size of the Franka hand is the measure."""

_NOISE = 3
"""So much is told of a deviation as large as the spread: at 2 mm of noise on each coordinate about one comes of it."""

_FLATTEST = 0.25
"""Of a cloud's points: its noise is that of so many where it bends least."""


def told_inputs(cloud: PreparedCloud, candidates: Candidates, between: Tensor, there: Tensor) -> Tensor:
    """(C, TOLD_INPUTS): the hand's `SIZES` and travel, noise, opening, room at either finger, advance of the tips.

    Args:
        cloud: P points.
        candidates: C grasps of one hand.
        between: (C, M, 3) points near the fingers, in the grasp frame.
        there: (C,) whether there is any.
    """
    hand, widths = candidates.gripper, candidates.widths
    room = room_between(hand, widths, between, there)
    closed = (widths - room.sum(dim=1)).clamp(min=0)
    advance = (hand.tcp_at(closed) - hand.tcp_at(widths)) * torch.ones_like(widths)
    same = torch.cat([torch.tensor(hand_inputs(hand), device=widths.device), noise_of(cloud)])
    own = torch.stack([widths / PANDA.max_width - 1, *(room / _LENGTH).unbind(dim=1), advance / _LENGTH], dim=1)
    return torch.cat([same.expand(len(widths), -1), own], dim=1)


def hand_inputs(hand: Gripper) -> list[float]:
    """The hand's `SIZES` and how far its tips travel forward as it closes."""
    sizes = [float(getattr(hand, name) / getattr(PANDA, name)) - 1 for name in SIZES]
    return [*sizes, hand.travel / _LENGTH]


def room_between(hand: Gripper, widths: Tensor, points: Tensor, there: Tensor) -> Tensor:
    """(C, 2) metres from the left (+y) and from the right pad to the first of the points between the pads.

    Where there is none, the whole opening.

    Args:
        hand: of all candidates.
        widths: (C,) how far it is open.
        points: (C, M, 3) in the grasp frame, whether between the pads or not.
        there: (C,) whether the points stand for any.
    """
    x, y, z = points.unbind(dim=2)
    half = widths[:, None] / 2
    between = (x.abs() < hand.finger_breadth / 2) & (y.abs() < half)
    between &= (z > hand.palm_front) & (z < hand.tip_offset) & there[:, None]
    left = half - torch.where(between, y, -half).amax(dim=1, keepdim=True)
    right = half + torch.where(between, y, half).amin(dim=1, keepdim=True)
    return torch.cat([left, right], dim=1)


def noise_of(cloud: PreparedCloud) -> Tensor:
    """(1,) deviation of the points from the planes through their neighbours, as a share of how far these spread.

    That of the flattest quarter of the cloud, where it is noise rather than shape.
    """
    count = max(1, round(_FLATTEST * len(cloud)))
    return _NOISE * cloud.spectrum[:, 0].kthvalue(count).values.sqrt()[None]
