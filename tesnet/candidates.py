"""Candidate grasps of a prepared cloud: ordered pairs of points, their poses and the cheap geometric masks.

The representation is Edge Grasp Network's (Huang et al. 2023, arXiv 2211.00191, section III); CONVENTIONS.md, "From two
points to a grasp", has the limits and what was added. Vectorised torch; lengths in metres; everything in the cloud's
canonical frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tesnet.clearance import stopping_short
from tesnet.cloud import PreparedCloud
from tesnet.geometry import PANDA, Gripper
from tesnet.outline import Outline, is_low, outline
from tesnet.points import farthest_points, points_in_grasp_frames
from tesnet.query import MAX_APPROACH_POINTS, GraspQuery

TIP_BEYOND_CONTACT = 0.007
"""How far the fingertips reach past the depth of the contact point."""

_STEEPEST_RISE = 0.95
"""Contact points of shallow pairs face sideways, if only a little: the cosine of their normal with `up` is less."""

_FARTHEST_ASIDE = 0.005
"""Metres; contact points of shallow pairs lie no farther beside the plane in which the fingers close."""

_UPWARD = 0.5
"""The face of a low thing: the cosine of its normal with `up` is at least this."""

_ROUNDING = 1e-5

_BESIDE = 0.003
"""What fingers close on lies no farther beside the hand's middle plane than half a finger's breadth and this."""

_CLOSING_STEPS = 8
"""Into so many pieces the way of tips that swing is cut, which is then at most 0.3 mm off."""

_CLOSES_FARTHER = 0.01
"""Fingers are taken to close this much farther, metres, than to the walls that they are expected to rest on."""

_PAIRS_AT_ONCE = 500_000
"""Pairs of points whose offsets are in memory at a time, some 20 MB."""

MOST_PAIRS = 500_000
"""Of more pairs in reach so many are tried, spread evenly: hands with very long fingers reach millions."""


@dataclass(frozen=True, slots=True)
class CandidateConfig:
    """Which pairs of points are candidates; travels with the weights.

    Args:
        max_pair_distance: |d| of contact point from approach point.
        max_depth, min_depth: limits of |d_perp|, the depth of the grasp.
        min_offset, max_offset: limits of d . n_c, so that one fingertip closes onto the contact point from outside.
        max_upward: largest z . up of the direction of travel.
        support_clearance: least distance of the hand from the support plane.
        levelled_within_deg: where up is known, a contact normal that deviates less than this from the horizontal is
            taken to be horizontal. Most walls that fingers close on are upright, the noise of a normal tilts the hand,
            and beside a flat object the lower finger of a tilted hand meets the table.
        centred: whether the hand stands midway between the walls that it closes on, not over the approach point.
        centring: version of what has learned where that is (`tesnet.centring`); None goes by rules (`tesnet.fitting`).
    """

    max_pair_distance: float = 0.038
    min_depth: float = 0.003
    max_depth: float = 0.040
    min_offset: float = -0.003
    max_offset: float = 0.038
    max_upward: float = 0.1
    support_clearance: float = 0.004
    levelled_within_deg: float = 25.0
    centred: bool = True
    centring: str | None = "1"

    @classmethod
    def stored(cls, limits: Mapping[str, Any]) -> CandidateConfig:
        """That of a weights file's header; those written before a rule was there do without it."""
        return cls(**{"centred": False, "centring": None, **limits})


