"""Edge Grasp Network: three PointNetConv layers on the graph of each ball (`balls`), without vector neurons.

Source: Huang et al., Edge Grasp Network: A Graph-Based SE(3)-invariant Approach to Grasp Detection, arXiv 2211.00191,
section IV.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tesnet.layers import PointNetConv, neighbour_offsets
from tesnet.networks.balls import BallConfig, BallNetwork, nearest_in_ball

_POINT_INPUTS = 6


@dataclass(frozen=True, slots=True)
class EdgeGraspConfig(BallConfig):
    """`BallConfig` and the widths of the three layers."""

    channels: tuple[int, ...] = (32, 64, 96)


class EdgeGrasp(BallNetwork):
    """PointNetConv on coordinates and normals; a point's features are those of all three layers."""

    config: EdgeGraspConfig

    def __init__(self, config: EdgeGraspConfig) -> None:
        super().__init__(config, features=sum(config.channels))
        inputs = (_POINT_INPUTS, *config.channels[:-1])
        self.layers = nn.ModuleList(
            PointNetConv(
                before, 3, width, local_nn=nn.Sequential(nn.ReLU(), nn.Linear(width, width)), global_nn=nn.ReLU()
            )
            for before, width in zip(inputs, config.channels, strict=True)
        )

    def point_features(self, points: Tensor, normals: Tensor) -> Tensor:
        """Features (B, M, F) from points and normals (B, M, 3)."""
        neighbours = nearest_in_ball(points, self.config.neighbours)
        flat = points.flatten(0, 1)
        offsets = -neighbour_offsets(flat, neighbours)
        x = torch.cat([flat, normals.flatten(0, 1)], dim=1)
        depths = []
        for layer in self.layers:
            x = layer(x, neighbours, offsets)
            depths.append(x)
        return torch.cat(depths, dim=1).view(*points.shape[:2], -1)
