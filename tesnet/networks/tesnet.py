"""TES-Net: PointTransformerConv and GraphSAGE over a cloud's kNN graph, edge features and an MLP head for each grasp.

Every input is invariant under rigid motions by construction: point-pair features in the encoder (distance and three
angles; Drost et al. 2010), and offsets and normals seen in the candidate's own grasp frame in the head. The cloud is
encoded once; what a candidate adds is a gather, a small shared MLP over the points in its hand's reach and a max.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.collision import points_in_grasp_frames
from tesnet.layers import PointTransformerConv, SAGEConv

_POINT_INPUTS = 7
_EDGE_INPUTS = 4
_REGION_INPUTS = 7
_CANDIDATE_INPUTS = 16
_LENGTH = 0.02
"""Metres that count as 1 in the network's inputs."""


@dataclass(frozen=True, slots=True)
class TesNetConfig:
    """Widths of the network and the region of the cloud that a candidate sees.

    Args:
        channels: width of every encoder stage.
        stages: number of PointTransformerConv + SAGEConv stages.
        point_features, context_features: width of a point's and of the whole cloud's features.
        region_channels: widths of the shared MLP over the points in the hand's reach.
        head_channels: widths of the head's hidden layers.
        closing_points, closing_region: at most so many points are looked at where the fingers close. The region is
            given by half extents along x and y of the grasp frame and extents along -z and +z from the TCP, metres.
        around_points, around_region: the same for the hand's wider surroundings.
    """

    channels: int = 32
    stages: int = 2
    point_features: int = 64
    context_features: int = 32
    region_channels: tuple[int, int] = (64, 128)
    head_channels: tuple[int, int] = (128, 64)
    closing_points: int = 56
    closing_region: tuple[float, float, float, float] = (0.012, 0.045, 0.042, 0.012)
    around_points: int = 40
    around_region: tuple[float, float, float, float] = (0.035, 0.085, 0.060, 0.045)


@dataclass(frozen=True, eq=False, slots=True)
class CloudFeatures:
    """What the encoder found: `points` (P, point_features) and `context` (context_features,)."""

    points: Tensor
    context: Tensor