@dataclass(frozen=True, eq=False, slots=True)
class Candidates:
    """C candidate grasps.

    Args:
        approach: (C,) indices of the approach points in the cloud.
        contact: (C,) indices of the contact points.
        Ts_canonical_grasp: (C, 4, 4) TCP poses: +z the direction of travel, +y the closing direction.
        widths: (C,) metres between the fingers as they arrive there.
        gripper: the hand of all of them.
    """

    approach: Tensor
    contact: Tensor
    Ts_canonical_grasp: Tensor
    widths: Tensor
    gripper: Gripper

    def __len__(self) -> int:
        return len(self.approach)

    def select(self, which: Tensor) -> Candidates:
        """The candidates at the indices (K,), or where the mask (C,) is true."""
        return Candidates(
            self.approach[which], self.contact[which], self.Ts_canonical_grasp[which], self.widths[which], self.gripper
        )

    def openings(self) -> NDArray[np.float64]:
        """(C,) the widths as the hand is told them: micrometres, and no wider than it opens."""
        widths: NDArray[np.float64] = np.minimum(self.widths.cpu().double().numpy().round(6), self.gripper.max_width)
        return widths

    def joined_by(self, others: Candidates) -> Candidates:
        """These candidates, then the others of the same cloud and hand."""
        return Candidates(
            torch.cat([self.approach, others.approach]),
            torch.cat([self.contact, others.contact]),
            torch.cat([self.Ts_canonical_grasp, others.Ts_canonical_grasp]),
            torch.cat([self.widths, others.widths]),
            self.gripper,
        )


def generate(
    cloud: PreparedCloud,
    query: GraspQuery,
    config: CandidateConfig,
    edges: Callable[[], Outline] | None = None,
    between: Callable[[], None] = lambda: None,
) -> tuple[Candidates, dict[str, int]]:
    """At most `max_candidates` candidates, and how many pairs each mask dropped.

    Approach points lie on the target, if there is one. While they yield fewer than half of `max_candidates`, as beside
    flat objects, four times as many are tried. Those of `_without_walls` are added where they are wanted.

    Args:
        cloud: where.
        query: what is asked.
        config: the limits.
        edges: finds the cloud's outline, for who searches one cloud several times.
        between: called between blocks of work of some tens of milliseconds.
    """
    allowed = torch.arange(len(cloud), device=cloud.points.device)
    if cloud.on_target is not None:
        allowed = allowed[cloud.on_target]
    if len(allowed) == 0:
        return _no_candidates(cloud, query.gripper), {}
    config = limits_for(query.gripper, config)
    generator = torch.Generator().manual_seed(query.seed)
    start = int(torch.randint(len(allowed), (1,), generator=generator))
    count = query.num_approach_points
    while True:
        approach_points = allowed[farthest_points(cloud.points[allowed], count, start)]
        candidates, alive, rejected = _search(cloud, query, config, approach_points, between)
        if 2 * int(alive.sum()) >= query.most_candidates or count >= min(len(allowed), MAX_APPROACH_POINTS):
            break
        count = more_approach_points(count)
    edges = edges or partial(outline, cloud, query)
    for made in _without_walls(cloud, query, config, approach_points, int(alive.sum()), edges):
        between()
        others, also_alive, also_rejected = _judge(cloud, query, config, made)
        candidates, alive = candidates.joined_by(others), torch.cat([alive, also_alive])
        rejected = {name: count + also_rejected[name] for name, count in rejected.items()}
    survivors = alive.nonzero()[:, 0]
    if len(survivors) > query.most_candidates:
        chosen = torch.randperm(len(survivors), generator=generator)[: query.most_candidates].sort().values
        survivors = survivors[chosen.to(survivors.device)]
    return candidates.select(survivors), rejected


def more_approach_points(count: int) -> int:
    """How many approach points to try where `count` were too few: time and memory grow with it."""
    return min(4 * count, MAX_APPROACH_POINTS)


def limits_for(hand: Gripper, config: CandidateConfig) -> CandidateConfig:
    """The limits, which are the Panda hand's, for another one: they follow its opening and the depth of its fingers."""
    wider = (hand.max_width - PANDA.max_width) / 2
    deeper = hand.finger_depth - PANDA.finger_depth
    return replace(
        config,
        max_offset=config.max_offset + wider,
        max_depth=config.max_depth + deeper,
        max_pair_distance=config.max_pair_distance + max(0.0, wider, deeper),
    )


def wide_open(poses: Tensor, hand: Gripper) -> Tensor:
    """The hand's largest opening for each of the poses (C, 4, 4): (C,) metres."""
    return poses.new_full((len(poses),), hand.max_width)


