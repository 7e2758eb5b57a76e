"""The frame of Edge Grasp Network: a ball about each approach point, edge features for the contact points in it.

Source: Huang et al., Edge Grasp Network: A Graph-Based SE(3)-invariant Approach to Grasp Detection, arXiv 2211.00191,
section IV. For each approach point the points of a ball about it are moved so that it is their origin, and a network
gives each of them features. The largest of every feature over the ball, through a perceptron, is the ball's context. An
edge from approach to contact point joins the features of both, the context and the pair's own geometry, and a
perceptron gives its logit. What gives the features is each network's own.

A ball of the published network holds every point in it, some 340 here. To fit one CPU core it is thinned to
`ball_points` of them, drawn in a fixed pseudo-random order that is the same for all balls of a cloud; a contact point
that was thinned out takes the features of the nearest point that was not.

Invariance: translations change nothing, because every ball has its own origin. Rotations do, by the coordinates and
normals that go in; random rotations in training (TES-Net, equations 10 to 12; `training.augment`) teach the networks
that they should not.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.networks.pairs import PAIR_FEATURES, pair_features

LENGTH = 0.02
"""Metres that count as 1 in the networks' inputs."""

_BALLS_AT_ONCE = 32


@dataclass(frozen=True, slots=True)
class BallConfig:
    """Size of the balls, and widths of what all networks on balls share.

    Args:
        radius: of a ball, metres.
        ball_points: M, at most so many points of a ball are looked at.
        neighbours: of a point in its ball, itself included.
        context_channels: features of a whole ball.
        head_channels: of the hidden layers of the head.
    """

    radius: float = 0.05
    ball_points: int = 128
    neighbours: int = 16
    context_channels: int = 128
    head_channels: tuple[int, int] = (128, 64)


class BallNetwork(nn.Module):
    """Scores candidates ball by ball; all of an approach point's candidates share the features of its ball.

    Args:
        config: of the shared part.
        features: F, of a point.
    """

    preparation: ClassVar[PreparationConfig] = PreparationConfig()
    scored_at_once: ClassVar[int] = 200
    knows_hands: ClassVar[bool] = False

    def __init__(self, config: BallConfig, features: int) -> None:
        super().__init__()
        self.config = config
        context, hidden = config.context_channels, config.head_channels[0]
        self.context = nn.Sequential(nn.Linear(features, context), nn.ReLU(), nn.Linear(context, context), nn.ReLU())
        # One linear layer over the joined edge features, in parts: what belongs to a ball is computed once a ball.
        self.approach = nn.Linear(features, hidden, bias=False)
        self.contact = nn.Linear(features, hidden, bias=False)
        self.global_part = nn.Linear(context, hidden, bias=False)
        self.local_part = nn.Linear(PAIR_FEATURES, hidden)
        self.head = nn.Sequential(
            nn.ReLU(), nn.Linear(hidden, config.head_channels[1]), nn.ReLU(), nn.Linear(config.head_channels[1], 1)
        )

    @abstractmethod
    def point_features(self, points: Tensor, normals: Tensor) -> Tensor:
        """Features (B, M, F) from normals (B, M, 3) and points seen from the approach point, in units of `LENGTH`."""

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[None]:
        """Nothing: balls belong to the candidates' approach points, which are not known yet."""
        return [None] * len(clouds)

    def score(
        self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,). A mirrored view would need a ball for each candidate: `mirror` is left alone."""
        centres, ball_of = candidates.approach.unique(return_inverse=True)
        logits = torch.zeros(len(candidates), device=cloud.points.device)
        for first in range(0, len(centres), _BALLS_AT_ONCE):
            some = centres[first : first + _BALLS_AT_ONCE]
            mine = ((ball_of >= first) & (ball_of < first + len(some))).nonzero()[:, 0]
            judged = self._judge(cloud, some, candidates.select(mine), ball_of[mine] - first)
            logits = logits.index_copy(0, mine, judged)
        return logits

    def _judge(self, cloud: PreparedCloud, centres: Tensor, candidates: Candidates, ball_of: Tensor) -> Tensor:
        """Logits (C,) of candidates in the balls `ball_of` (C,) about the points `centres` (B,)."""
        members = balls(cloud.points, centres, self.config.radius, self.config.ball_points)  # (B, M)
        local = (cloud.points[members] - cloud.points[centres][:, None]) / LENGTH
        x = self.point_features(local, cloud.normals[members])  # (B, M, F)
        contacts = cloud.points[candidates.contact][:, None]
        nearest = (cloud.points[members[ball_of]] - contacts).square().sum(dim=2).argmin(dim=1)
        of_ball = self.approach(x[:, 0]) + self.global_part(self.context(x.amax(dim=1)))
        edges = of_ball[ball_of] + self.contact(x[ball_of, nearest]) + self.local_part(pair_features(cloud, candidates))
        logits: Tensor = self.head(edges)[:, 0]
        return logits


def balls(points: Tensor, centres: Tensor, radius: float, count: int) -> Tensor:
    """Indices (B, count) of points (P, 3) within `radius` of the points `centres` (B,), each the first of its ball.

    Of more points the first in a fixed pseudo-random order are taken, of fewer the centre again.
    """
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0)).to(points.device)
    within = (points[order] - points[centres][:, None]).norm(dim=2) <= radius
    within &= order != centres[:, None]
    rank = within.cumsum(dim=1)
    row, column = (within & (rank < count)).nonzero(as_tuple=True)
    members = centres[:, None].repeat(1, count)
    members[row, rank[row, column]] = order[column]
    return members


def nearest_in_ball(points: Tensor, k: int) -> Tensor:
    """Neighbours (B * M, k) of the points (B, M, D) of each ball within it; the balls stand one below the other."""
    count, members = points.shape[:2]
    # Without the expanded square, whose rounding would let a point miss itself.
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.topk(min(k, members), dim=2, largest=False).indices
    first = torch.arange(count, device=points.device)[:, None, None] * members
    return (nearest + first).flatten(0, 1)
