"""TES-Net: PointTransformerConv and GraphSAGE over a cloud's kNN graph, edge features and an MLP head for each grasp.

Every input is invariant under rigid motions by construction: point-pair features in the encoder (distance and three
angles; Drost et al. 2010), and offsets and normals seen in the candidate's own grasp frame in the head. The cloud is
encoded once; what a candidate adds is a gather, a small shared MLP over the points in its hand's reach and a max.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates, at_rest
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.layers import PointTransformerConv, SAGEConv
from tesnet.networks.around_hand import PROBES, PROBES_IN_FINGERS, Region, ends, probes, region_about
from tesnet.networks.low_things import unevenness
from tesnet.networks.network import mirror_factors
from tesnet.networks.rims import poor_pinch
from tesnet.networks.second_look import SecondLook, looks_again, seen_by_fingers
from tesnet.networks.told import TOLD_INPUTS, told_inputs
from tesnet.patches import Patches, group, pool
from tesnet.points import points_in_grasp_frames
from tesnet.visibility import SHADOW_MARGIN, depth_behind, outside

_POINT_INPUTS = 7
_EDGE_INPUTS = 4
_REGION_INPUTS = 7
_CANDIDATE_INPUTS = 23
_LENGTH = 0.02
"""Metres that count as 1 in the network's inputs."""


@dataclass(frozen=True, slots=True)
class TesNetConfig:
    """Widths of the network and the region of the cloud that a candidate sees.

    Args:
        channels: width of the encoder stage on the cloud's own points.
        wide_channels, wide_stages: width and number of the stages on patches of the cloud, whose neighbourhoods span
            whole objects.
        patch_size: edge of the cells whose points make a patch, metres.
        point_features, context_features: width of a point's and of the whole cloud's features.
        region_channels: widths of the shared MLP over the points in the hand's reach.
        head_channels: widths of the head's hidden layers.
        closing_points, closing_region: at most so many points are looked at where the fingers close, in a region about
            the open Franka hand (`region_about`).
        around_patches, around_region: the same for patches in the hand's wider surroundings.
        probe_channels: width of the layer over what the camera saw at the hand's probes.
        told: whether it is told the hand and the cloud's noise (`told_inputs`). Without, it knows of them what it sees.
        doubt: whether it is told besides whether the camera may not stand where it is said to.
        caution: log odds that a candidate would lose whose fingers stood wholly in what no camera saw; it loses the
            part of them that stands there. Not in training: on things that fit into a hand, behind what is seen there
            is nothing, and so a network learns; on things wider than the hand there is.
        mirrored: of so many candidates of a call, the best, the logit is the mean of what the network makes of their
            surroundings and of these reflected in the hand's plane. Not in training, which shows either.
        evenness: log odds that a candidate loses for low things of other heights between its fingers (`unevenness`),
            which may be several: these are found by heights, where a network sees one thing. Not in training.
        rims: log odds that a candidate of a hand whose tips swing far loses where it would pinch a rim that it drops
            (`poor_pinch`). Not in training.
        second_look: so many candidates of a call, the best, are looked at again, finger by finger (`SecondLook`), by
            what learns after the rest has: not for hands whose tips swing far, nor where the camera's pose is in doubt.
            Not in training.
    """

    channels: int = 32
    wide_channels: int = 64
    wide_stages: int = 2
    patch_size: float = 0.011
    point_features: int = 64
    context_features: int = 32
    region_channels: tuple[int, int] = (64, 128)
    head_channels: tuple[int, int] = (192, 96)
    probe_channels: int = 128
    closing_points: int = 56
    closing_region: Region = (0.012, 0.045, 0.042, 0.012)
    around_patches: int = 48
    around_region: Region = (0.035, 0.085, 0.060, 0.045)
    told: bool = False
    doubt: bool = False
    caution: float = 0.0
    mirrored: int = 0
    evenness: float = 0.0
    rims: float = 0.0
    second_look: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class CloudFeatures:
    """What the encoder found: `points` (P, F), `wide` (Q, W) of the Q `patches`, and `context` (context_features,)."""

    points: Tensor
    patches: Patches
    wide: Tensor
    context: Tensor