def _no_candidates(cloud: PreparedCloud, hand: Gripper) -> Candidates:
    nothing = torch.empty(0, dtype=torch.long, device=cloud.points.device)
    return Candidates(nothing, nothing, cloud.points.new_empty(0, 4, 4), cloud.points.new_empty(0), hand)


def _search(
    cloud: PreparedCloud,
    query: GraspQuery,
    config: CandidateConfig,
    approach_points: Tensor,
    between: Callable[[], None],
) -> tuple[Candidates, Tensor, dict[str, int]]:
    """The pairs in reach of the approach points, a mask of those that no rule drops, and how many each rule does."""
    normals = contact_normals(cloud, config)
    approach, contact = _at_most(MOST_PAIRS, *pairs_in_reach(cloud.points, normals, approach_points, config, between))
    between()
    poses = grasp_poses(cloud.points[approach], cloud.points[contact], normals[contact], hand=query.gripper)
    between()
    candidates = Candidates(approach, contact, poses, wide_open(poses, query.gripper), query.gripper)
    return _judge(cloud, query, config, candidates)


def _at_most(limit: int, approach: Tensor, contact: Tensor) -> tuple[Tensor, Tensor]:
    """The pairs (C,), (C,), or so many of them, spread evenly over their order."""
    if len(approach) <= limit:
        return approach, contact
    kept = torch.arange(limit, device=approach.device) * len(approach) // limit
    return approach[kept], contact[kept]


def _judge(
    cloud: PreparedCloud, query: GraspQuery, config: CandidateConfig, candidates: Candidates
) -> tuple[Candidates, Tensor, dict[str, int]]:
    """The candidates, clear of the support, a mask of those that no rule drops, and how many each rule does."""
    candidates, too_near = clear_of_support(cloud, candidates, config)
    poses = candidates.Ts_canonical_grasp
    masks = {
        "from_below": _comes_from_behind(cloud, candidates, config),
        "approach": _outside_cone(cloud, poses[:, :3, 2], query),
        "support": too_near,
        "target": _off_target(cloud, candidates.contact),
    }
    rejected = {}
    alive = torch.ones(len(candidates), dtype=torch.bool, device=poses.device)
    for name, bad in masks.items():
        rejected[name] = int((bad & alive).sum())
        alive &= ~bad
    return candidates, alive, rejected


def clear_of_support(
    cloud: PreparedCloud, candidates: Candidates, config: CandidateConfig
) -> tuple[Candidates, Tensor]:
    """The candidates, those stopped short that come too near to the support, and a mask of those that still do."""
    poses, hand = candidates.Ts_canonical_grasp, candidates.gripper
    clearance = hand_clearance(cloud, candidates)
    if cloud.up is None or cloud.support_height is None:
        return candidates, torch.zeros_like(clearance, dtype=torch.bool)
    travel = poses[:, :3, 2]
    tips = at_rest(cloud, candidates).Ts_canonical_grasp[:, :3, 3] + hand.tip_offset * travel
    past_approach, past_contact = (
        ((tips - cloud.points[point]) * travel).sum(dim=1) for point in (candidates.approach, candidates.contact)
    )
    back, too_near = stopping_short(
        -(travel @ cloud.up),
        clearance,
        past_approach,
        wanted=config.support_clearance,
        error=cloud.support_error,
        farthest=past_contact.clamp(min=0.0) + _ROUNDING,
    )
    poses = poses.clone()
    poses[:, :3, 3] -= back[:, None] * travel
    return replace(candidates, Ts_canonical_grasp=poses), too_near