class EncoderStage(nn.Module):
    """PointTransformerConv (eqs. 3-5) followed by GraphSAGE (eqs. 6-8), normalised, with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attention = PointTransformerConv(
            channels,
            channels,
            pos_nn=nn.Sequential(nn.Linear(_EDGE_INPUTS, channels), nn.ReLU(), nn.Linear(channels, channels)),
            attn_nn=nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels)),
        )
        self.attention_norm = nn.LayerNorm(channels)
        self.aggregate = SAGEConv(channels, channels)
        self.aggregate_norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor, neighbours: Tensor, edges: Tensor) -> Tensor:
        """Features (P, C) from features (P, C), neighbours (P, k) and edge inputs (P, k, 4)."""
        attended = torch.relu(self.attention_norm(self.attention(x, neighbours, edges)))
        return torch.relu(x + self.aggregate_norm(self.aggregate(attended, neighbours)))


class TesNet(nn.Module):
    """Scores candidate grasps of a prepared cloud."""

    def __init__(self, config: TesNetConfig) -> None:
        super().__init__()
        self.config = config
        c, f = config.channels, config.point_features
        self.lift = nn.Linear(_POINT_INPUTS, c)
        self.stages = nn.ModuleList(EncoderStage(c) for _ in range(config.stages))
        self.merge = nn.Sequential(nn.Linear(c * (config.stages + 1), f), nn.ReLU())
        self.context = nn.Sequential(nn.Linear(f, config.context_features), nn.ReLU())
        first, second = config.region_channels
        self.region_point = nn.Linear(f, first, bias=False)
        self.region_geometry = nn.Linear(_REGION_INPUTS, first)
        self.region_mlp = nn.Sequential(nn.ReLU(), nn.Linear(first, second), nn.ReLU())
        self.approach = nn.Linear(f, config.head_channels[0], bias=False)
        self.contact = nn.Linear(f, config.head_channels[0], bias=False)
        self.pooled = nn.Linear(2 * second, config.head_channels[0], bias=False)
        self.candidate = nn.Linear(_CANDIDATE_INPUTS, config.head_channels[0])
        self.situation = nn.Linear(config.context_features, config.head_channels[0], bias=False)
        self.head = nn.Sequential(
            nn.ReLU(),
            nn.Linear(config.head_channels[0], config.head_channels[1]),
            nn.ReLU(),
            nn.Linear(config.head_channels[1], 1),
        )

    def encode(self, cloud: PreparedCloud) -> CloudFeatures:
        """Features of every point and of the whole cloud; computed once, shared by all candidates."""
        return self.encode_batch([cloud])[0]

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[CloudFeatures]:
        """The features of each of several clouds, in one pass over the stacked graphs of all of them.

        They equal those of `encode` up to the rounding of float32, which depends on the size of a matrix product.
        """
        sizes = [len(cloud) for cloud in clouds]
        before = [sum(sizes[:i]) for i in range(len(sizes))]
        x = torch.relu(self.lift(torch.cat([point_inputs(cloud) for cloud in clouds])))
        edges = torch.cat([edge_inputs(cloud) for cloud in clouds])
        neighbours = torch.cat([cloud.neighbours + start for cloud, start in zip(clouds, before, strict=True)])
        depths = [x]
        for stage in self.stages:
            x = stage(x, neighbours, edges)
            depths.append(x)
        stacked = self.merge(torch.cat(depths, dim=1))
        return [CloudFeatures(points, self.context(points.amax(dim=0))) for points in stacked.split(sizes)]

    def score(
        self, features: CloudFeatures, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,) of the candidates.

        Args:
            features: of this cloud.
            cloud: P points.
            candidates: C grasps.
            mirror: (C,) +1 or -1; -1 shows the candidate's surroundings reflected in the hand's plane, under which the
                outcome of a grasp does not change. For training.
        """
        poses = candidates.Ts_canonical_grasp
        sign = torch.ones(len(poses), device=poses.device) if mirror is None else mirror
        index, inside, totals = self.regions(cloud, poses)
        geometry = _region_inputs(cloud, poses, index, sign)
        per_point = self.region_point(features.points)
        gathered = per_point.index_select(0, index.flatten()).view(*index.shape, per_point.shape[1])
        hidden = self.region_geometry(geometry) + gathered
        hidden = self.region_mlp(hidden).masked_fill(~inside[..., None], 0)
        closing, around = hidden.split([self.config.closing_points, self.config.around_points], dim=1)
        joined = (
            self.pooled(torch.cat([closing.amax(dim=1), around.amax(dim=1)], dim=1))
            + self.approach(features.points)[candidates.approach]
            + self.contact(features.points)[candidates.contact]
            + self.candidate(_candidate_inputs(cloud, candidates, totals, sign))
            + self.situation(features.context)
        )
        logits: Tensor = self.head(joined)[:, 0]
        return logits

    def regions(self, cloud: PreparedCloud, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points that each candidate looks at, first where the fingers close, then around the hand.

        Returns:
            Indices (C, M) into the cloud, a mask (C, M) of the ones that count, and how many points lie in either
            region, (C, 2). Where more lie there than are looked at, a fixed pseudo-random choice of them is taken.
        """
        config = self.config
        shuffled = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0)).to(poses.device)
        x, y, z = points_in_grasp_frames(cloud.points[shuffled], poses)
        x, y = x.abs_(), y.abs_()
        found = []
        for count, (breadth, length, behind, ahead) in (
            (config.closing_points, config.closing_region),
            (config.around_points, config.around_region),
        ):
            within = (x < breadth) & (y < length) & (z > -behind) & (z < ahead)
            found.append(_first_members(within, shuffled, count))
        index, inside, total = zip(*found, strict=True)
        return torch.cat(index, dim=1), torch.cat(inside, dim=1), torch.stack(total, dim=1)


def _first_members(within: Tensor, points: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first `count` of `points` (P,) that each row of a mask (C, P) admits: indices, mask, totals (C,)."""
    rank = within.cumsum(dim=1, dtype=torch.int32)
    total = rank[:, -1]
    row, column = (within & (rank <= count)).nonzero(as_tuple=True)
    index = torch.zeros(len(within), count, dtype=torch.long, device=within.device)
    index[row, (rank[row, column] - 1).long()] = points[column]
    return index, torch.arange(count, device=within.device) < total[:, None], total


def point_inputs(cloud: PreparedCloud) -> Tensor:
    """(P, 7): local spectrum, cosines of the normal with the line of sight and with up, height; zero where unknown."""
    count = len(cloud)
    facing = (cloud.normals * cloud.view_directions).sum(dim=1, keepdim=True)
    upright = torch.zeros(count, 2, device=cloud.points.device)
    height = torch.zeros(count, 2, device=cloud.points.device)
    if cloud.up is not None:
        upright = torch.stack([cloud.normals @ cloud.up, torch.ones(count, device=cloud.points.device)], dim=1)
        if cloud.support_height is not None:
            above = (cloud.points @ cloud.up - cloud.support_height) / (5 * _LENGTH)
            height = torch.stack([above, torch.ones(count, device=cloud.points.device)], dim=1)
    return torch.cat([10 * cloud.spectrum[:, :1], cloud.spectrum[:, 1:], facing, upright, height], dim=1)


def edge_inputs(cloud: PreparedCloud) -> Tensor:
    """(P, k, 4) point-pair features: distance, cosines of both normals with the offset and with each other."""
    shape = cloud.neighbours.shape
    flat = cloud.neighbours.flatten()
    offset = cloud.points.index_select(0, flat).view(*shape, 3) - cloud.points[:, None]
    other = cloud.normals.index_select(0, flat).view(*shape, 3)
    distance = offset.norm(dim=2)
    direction = offset / distance.clamp(min=1e-6)[..., None]
    own = cloud.normals[:, None]
    return torch.stack(
        [distance / _LENGTH, (own * direction).sum(2), (other * direction).sum(2), (own * other).sum(2)], dim=2
    )


def _region_inputs(cloud: PreparedCloud, poses: Tensor, index: Tensor, sign: Tensor) -> Tensor:
    """(C, M, 7): position and normal of the region's points in the grasp frame, and their facing to the camera."""
    shape = index.shape
    flat = index.flatten()
    rotation = poses[:, :3, :3]
    local = (cloud.points.index_select(0, flat).view(*shape, 3) - poses[:, None, :3, 3]) @ rotation / _LENGTH
    normal = cloud.normals.index_select(0, flat).view(*shape, 3) @ rotation
    facing = (cloud.normals * cloud.view_directions).sum(dim=1).index_select(0, flat).view(*shape, 1)
    flip = torch.ones(len(poses), 1, 3, device=poses.device)
    flip[:, 0, 0] = sign
    return torch.cat([local * flip, normal * flip, facing], dim=2)


def _candidate_inputs(cloud: PreparedCloud, candidates: Candidates, totals: Tensor, sign: Tensor) -> Tensor:
    """(C, 16): the pair, numbers of points near, n_a, line of sight and up, all in the grasp frame, and the height."""
    poses = candidates.Ts_canonical_grasp
    rotation = poses[:, :3, :3]
    flip = torch.ones(len(poses), 3, device=poses.device)
    flip[:, 0] = sign
    pair = ((cloud.points[candidates.contact] - cloud.points[candidates.approach])[:, None] @ rotation)[:, 0]
    normal = (cloud.normals[candidates.approach][:, None] @ rotation)[:, 0] * flip
    sight = (cloud.view_directions[candidates.approach][:, None] @ rotation)[:, 0] * flip
    up = torch.zeros(len(poses), 4, device=poses.device)
    height = torch.zeros(len(poses), 2, device=poses.device)
    if cloud.up is not None:
        up[:, :3] = (cloud.up @ rotation) * flip
        up[:, 3] = 1
        if cloud.support_height is not None:
            height[:, 0] = (poses[:, :3, 3] @ cloud.up - cloud.support_height) / (5 * _LENGTH)
            height[:, 1] = 1
    return torch.cat([pair[:, 1:] / _LENGTH, totals.float() / 100, normal, sight, up, height], 1)