class TesNet(nn.Module):
    """Scores candidate grasps of a prepared cloud."""

    preparation: ClassVar[PreparationConfig] = PreparationConfig(smooth_above=0.0011)
    scored_at_once: ClassVar[int] = 500

    def __init__(self, config: TesNetConfig) -> None:
        super().__init__()
        self.config = config
        c, w, f = config.channels, config.wide_channels, config.point_features
        self.lift = nn.Linear(_POINT_INPUTS, c)
        self.stage = EncoderStage(c)
        self.widen = nn.Linear(2 * c, w)
        self.wide_stages = nn.ModuleList(EncoderStage(w) for _ in range(config.wide_stages))
        self.merge_points = nn.Linear(2 * c, f)
        self.merge_wide = nn.Linear(w * (config.wide_stages + 1), f, bias=False)
        self.context = nn.Sequential(nn.Linear(w, config.context_features), nn.ReLU())
        self.closing = RegionPooling(f, config.region_channels, config.closing_points, config.closing_region)
        self.around = RegionPooling(w, config.region_channels, config.around_patches, config.around_region)
        self.approach = nn.Linear(f, config.head_channels[0], bias=False)
        self.contact = nn.Linear(f, config.head_channels[0], bias=False)
        self.pooled = nn.Linear(2 * config.region_channels[1], config.head_channels[0], bias=False)
        self.candidate = nn.Linear(_CANDIDATE_INPUTS, config.head_channels[0])
        self.hidden_space = nn.Sequential(
            nn.Linear(2 * PROBES, config.probe_channels),
            nn.ReLU(),
            nn.Linear(config.probe_channels, config.head_channels[0], bias=False),
        )
        self.situation = nn.Linear(config.context_features, config.head_channels[0], bias=False)
        self.head = nn.Sequential(
            nn.ReLU(),
            nn.Linear(config.head_channels[0], config.head_channels[1]),
            nn.ReLU(),
            nn.Linear(config.head_channels[1], 1),
        )
        if config.told:
            self.told = Told(config)
        if config.second_look:
            self.second_look = SecondLook()

    @property
    def knows_hands(self) -> bool:
        """Whether it is told the hand."""
        return self.config.told

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[CloudFeatures]:
        """Features of every point and of the whole of each cloud, in one pass over the stacked graphs of all of them.

        They equal those of each cloud alone up to the rounding of float32, which depends on the size of a matrix
        product.
        """
        all_patches = [group(cloud, self.config.patch_size) for cloud in clouds]
        lifted = torch.relu(self.lift(torch.cat([point_inputs(cloud) for cloud in clouds])))
        neighbours = _stacked([cloud.neighbours for cloud in clouds], [len(cloud) for cloud in clouds])
        edges = torch.cat([edge_features(cloud.points, cloud.normals, cloud.neighbours) for cloud in clouds])
        fine = torch.cat([lifted, self.stage(lifted, neighbours, edges)], dim=1)

        sizes = [len(patches) for patches in all_patches]
        member_of = _stacked([patches.member_of for patches in all_patches], sizes)
        neighbours = _stacked([patches.neighbours for patches in all_patches], sizes)
        edges = torch.cat([edge_features(p.points, p.normals, p.neighbours) for p in all_patches])
        x = torch.relu(self.widen(pool(fine, member_of, sum(sizes))))
        depths = [x]
        for stage in self.wide_stages:
            x = stage(x, neighbours, edges)
            depths.append(x)
        merged = self.merge_wide(torch.cat(depths, dim=1))
        points = torch.relu(self.merge_points(fine) + merged.index_select(0, member_of))
        return [
            CloudFeatures(of_points, patches, wide, self.context(wide.amax(dim=0)))
            for of_points, patches, wide in zip(
                points.split([len(cloud) for cloud in clouds]), all_patches, x.split(sizes), strict=True
            )
        ]

    def score(
        self, features: CloudFeatures, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,) of the candidates, which are looked at where the fingers come to rest.

        Args:
            features: of this cloud.
            cloud: P points.
            candidates: C grasps.
            mirror: (C,) +1 or -1; -1 shows the candidate's surroundings reflected in the hand's plane, under which the
                outcome of a grasp does not change. For training.
        """
        candidates = at_rest(cloud, candidates)
        at_fingers = self.closing.members(cloud.points, candidates)
        near_hand = self.around.members(features.patches.points, candidates)
        told = self.told(cloud, candidates, at_fingers) if self.config.told else None
        seen = _Seen(candidates, at_fingers, near_hand, told)
        one = torch.ones(len(candidates), device=cloud.points.device)
        sign = one if mirror is None else mirror
        behind = _depth_behind_probes(cloud, candidates, sign)
        logits = self._logits(features, cloud, seen, behind, sign)
        if self.training:
            return logits
        lost = self._lost(cloud, seen, behind)
        if self.config.mirrored and mirror is None:
            best = (logits - lost).topk(min(self.config.mirrored, len(logits))).indices
            some, other = seen.select(best), -one[best]
            reflected = self._logits(features, cloud, some, _depth_behind_probes(cloud, some.candidates, other), other)
            logits = logits.index_copy(0, best, (logits[best] + reflected) / 2)
        again = looks_again(candidates.gripper) and not cloud.pose_in_doubt  # or the hand stands where nobody looked
        if self.config.second_look and mirror is None and again:
            best = (logits - lost).topk(min(self.config.second_look, len(logits))).indices
            closer = self.second_look(seen_by_fingers(cloud, candidates.select(best)), logits[best])
            logits = logits.index_copy(0, best, closer)
        return logits - lost

    def _logits(
        self, features: CloudFeatures, cloud: PreparedCloud, seen: _Seen, behind: Tensor, sign: Tensor
    ) -> Tensor:
        """Logits (C,) of candidates whose surroundings are mirrored where `sign` (C,) is -1.

        Args:
            features: of the cloud.
            cloud: P points.
            seen: the candidates, and what is looked at for them.
            behind: (C, PROBES) how far their probes lie behind what the camera saw, mirrored likewise.
            sign: (C,) +1 or -1.
        """
        candidates, at_fingers, near_hand = seen.candidates, seen.at_fingers, seen.near_hand
        poses = candidates.Ts_canonical_grasp
        of_closing, of_around, of_head = seen.told or (None,) * 3
        closing = self.closing(features.points, cloud, at_fingers, poses, sign, of_closing)
        around = self.around(features.wide, features.patches, near_hand, poses, sign, of_around)
        totals = torch.stack([at_fingers.total, near_hand.total], dim=1)
        joined = (
            self.pooled(torch.cat([closing, around], dim=1))
            + self.approach(features.points)[candidates.approach]
            + self.contact(features.points)[candidates.contact]
            + self.candidate(_candidate_inputs(cloud, candidates, totals, sign))
            + self.situation(features.context)
            + self.hidden_space(_probe_inputs(behind))
        )
        if of_head is not None:
            joined = joined + of_head
        logits: Tensor = self.head(joined)[:, 0]
        return logits

    def _lost(self, cloud: PreparedCloud, seen: _Seen, behind: Tensor) -> Tensor:
        """(C,) log odds that candidates lose for what labels do not teach, and so nothing that is learned makes good.

        Args:
            cloud: P points.
            seen: the candidates, and what is looked at for them.
            behind: (C, PROBES) how far their probes lie behind what the camera saw.
        """
        candidates, index = seen.candidates, seen.at_fingers.index
        lost = torch.zeros_like(candidates.widths)
        if self.config.caution:
            unseen = behind[:, :PROBES_IN_FINGERS] > SHADOW_MARGIN
            lost = lost + self.config.caution * unseen.float().mean(dim=1)
        if self.config.evenness:
            lost = lost + self.config.evenness * unevenness(cloud, candidates, index)
        if self.config.rims:
            lost = lost + self.config.rims * poor_pinch(cloud, candidates, index)
        return lost


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


@dataclass(frozen=True, eq=False, slots=True)
class RegionMembers:
    """Points in each candidate's region.

    Args:
        index: (C, M) of them, the first repeated where there are fewer.
        total: (C,) how many there are.
    """

    index: Tensor
    total: Tensor

    def select(self, rows: Tensor) -> RegionMembers:
        """Those of some candidates."""
        return RegionMembers(self.index[rows], self.total[rows])


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """Candidates and what is looked at for them, mirrored or not.

    Args:
        candidates: where their fingers come to rest.
        at_fingers, near_hand: points and patches in their regions.
        told: what `Told` makes of them, if the network is told.
    """

    candidates: Candidates
    at_fingers: RegionMembers
    near_hand: RegionMembers
    told: Sequence[Tensor] | None

    def select(self, rows: Tensor) -> _Seen:
        """The same of some candidates."""
        told = None if self.told is None else [part[rows] for part in self.told]
        return _Seen(self.candidates.select(rows), self.at_fingers.select(rows), self.near_hand.select(rows), told)


class RegionPooling(nn.Module):
    """What lies in a box about each candidate's hand: a shared MLP over the points in it, then the largest of each.

    Args:
        in_channels: F, features of a point.
        channels: widths of the MLP.
        count: at most so many points are looked at; where more lie there, a pseudo-random choice of them that is fixed
            by the number of all points.
        region: where, about the open Franka hand.
    """

    def __init__(self, in_channels: int, channels: tuple[int, int], count: int, region: Region) -> None:
        super().__init__()
        self.features = nn.Linear(in_channels, channels[0], bias=False)
        self.geometry = nn.Linear(_REGION_INPUTS, channels[0])
        self.update = nn.Linear(channels[0], channels[1])
        self.count = count
        self.region = region

    def forward(
        self,
        features: Tensor,
        cloud: PreparedCloud | Patches,
        members: RegionMembers,
        poses: Tensor,
        sign: Tensor,
        shift: Tensor | None = None,
    ) -> Tensor:
        """Pooled features (C, channels[1]) from features (P, F) of the points.

        Args:
            features: of the cloud's points.
            cloud: P points with normals.
            members: the points in each region.
            poses: (C, 4, 4) TCP poses.
            sign: (C,) +1, or -1 to see the surroundings mirrored in the hand's plane.
            shift: (C, channels[0]) what a candidate adds to the first layer at each of its points.
        """
        index = members.index
        facing = (cloud.normals * cloud.view_directions).sum(dim=1, keepdim=True)
        table = torch.cat([cloud.points, cloud.normals, facing], dim=1)
        flat = index.flatten()
        inputs = table.index_select(0, flat).view(*index.shape, _REGION_INPUTS)
        gathered = self.features(features).index_select(0, flat).view(*index.shape, self.features.out_features)
        weight, bias = self._geometry_of(poses, sign)
        bias = bias if shift is None else bias + shift
        hidden = torch.relu(torch.baddbmm(gathered + bias[:, None], inputs, weight))
        pooled = torch.relu(self.update(hidden).amax(dim=1))
        return pooled * (members.total > 0)[:, None]

    def _geometry_of(self, poses: Tensor, sign: Tensor) -> tuple[Tensor, Tensor]:
        """`geometry` for points and normals that are given in the cloud's frame: weights (C, 7, D) and biases (C, D).

        Turning each candidate's weights is cheaper than turning all points in its box.
        """
        rotation = poses[:, :3, :3] * mirror_factors(sign)[:, None]
        points, normals, facing = self.geometry.weight.T.split([3, 3, 1])
        turned = rotation @ (points / _LENGTH)
        weight = torch.cat([turned, rotation @ normals, facing.expand(len(poses), -1, -1)], dim=1)
        return weight, self.geometry.bias - (poses[:, None, :3, 3] @ turned)[:, 0]

    def members(self, points: Tensor, candidates: Candidates) -> RegionMembers:
        """Those of the points (P, 3) in the candidates' regions."""
        poses = candidates.Ts_canonical_grasp
        shuffled = torch.randperm(len(points), generator=torch.Generator().manual_seed(0)).to(poses.device)
        x, y, z = points_in_grasp_frames(points[shuffled], poses)
        breadth, length, behind, ahead = region_about(self.region, candidates)
        within = (x.abs_() < breadth) & (y.abs_() < length[:, None]) & (z > -behind) & (z < ahead)
        row, column = within.nonzero(as_tuple=True)
        total = torch.bincount(row, minlength=len(poses))
        start = total.cumsum(0) - total
        first = torch.cat([column, column.new_zeros(1)])[start]  # of regions that hold nothing, some point's
        index = shuffled[first][:, None].repeat(1, self.count)
        rank = torch.arange(len(row), device=row.device) - start[row]
        kept = rank < self.count
        index[row[kept], rank[kept]] = shuffled[column[kept]]
        return RegionMembers(index, total)


