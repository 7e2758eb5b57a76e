"""How wide the hand opens for each candidate, and where it stands between the walls that its fingers close on.

A pair of points tells the wall of one finger, and of the other only that it lies beyond the approach point. What else
was seen between the fingers tells more: how far the thing reaches, and how its surface turns away. Where hands stand by
what is learned (`tesnet.centring`), these rules tell widths alone. Knows no request. Vectorised torch; lengths in
metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from tesnet import centring
from tesnet.candidates import (
    CandidateConfig,
    Candidates,
    at_rest,
    between_palm_and_tips,
    clear_of_support,
    contact_places,
)
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Gripper
from tesnet.outline import MOST_LEAN, is_low

MARGIN = 0.008
"""Between each finger and the wall that it closes on, where that is seen."""

UNSEEN_MARGIN = 0.014
"""The same for a wall that is not seen."""

_BIN = 0.002
_GAP = 0.016
"""Between points this far apart a finger fits: what lies beyond is another thing."""

_FACING = 0.85
"""A wall is seen where the cosine of a normal with the direction that it would face is more."""

_NEAR_END = 0.006
"""The wall of a finger is sought this near to the end of what is seen."""

_TURNING = 0.12
"""A surface whose normals at its end lean so far towards the far side goes on; a face that ends level does not."""

_LEAST_SPREAD = 0.02
"""Of the normals' components along the closing direction, as a variance: less, and they tell of no curve."""

_FEWEST = 6

_NEARLY_FULL = 0.9
"""Of the opening: what fills more of it leaves fingers so little room that it must be measured where it can be."""

_FARTHEST_UNSEEN = 0.02
"""No wall is taken to lie farther beyond what is seen."""


@dataclass(frozen=True, eq=False, slots=True)
class Span:
    """What lies between the fingers of each of C candidates, along the closing direction from the hand's middle.

    Args:
        near, far: (C,) of the contact point's wall, and of the opposite one: near is more than far.
        seen: (C,) whether the opposite wall was seen.
    """

    near: Tensor
    far: Tensor
    seen: Tensor

    def select(self, which: Tensor) -> Span:
        """The spans where the mask (C,) is true."""
        return Span(self.near[which], self.far[which], self.seen[which])


def fitted(
    cloud: PreparedCloud,
    candidates: Candidates,
    config: CandidateConfig,
    *,
    policy: Literal["fitted", "full"] = "full",
) -> Candidates:
    """The candidates, midway between their walls where the configuration says so, the hand as wide as the policy says.

    `fitted` is what lies between the fingers and a margin beside each, `full` all that the hand opens. A hand whose
    tips swing forward stands where they come to rest on the walls. One that would come too low midway stops short;
    where that does not help it stays where it is, as wide as the policy says if that is clear of the support.
    """
    asked = policy == "fitted"
    if len(candidates) == 0 or not (asked or config.centred):
        return candidates
    resting = at_rest(cloud, candidates)
    near = contact_places(cloud, resting)
    span = spans(cloud, resting) if asked or config.centring is None else None
    ways = [torch.zeros_like(near)] if asked else []
    if config.centred:
        ways.append(_to_middle(cloud, resting, span, config.centring))
    placed = candidates
    for shift in ways:  # the last that is clear of the support counts
        moved, low = clear_of_support(cloud, _moved(candidates, near, shift, span if asked else None), config)
        poses, widths = moved.Ts_canonical_grasp, moved.widths
        poses = torch.where(low[:, None, None], placed.Ts_canonical_grasp, poses)
        placed = replace(placed, Ts_canonical_grasp=poses, widths=torch.where(low, placed.widths, widths))
    return placed


