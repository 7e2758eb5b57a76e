"""GPD: a small convolutional network on images of what lies between the fingers.

Source: ten Pas et al., Grasp Pose Detection in Point Clouds, arXiv 1706.09911, section IV. As there, the region about
the hand is scaled to a cube and projected along each axis of the hand to five images, 15 channels in all: the average
height of the observed points, their average normal (three), and the average height of the places that the camera could
not see. Images have 24 pixels a side instead of 60, and the network is smaller.

A frame that moves with the hand makes the scores invariant under rigid motions by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.geometry import PANDA
from tesnet.networks.closing import FINE, Box, judged_in_parts, members_of, seen_from_hand
from tesnet.networks.network import mirror_factors
from tesnet.visibility import FINE_SHADOW_MARGIN, hidden

REGION = Box(breadth=0.02, length=0.055, behind=-PANDA.palm_front, ahead=PANDA.tip_offset + 0.01)
"""The hand's closing region and its fingers, from the palm to 1 cm before the tips."""

VIEWS = ((0, 1, 2), (1, 0, 2), (2, 0, 1))
"""Axis of projection, then those of rows and columns: along the hand's x, its closing direction and its travel."""

CHANNELS_PER_VIEW = 5
PIXELS = 24
_PLACES = 12
"""Places along each axis that are looked for in the camera's shadow; two pixels each."""

_CANDIDATES_AT_ONCE = 250


@dataclass(frozen=True, slots=True)
class GPDConfig:
    """Widths of the network: channels of the two convolutions and of the hidden layer."""

    channels: tuple[int, int] = (20, 40)
    hidden_channels: int = 128


class GPD(nn.Module):
    """Scores each candidate by the images of its own region; nothing is shared between candidates."""

    preparation: ClassVar[PreparationConfig] = FINE
    scored_at_once: ClassVar[int] = 200
    knows_hands: ClassVar[bool] = False

    def __init__(self, config: GPDConfig) -> None:
        super().__init__()
        self.config = config
        first, second = config.channels
        self.layers = nn.Sequential(  # (C, 15, 24, 24)
            nn.Conv2d(CHANNELS_PER_VIEW * len(VIEWS), first, 5),
            nn.ReLU(),
            nn.MaxPool2d(2),  # (C, first, 10, 10)
            nn.Conv2d(first, second, 3),
            nn.ReLU(),
            nn.MaxPool2d(2),  # (C, second, 4, 4)
            nn.Flatten(),
            nn.Linear(second * 16, config.hidden_channels),
            nn.ReLU(),
            nn.Linear(config.hidden_channels, 1),
        )

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[None]:
        """Nothing: a cloud as a whole has no features."""
        return [None] * len(clouds)

    def score(
        self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,)."""
        return judged_in_parts(self._judge, cloud, candidates.Ts_canonical_grasp, mirror, _CANDIDATES_AT_ONCE)

    def _judge(self, cloud: PreparedCloud, poses: Tensor, mirror: Tensor) -> Tensor:
        logits: Tensor = self.layers(images(cloud, poses, mirror))[:, 0]
        return logits


def images(cloud: PreparedCloud, poses: Tensor, mirror: Tensor) -> Tensor:
    """(C, 15, PIXELS, PIXELS) what is seen in the region of each pose (C, 4, 4); zero where nothing is.

    For each of `VIEWS`: height, normal along x, y and z of the hand, height of what is hidden. Heights are 0 to 1 along
    the axis of projection.

    Args:
        cloud: P points with normals.
        poses: of the hands.
        mirror: (C,) +1, or -1 for an image of the surroundings reflected in the hand's plane.
    """
    observed = _observed(cloud, poses, mirror)
    unseen = _unseen(cloud, poses, mirror)
    return torch.cat([observed, unseen], dim=2).flatten(1, 2)


def _observed(cloud: PreparedCloud, poses: Tensor, mirror: Tensor) -> Tensor:
    """(C, 3, 4, PIXELS, PIXELS) average height and normal of the observed points in each pixel of each view."""
    members = members_of(cloud.points, poses, REGION)
    positions, normals = seen_from_hand(cloud, poses, mirror, members.row, members.point)
    share = ((positions - REGION.low.to(poses.device)) / REGION.size.to(poses.device)).clamp(0, 1)
    cell = (share * PIXELS).long().clamp(max=PIXELS - 1)
    sums = torch.zeros(len(poses) * len(VIEWS) * PIXELS**2, CHANNELS_PER_VIEW, device=poses.device)
    for number, (along, row, column) in enumerate(VIEWS):
        pixel = ((members.row * len(VIEWS) + number) * PIXELS + cell[:, row]) * PIXELS + cell[:, column]
        values = torch.cat([share[:, along, None], normals, torch.ones_like(share[:, :1])], dim=1)
        sums.index_add_(0, pixel, values)
    means = sums[:, :-1] / sums[:, -1:].clamp(min=1)
    return means.view(len(poses), len(VIEWS), PIXELS, PIXELS, CHANNELS_PER_VIEW - 1).permute(0, 1, 4, 2, 3)


def _unseen(cloud: PreparedCloud, poses: Tensor, mirror: Tensor) -> Tensor:
    """(C, 3, 1, PIXELS, PIXELS) average height of the places in each pixel's column that the camera could not see."""
    steps = (torch.arange(_PLACES, device=poses.device) + 0.5) / _PLACES
    share = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).view(-1, 3)
    local = REGION.low.to(poses.device) + share * REGION.size.to(poses.device)
    places = (local * mirror_factors(mirror)[:, None]) @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]
    is_hidden = hidden(cloud, places, FINE_SHADOW_MARGIN).view(-1, _PLACES, _PLACES, _PLACES).float()
    views = []
    for along, _, _ in VIEWS:
        column = is_hidden.movedim(along + 1, 3)  # rows and columns keep their order
        views.append((column * steps).sum(dim=3) / column.sum(dim=3).clamp(min=1))
    times = PIXELS // _PLACES
    heights = torch.stack(views, dim=1).repeat_interleave(times, dim=2).repeat_interleave(times, dim=3)
    return heights[:, :, None]