class Told(nn.Module):
    """What a candidate's hand and the cloud's noise add to the first layers over its regions and of the head.

    Nothing at first: trained weights of a network that was not told are good to begin with.
    """

    def __init__(self, config: TesNetConfig) -> None:
        super().__init__()
        self.widths = [config.region_channels[0], config.region_channels[0], config.head_channels[0]]
        self.doubt = config.doubt
        self.layer = nn.Linear(TOLD_INPUTS + config.doubt, sum(self.widths), bias=False)
        nn.init.zeros_(self.layer.weight)

    def forward(self, cloud: PreparedCloud, candidates: Candidates, at_fingers: RegionMembers) -> Sequence[Tensor]:
        """(C, channels[0]) twice, for the points at the fingers and the patches about the hand; (C, head_channels[0]).

        Args:
            cloud: P points.
            candidates: C grasps.
            at_fingers: the points near the fingers.
        """
        poses = candidates.Ts_canonical_grasp
        points = cloud.points.index_select(0, at_fingers.index.flatten()).view(*at_fingers.index.shape, 3)
        between = (points - poses[:, None, :3, 3]) @ poses[:, :3, :3]
        told = told_inputs(cloud, candidates, between, at_fingers.total > 0)
        if self.doubt:
            told = torch.cat([told, told.new_full((len(told), 1), float(cloud.pose_in_doubt))], dim=1)
        parts: Sequence[Tensor] = self.layer(told).split(self.widths, dim=1)
        return parts


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