def _to_middle(cloud: PreparedCloud, resting: Candidates, span: Span | None, learned: str | None) -> Tensor:
    """(C,) how far each hand moves along its closing direction to stand between its walls.

    Of low things all sides show, so there the rules tell it best whatever was learned; and of things that nearly fill
    the hand where the camera saw both ends.

    Args:
        cloud: what was seen.
        resting: the candidates, their tips where they rest.
        span: what lies between the fingers of all; None where it is known of none.
        learned: version of what has learned it; None for the rules alone.
    """

    def spans_of(rows: Tensor) -> Span:
        return spans(cloud, resting.select(rows)) if span is None else span.select(rows)

    if learned is None:
        by_rules = torch.ones_like(resting.approach, dtype=torch.bool)
        shift = resting.widths.new_zeros(len(resting))
    else:
        seen = centring.seen_between(cloud, resting)
        by_rules = is_low(cloud)[resting.contact]
        full = centring.reaches(seen, _NEARLY_FULL) & ~by_rules
        by_rules[full] = _nearly_fills(cloud, resting.select(full), spans_of(full))
        shift = centring.shipped(learned, resting.widths.device).shifts(seen, cloud, resting)
    if bool(by_rules.any()):
        rules = spans_of(by_rules)
        shift[by_rules] = (rules.near + rules.far) / 2
    return shift


def _nearly_fills(cloud: PreparedCloud, resting: Candidates, span: Span) -> Tensor:
    """Mask (C,) of hands that hardly pass beside what they close on, whose far end the camera saw, or the place beside.

    Args:
        cloud: what was seen.
        resting: the candidates, their tips where they rest.
        span: what lies between the fingers of each.
    """
    extent, opening = span.near - span.far, resting.gripper.max_width
    sight = (cloud.view_directions[resting.approach][:, None] @ resting.Ts_canonical_grasp[:, :3, :3])[:, 0]
    sees_past = sight[:, 1] <= MOST_LEAN * -sight[:, 2]
    return (extent > _NEARLY_FULL * opening) & (extent <= opening) & (span.seen | sees_past)


def reach_of_fitting(
    cloud: PreparedCloud, candidates: Candidates, config: CandidateConfig
) -> tuple[Tensor, Tensor, float]:
    """How far `fitted` moves each hand along its closing direction, least and most (C,); how far along its travel.

    The least is zero or less. Of moves along the travel these are those of tips that swing; that hands may also stop
    short, which clears the palm of hardly any, is left out: to look for the walls of all that it might costs a tenth.
    """
    near, hand = contact_places(cloud, candidates), candidates.gripper
    rise = 2 * hand.travel
    if not config.centred:
        return torch.zeros_like(near), torch.zeros_like(near), rise
    first, last = -(hand.max_width + _FARTHEST_UNSEEN) / 2, 0.0
    if config.centring is not None:
        first, last = (float(place) * centring.place_unit(hand) for place in centring.PLACES[[0, -1]])
    return (near + first).clamp(max=0.0), (near + last).clamp(min=0.0), rise


def _moved(candidates: Candidates, near: Tensor, shift: Tensor, span: Span | None) -> Candidates:
    """The candidates, moved (C,) along their closing direction, and opened by what a span tells that they will hold."""
    hand, widths = candidates.gripper, candidates.widths
    if span is not None:
        beside = ((span.near + span.far) / 2 - shift).abs()
        extent = (span.near - span.far + 2 * beside).clamp(0.0, hand.max_width)
        margin = torch.where(span.seen, MARGIN, UNSEEN_MARGIN)
        widths = (extent + 2 * margin).clamp(max=hand.max_width)
    poses = candidates.Ts_canonical_grasp.clone()
    poses[:, :3, 3] += shift[:, None] * poses[:, :3, 1]
    if hand.linkage_length is not None:
        before, after = (2 * half.clamp(0.0, hand.max_width / 2) for half in (near, near - shift))
        rise = hand.tcp_at(widths) - hand.tcp_at(candidates.widths) - (hand.tcp_at(after) - hand.tcp_at(before))
        poses[:, :3, 3] += rise[:, None] * poses[:, :3, 2]
    return replace(candidates, Ts_canonical_grasp=poses, widths=widths)