def _without_walls(
    cloud: PreparedCloud,
    query: GraspQuery,
    config: CandidateConfig,
    approach_points: Tensor,
    count: int,
    edges: Callable[[], Outline],
) -> Iterator[Candidates]:
    """The candidates that do without a wall to measure depth on, beside `count` of those that have one.

    On the outline of faces seen from straight above the outward direction of the edge stands for the contact normal.
    Without `up` such faces cannot be told from others: there, these candidates are for want of others. Low things are
    those over a known plane whose walls are too low to measure a depth on.
    """
    if cloud.up is not None:
        low_faces = is_low(cloud) & (cloud.normals @ cloud.up >= _UPWARD)
        low = approach_points[low_faces[approach_points]]
        if len(low):
            walls = _low_walls(cloud, cloud.up)
            yield _along_travel(cloud, query.gripper, config, low, walls, (0.0, config.min_depth))
    if cloud.up is not None or count == 0:
        outlines = edges()
        if len(outlines.points):
            depths = (config.min_offset, config.max_depth)
            yield _along_travel(cloud, query.gripper, config, approach_points, outlines, depths)


def _low_walls(cloud: PreparedCloud, up: Tensor) -> Outline:
    """Contact points of pairs less deep than `min_depth`, for a hand that closes along the levelled normal.

    So shallow a pair says nothing of the direction of travel, but of flat things that lie on a plane it is known.
    """
    rise = cloud.normals @ up
    level = torch.nn.functional.normalize(cloud.normals - rise[:, None] * up, dim=1)
    contacts = (rise.abs() < _STEEPEST_RISE).nonzero()[:, 0]
    return Outline(contacts, level[contacts], (-up).expand(len(contacts), 3))


