"""PointNetGPD: PointNet on the points between the fingers, seen in the grasp frame.

Source: Liang et al., PointNetGPD: Detecting Grasp Configurations from Point Sets, arXiv 1809.06267. As there, a grasp
is judged by the raw coordinates of the points in its closing region, transformed to the hand's frame and brought to a
fixed number by sampling. Three things differ. The box also holds the volumes of the fingers, because the labels count
what these hit. PointNet's input transform is left out, because the grasp frame already aligns the points. The network
is narrower.

A frame that moves with the hand makes the scores invariant under rigid motions by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.geometry import PANDA
from tesnet.networks.closing import FINE, Box, judged_in_parts, members_of, seen_from_hand

REGION = Box(
    breadth=0.012,
    length=PANDA.max_width / 2 + PANDA.finger_tip_thickness,
    behind=-PANDA.palm_front,
    ahead=PANDA.tip_offset + 0.01,
)
"""Between the fingers and in them, from the palm to 1 cm before the tips."""

_LENGTH = 0.02
"""Metres that count as 1 in the network's inputs."""

_CANDIDATES_AT_ONCE = 500


@dataclass(frozen=True, slots=True)
class PointNetGPDConfig:
    """Widths of the network.

    Args:
        points: N, to which the points of a region are brought: more are left out, fewer repeated.
        point_channels: of the shared perceptron over the points.
        head_channels: of the hidden layers after the maximum.
    """

    points: int = 96
    point_channels: tuple[int, ...] = (64, 96, 192)
    head_channels: tuple[int, ...] = (128, 64)


class PointNetGPD(nn.Module):
    """Scores each candidate by the N points of its own region; nothing is shared between candidates."""

    preparation: ClassVar[PreparationConfig] = FINE
    scored_at_once: ClassVar[int] = 200
    knows_hands: ClassVar[bool] = False

    def __init__(self, config: PointNetGPDConfig) -> None:
        super().__init__()
        self.config = config
        self.point = _perceptron(3, *config.point_channels)
        self.head = nn.Sequential(
            _perceptron(config.point_channels[-1], *config.head_channels), nn.Linear(config.head_channels[-1], 1)
        )

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[None]:
        """Nothing: a cloud as a whole has no features."""
        return [None] * len(clouds)

    def score(
        self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,): PointNet's maximum over h(p) for each p of the region (arXiv 1612.00593, equation 1)."""
        return judged_in_parts(self._judge, cloud, candidates.Ts_canonical_grasp, mirror, _CANDIDATES_AT_ONCE)

    def _judge(self, cloud: PreparedCloud, poses: Tensor, mirror: Tensor) -> Tensor:
        members = members_of(cloud.points, poses, REGION)
        index = members.table(self.config.points)  # (C, N)
        row = torch.arange(len(index), device=index.device).repeat_interleave(index.shape[1])
        positions, _ = seen_from_hand(cloud, poses, mirror, row, index.flatten())
        pooled = self.point(positions.view(*index.shape, 3) / _LENGTH).amax(dim=1)
        logits: Tensor = self.head(pooled * (members.total > 0)[:, None])[:, 0]
        return logits


def _perceptron(*widths: int) -> nn.Sequential:
    return nn.Sequential(*(layer for a, b in pairwise(widths) for layer in (nn.Linear(a, b), nn.ReLU())))
