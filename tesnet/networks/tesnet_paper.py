"""TES-Net to the letter: sections 3.1 to 3.4 and 4.2 of the paper, and nothing that the product has learned since.

Edge Grasp Network (`balls`, `edgegrasp`) with other layers: on a graph of the k nearest neighbours PointTransformerConv
(equations 3 to 5) and SAGEConv (6 to 8) in alternation on coordinates and normals, the largest of every feature and a
perceptron for the context, edge features of approach and contact point, a perceptron for the score.

**What is encoded.** Section 3.2 "extracts local subsets related to the target grasp region" and pools their features:
here, as in the network that the paper builds upon, the points of a ball about each approach point.

**Neighbours.** The introduction selects the neighbours "by calculating cosine distances". That is read as the `cosine`
option of the usual kNN routines, on the coordinates: the points are centred at their centroid (equation 9), and the
distance of two of them is 1 - cos of the angle between them as seen from there. Points on one ray are then close,
however far apart they lie. `tesnet-euclidean` is the same network with neighbours by plain distance.

**Invariance.** As for every network on balls: to translations, by construction; to rotations, by training with random
ones (equations 10 to 12). Both kinds of neighbours turn with the points.

Left open by the paper and chosen here: three stages, their widths, and layer normalisation; a ball's origin, which is
its approach point (equation 9's centroid serves for the directions above and, in training, for the whole cloud); that
balls are thinned, and the geometry of a pair (`balls`, `pairs`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from tesnet.layers import PointTransformerConv, SAGEConv, neighbour_offsets
from tesnet.networks.balls import BallConfig, BallNetwork, nearest_in_ball

_POINT_INPUTS = 6


@dataclass(frozen=True, slots=True)
class TesNetPaperConfig(BallConfig):
    """`BallConfig`, the distance by which neighbours are chosen, and the widths of the stages."""

    distance: Literal["cosine", "euclidean"] = "cosine"
    channels: tuple[int, ...] = (32, 64, 64)


@dataclass(frozen=True, slots=True)
class TesNetEuclideanConfig(TesNetPaperConfig):
    """`TesNetPaperConfig` whose neighbours are the nearest points."""

    distance: Literal["cosine", "euclidean"] = "euclidean"


class Stage(nn.Module):
    """PointTransformerConv, then a layer that aggregates over the same graph."""

    def __init__(self, in_channels: int, channels: int, aggregate: nn.Module) -> None:
        super().__init__()
        half = channels // 2
        self.attention = PointTransformerConv(
            in_channels,
            channels,
            pos_nn=nn.Sequential(nn.Linear(3, half), nn.ReLU(), nn.Linear(half, channels)),
            attn_nn=nn.Sequential(nn.Linear(channels, half), nn.ReLU(), nn.Linear(half, channels)),
        )
        self.attention_norm = nn.LayerNorm(channels)
        self.aggregate = aggregate
        self.aggregate_norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor, neighbours: Tensor, offsets: Tensor) -> Tensor:
        """Features (P, C) from features (P, C_in), neighbours (P, k) and offsets (P, k, 3)."""
        x = torch.relu(self.attention_norm(self.attention(x, neighbours, offsets)))
        return torch.relu(self.aggregate_norm(self.aggregate(x, neighbours)))


class TesNetPaper(BallNetwork):
    """Attention and aggregation on coordinates and normals; a point's features are those of all stages."""

    config: TesNetPaperConfig

    def __init__(self, config: TesNetPaperConfig) -> None:
        super().__init__(config, features=sum(config.channels))
        widths = config.channels
        self.lift = nn.Linear(_POINT_INPUTS, widths[0])
        inputs = (widths[0], *widths[:-1])
        self.stages = nn.ModuleList(
            Stage(before, width, self.aggregation(width)) for before, width in zip(inputs, widths, strict=True)
        )

    def aggregation(self, channels: int) -> nn.Module:
        """The layer after each PointTransformerConv."""
        return SAGEConv(channels, channels)

    def point_features(self, points: Tensor, normals: Tensor) -> Tensor:
        """Features (B, M, F) from points and normals (B, M, 3)."""
        seen = centred_directions(points) if self.config.distance == "cosine" else points
        neighbours = nearest_in_ball(seen, self.config.neighbours)
        flat = points.flatten(0, 1)
        offsets = neighbour_offsets(flat, neighbours)
        x = torch.relu(self.lift(torch.cat([flat, normals.flatten(0, 1)], dim=1)))
        depths = []
        for stage in self.stages:
            x = stage(x, neighbours, offsets)
            depths.append(x)
        return torch.cat(depths, dim=1).view(*points.shape[:2], -1)


def centred_directions(points: Tensor) -> Tensor:
    """Unit vectors (B, M, 3) to the points (B, M, 3) of each ball from their centroid (equation 9).

    Their plain distances |u - v| rank pairs as cosine distances 1 - u . v = |u - v|^2 / 2 do.
    """
    return functional.normalize(points - points.mean(dim=1, keepdim=True), dim=2)