def _along_travel(
    cloud: PreparedCloud,
    hand: Gripper,
    config: CandidateConfig,
    approach_points: Tensor,
    edges: Outline,
    depths: tuple[float, float],
) -> Candidates:
    """Pairs of approach points with edges whose directions of closing and travel are known.

    Depth, along the travel, lies from the first of `depths` to below the second.
    """
    found = []
    for some in approach_points.split(max(1, _PAIRS_AT_ONCE // max(1, len(edges.points)))):
        offsets = cloud.points[edges.points][None] - cloud.points[some][:, None]
        along = (offsets * edges.outward[None]).sum(dim=2)
        depth = (offsets * edges.travel[None]).sum(dim=2)
        square = offsets.square().sum(dim=2)
        aside = (square - along.square() - depth.square()).clamp(min=0).sqrt()
        ok = (
            (square <= config.max_pair_distance**2)
            & (depth >= depths[0])
            & (depth < depths[1])
            & (along >= config.min_offset)
            & (along <= config.max_offset)
            & (aside <= _FARTHEST_ASIDE)
        )
        which, edge = ok.nonzero(as_tuple=True)
        found.append((some[which], edge))
    approach, edge = (torch.cat(parts) for parts in zip(*found, strict=True))
    contact, closing, travel = edges.points[edge], edges.outward[edge], edges.travel[edge]
    poses = poses_along(cloud.points[approach], cloud.points[contact], closing, travel, hand=hand)
    return Candidates(approach, contact, poses, wide_open(poses, hand), hand)


def contact_normals(cloud: PreparedCloud, config: CandidateConfig) -> Tensor:
    """(P, 3) the points' normals as candidates close along them: nearly horizontal ones are levelled."""
    if cloud.up is None:
        return cloud.normals
    rise = cloud.normals @ cloud.up
    level = torch.nn.functional.normalize(cloud.normals - rise[:, None] * cloud.up, dim=1)
    nearly_level = rise.abs() < math.sin(math.radians(config.levelled_within_deg))
    return torch.where(nearly_level[:, None], level, cloud.normals)


def pairs_in_reach(
    points: Tensor,
    normals: Tensor,
    approach_points: Tensor,
    config: CandidateConfig,
    between: Callable[[], None] = lambda: None,
) -> tuple[Tensor, Tensor]:
    """Indices (C,), (C,) of approach and contact points that satisfy the limits on distance, depth and offset.

    Args:
        points: (P, 3).
        normals: (P, 3) as contact points.
        approach_points: (A,) indices.
        config: the limits.
        between: called between blocks of work of some tens of milliseconds.
    """
    found = []
    for some in approach_points.split(max(1, _PAIRS_AT_ONCE // max(1, len(points)))):
        between()
        found.append(_pairs_of_some(points, normals, some, config))
    return torch.cat([approach for approach, _ in found]), torch.cat([contact for _, contact in found])


def _pairs_of_some(
    points: Tensor, normals: Tensor, approach_points: Tensor, config: CandidateConfig
) -> tuple[Tensor, Tensor]:
    distances = torch.cdist(points[approach_points], points, compute_mode="donot_use_mm_for_euclid_dist")
    which, contact = (distances <= config.max_pair_distance + _ROUNDING).nonzero(as_tuple=True)
    offsets = points[contact] - points[approach_points[which]]
    along_normal = (offsets * normals[contact]).sum(dim=1)
    square = offsets.square().sum(dim=1)
    depth = (square - along_normal.square()).clamp(min=0).sqrt()
    ok = (
        (square <= config.max_pair_distance**2)
        & (depth >= config.min_depth)
        & (depth <= config.max_depth)
        & (along_normal >= config.min_offset)
        & (along_normal <= config.max_offset)
    )
    return approach_points[which[ok]], contact[ok]


def grasp_poses(
    approach_points: Tensor, contact_points: Tensor, contact_normals: Tensor, *, hand: Gripper = PANDA
) -> Tensor:
    """TCP poses (C, 4, 4) of the open hand for pairs of points (C, 3) and the contact points' unit normals (C, 3).

    z = d_perp / |d_perp| with d_perp the part of d = p_c - p_a across the normal; y = the normal; the fingertips stop
    7 mm past the depth of the contact point on the line through p_a (CONVENTIONS.md, "From two points to a grasp"),
    once they have closed up to it.
    """
    d = contact_points - approach_points
    along = (d * contact_normals).sum(dim=1, keepdim=True)
    d_perp = d - along * contact_normals
    depth = d_perp.norm(dim=1, keepdim=True)
    z = d_perp / depth
    y = contact_normals - (contact_normals * z).sum(dim=1, keepdim=True) * z
    return _poses(approach_points, z, y / y.norm(dim=1, keepdim=True), depth, along, hand)


def poses_along(
    approach_points: Tensor,
    contact_points: Tensor,
    closing: Tensor,
    travel: Tensor,
    *,
    hand: Gripper = PANDA,
) -> Tensor:
    """TCP poses (C, 4, 4) of pairs of points (C, 3) whose unit directions of closing and travel (C, 3) are known.

    Those of `grasp_poses` where the directions are; depth is measured along the travel.
    """
    d = contact_points - approach_points
    along, depth = ((d * direction).sum(dim=1, keepdim=True) for direction in (closing, travel))
    return _poses(approach_points, travel, closing, depth, along, hand)


def _poses(approach_points: Tensor, z: Tensor, y: Tensor, depth: Tensor, along: Tensor, hand: Gripper) -> Tensor:
    """TCP poses (C, 4, 4) of open hands whose tips come to lie 7 mm past the depth (C, 1) under the approach points.

    Of a hand whose tips swing forward that is once they have closed up to the contact points, `along` (C, 1) beside the
    middle.
    """
    x = torch.linalg.cross(y, z, dim=1)
    reach = depth + TIP_BEYOND_CONTACT - hand.tip_offset
    if hand.linkage_length is not None:
        reach = reach - (hand.tcp_at(2 * along.clamp(0.0, hand.max_width / 2)) - hand.hand_to_tcp)
    tcp = approach_points + reach * z
    poses = torch.zeros(len(z), 4, 4, dtype=z.dtype, device=z.device)
    poses[:, :3, :] = torch.stack([x, y, z, tcp], dim=2)
    poses[:, 3, 3] = 1
    return poses


def hand_clearance(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C,) metres from the support plane to the lowest corner of the hand, open or closing; infinite without one.

    Tips that swing are followed until the opening is `_CLOSES_FARTHER` less than where they should come to rest; closed
    on nothing, they come lower.
    """
    poses, hand, widths = candidates.Ts_canonical_grasp, candidates.gripper, candidates.widths
    if cloud.up is None or cloud.support_height is None:
        return poses.new_full((len(poses),), math.inf)
    up = (poses[:, :3, :3] * cloud.up[None, :, None]).sum(dim=1)
    on_the_way = [widths]
    if hand.linkage_length is not None:  # tips that slide get no lower as they close
        closed = (resting_widths(cloud, candidates) - _CLOSES_FARTHER).clamp(min=0.0)
        on_the_way = [torch.lerp(widths, closed, step / _CLOSING_STEPS) for step in range(_CLOSING_STEPS + 1)]
        on_the_way.append(closed.clamp(min=hand.farthest_width).minimum(widths))
    lowest = []
    for part in hand.parts:
        corners = torch.tensor(part.corners(0.0), dtype=poses.dtype, device=poses.device)
        heights = (up @ corners.T).min(dim=1).values
        for width in on_the_way if part.side else [widths]:
            advance = hand.tcp_at(width) - hand.tcp_at(widths)
            lowest.append(heights + part.side * up[:, 1] * width / 2 + up[:, 2] * advance)
    return poses[:, :3, 3] @ cloud.up - cloud.support_height + torch.stack(lowest).min(dim=0).values


def contact_places(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C,) metres from the hand's middle to its contact point, along the closing direction."""
    poses = candidates.Ts_canonical_grasp
    return ((cloud.points[candidates.contact] - poses[:, :3, 3]) * poses[:, :3, 1]).sum(dim=1)


def between_palm_and_tips(cloud: PreparedCloud, candidates: Candidates) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The cloud's P points in each grasp frame, (C, P): |x|, y, z, and which of them may lie between the fingers.

    They do if they are as deep as the fingers and no farther beside the hand's middle plane than half a finger's
    breadth and `_BESIDE`; how far apart the fingers are does not count.
    """
    hand = candidates.gripper
    x, y, z = points_in_grasp_frames(cloud.points, candidates.Ts_canonical_grasp)
    beside = x.abs_()
    inside = (beside <= hand.finger_breadth / 2 + _BESIDE) & (z >= hand.palm_front) & (z <= hand.tip_offset)
    return beside, y, z, inside


def resting_widths(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C,) metres: opening at which each hand rests on its contact point and on a wall as far from its middle."""
    return torch.minimum(2 * contact_places(cloud, candidates).clamp(min=0.0), candidates.widths)


def at_rest(cloud: PreparedCloud, candidates: Candidates) -> Candidates:
    """The candidates, each TCP where it is once the fingers rest, while the palm stays where it is as they arrive.

    Their widths stay those of arrival, so this is for looking at what is held, not for placing a hand.
    """
    hand = candidates.gripper
    if hand.linkage_length is None:
        return candidates
    advance = hand.tcp_at(resting_widths(cloud, candidates)) - hand.tcp_at(candidates.widths)
    poses = candidates.Ts_canonical_grasp.clone()
    poses[:, :3, 3] += advance[:, None] * poses[:, :3, 2]
    return replace(candidates, Ts_canonical_grasp=poses)


def _comes_from_behind(cloud: PreparedCloud, candidates: Candidates, config: CandidateConfig) -> Tensor:
    """Mask of candidates that travel upwards or, where up is unknown, towards the camera."""
    z = candidates.Ts_canonical_grasp[:, :3, 2]
    against = cloud.view_directions[candidates.approach] if cloud.up is None else cloud.up.expand_as(z)
    return (z * against).sum(dim=1) >= config.max_upward


def _off_target(cloud: PreparedCloud, contact: Tensor) -> Tensor:
    if cloud.on_target is None:
        return torch.zeros(len(contact), dtype=torch.bool, device=contact.device)
    return ~cloud.on_target[contact]


def _outside_cone(cloud: PreparedCloud, z: Tensor, query: GraspQuery) -> Tensor:
    if query.approach is None:
        return torch.zeros(len(z), dtype=torch.bool, device=z.device)
    direction = cloud.T_cloud_canonical.inverse().rotate(query.approach.direction)
    wanted = torch.tensor(direction, dtype=z.dtype, device=z.device)
    return z @ wanted < math.cos(math.radians(query.approach.max_angle_deg)) - 1e-6