def spans(cloud: PreparedCloud, candidates: Candidates) -> Span:
    """Where the walls lie that the hand will close on.

    The near one is that of the contact point. From there what was seen between the fingers is followed until a gap in
    which a finger fits. The far wall is where that ends, unless the surface only begins to turn away there: of a circle
    y = m + r n holds for the places y and the components n of the normals along the closing direction, with m its
    middle and r its radius, so the line through them tells where it ends. That counts where it is beyond what was seen.
    """
    hand, near = candidates.gripper, contact_places(cloud, candidates)
    row, y, n = _between_fingers(cloud, candidates, near)
    end = _last_before_gap(row, near[row] - y, len(near), hand)
    own = near[row] - y <= end[row] + _BIN
    row, y, n = row[own], y[own], n[own]
    last = near.clone().scatter_reduce(0, row, y, "amin")
    at_end = y <= last[row] + _NEAR_END
    lean = torch.zeros_like(near).scatter_reduce(0, row[at_end], n[at_end], "mean", include_self=False)
    seen = torch.zeros_like(near).scatter_reduce(0, row[at_end], n[at_end], "amin") < -_FACING
    guess = _by_curvature(row, y, n, len(near))
    goes_on = ~seen & (lean < -_TURNING) & guess.isfinite()
    beyond = torch.minimum(last, guess).clamp(min=last - _FARTHEST_UNSEEN)
    return Span(near, torch.where(goes_on, beyond, last), seen)


def _between_fingers(cloud: PreparedCloud, candidates: Candidates, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates (K,), places y (K,) and components of normals along y (K,) of the points between the fingers."""
    _, y, _, inside = between_palm_and_tips(cloud, candidates)
    inside &= (y <= near[:, None] + _BIN) & (y >= near[:, None] - candidates.gripper.max_width)
    row, index = inside.nonzero(as_tuple=True)
    return row, y[row, index], (cloud.normals[index] * candidates.Ts_canonical_grasp[row, :3, 1]).sum(dim=1)


def _last_before_gap(row: Tensor, depth: Tensor, count: int, hand: Gripper) -> Tensor:
    """(C,) how far from the near wall the points of each candidate go on without a gap in which a finger fits."""
    bins = int(hand.max_width / _BIN) + 2
    gap = int(_GAP / _BIN)
    occupied = torch.zeros(count, bins + gap, device=depth.device)
    occupied[row, (depth / _BIN).long().clamp(0, bins - 1)] = 1.0
    occupied[:, 0] = 1.0
    ahead = occupied.cumsum(dim=1)
    empty_ahead = ahead[:, gap:] - ahead[:, :-gap] == 0  # of each bin: none of the next `gap` bins is occupied
    first = (empty_ahead & (occupied[:, :-gap] > 0)).float().argmax(dim=1)
    return (first + 1) * _BIN


def _by_curvature(row: Tensor, y: Tensor, n: Tensor, count: int) -> Tensor:
    """(C,) m - r of the line y = m + r n through each candidate's points; NaN where they tell of none."""
    sums = torch.zeros(count, 5, dtype=y.dtype, device=y.device)
    sums.index_add_(0, row, torch.stack([torch.ones_like(y), y, n, y * n, n * n], dim=1))
    points = sums[:, 0].clamp(min=1)
    mean_y, mean_n, mean_yn, mean_nn = (sums[:, 1:] / points[:, None]).unbind(dim=1)
    variance = mean_nn - mean_n.square()
    slope = (mean_yn - mean_y * mean_n) / variance.clamp(min=1e-9)
    told = (sums[:, 0] >= _FEWEST) & (variance >= _LEAST_SPREAD) & (slope > 0)
    return torch.where(told, mean_y - slope * mean_n - slope, torch.nan)