def _stacked(tables: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
    """Tables of indices one below the other, each raised by the sizes of those before it."""
    before = itertools.accumulate(sizes, initial=0)
    return torch.cat([table + start for table, start in zip(tables, before, strict=False)])


def edge_features(points: Tensor, normals: Tensor, neighbours: Tensor) -> Tensor:
    """(P, k, 4) point-pair features: distance, cosines of both normals with the offset and with each other."""
    shape = neighbours.shape
    flat = neighbours.flatten()
    offset = points.index_select(0, flat).view(*shape, 3) - points[:, None]
    other = normals.index_select(0, flat).view(*shape, 3)
    distance = offset.norm(dim=2)
    direction = offset / distance.clamp(min=1e-6)[..., None]
    own = normals[:, None]
    return torch.stack(
        [distance / _LENGTH, (own * direction).sum(2), (other * direction).sum(2), (own * other).sum(2)], dim=2
    )


def _candidate_inputs(cloud: PreparedCloud, candidates: Candidates, totals: Tensor, sign: Tensor) -> Tensor:
    """(C, 23): the pair, numbers of points near, n_a, line of sight and up, all in the grasp frame, the height, and how
    far the ends of the hand reach out of the workspace.
    """
    poses = candidates.Ts_canonical_grasp
    rotation = poses[:, :3, :3]
    flip = mirror_factors(sign)
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
    places = ends(candidates.gripper).of(candidates) @ rotation.transpose(1, 2) + poses[:, None, :3, 3]
    out = (outside(cloud, places) / _LENGTH).clamp(-2, 2)
    return torch.cat([pair[:, 1:] / _LENGTH, totals.float() / 100, normal, sight, up, height, out], 1)


def _depth_behind_probes(cloud: PreparedCloud, candidates: Candidates, sign: Tensor) -> Tensor:
    """(C, PROBES): how far the hand's probes lie behind what the camera saw, metres, mirrored where `sign` is -1."""
    poses = candidates.Ts_canonical_grasp
    local = probes(candidates.gripper).of(candidates)
    places = (mirror_factors(sign)[:, None] * local) @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]
    return depth_behind(cloud, places)


def _probe_inputs(behind: Tensor) -> Tensor:
    """(C, 2 PROBES): the depths (C, PROBES) on a coarse and on a fine scale."""
    scaled = behind / _LENGTH
    return torch.cat([scaled.clamp(-2, 3), (4 * scaled).clamp(-1, 1)], dim=1)
