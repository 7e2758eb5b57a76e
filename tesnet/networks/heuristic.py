"""What a learned scorer must beat: antipodal quality and verticality. Has no weights and learns nothing.

A grasp is good where the surfaces that the fingers close on face them, and where the hand comes from above. Both are
known in the grasp frame, so scores are invariant under rigid motions by construction.
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
from tesnet.networks.closing import Box, Members, members_of, seen_from_hand

REGION = Box(
    breadth=PANDA.finger_breadth / 2,
    length=PANDA.max_width / 2,
    behind=-PANDA.palm_front,
    ahead=PANDA.tip_offset,
)
"""What the pads sweep when they close."""


@dataclass(frozen=True, slots=True)
class HeuristicConfig:
    """How the two qualities, each from 0 to 1, become a logit. Chosen, not fitted.

    Args:
        antipodal, vertical: logit that the best of each adds to the worst.
        pad_reach: points this near to the first that a pad meets count as met, metres.
    """

    antipodal: float = 4.0
    vertical: float = 2.0
    pad_reach: float = 0.004


class Heuristic(nn.Module):
    """Scores candidates by geometry alone."""

    preparation: ClassVar[PreparationConfig] = PreparationConfig()
    scored_at_once: ClassVar[int] = 2_500
    knows_hands: ClassVar[bool] = False

    def __init__(self, config: HeuristicConfig) -> None:
        super().__init__()
        self.config = config

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[None]:
        """Nothing: a cloud as a whole has no features."""
        return [None] * len(clouds)

    def score(
        self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,), zero where both qualities are one half. They are the same in the mirror."""
        antipodal = antipodal_quality(cloud, candidates.Ts_canonical_grasp, self.config.pad_reach)
        vertical = verticality(cloud, candidates)
        return self.config.antipodal * (antipodal - 0.5) + self.config.vertical * (vertical - 0.5)


def antipodal_quality(cloud: PreparedCloud, poses: Tensor, pad_reach: float) -> Tensor:
    """(C,) how squarely the surfaces that the two pads meet first face them: mean cosine of both sides, 0 to 1.

    A side that faces away from its pad, as where the camera saw one side only, counts 0.
    """
    members = members_of(cloud.points, poses, REGION)
    positions, normals = seen_from_hand(cloud, poses, None, members.row, members.point)
    y, facing = positions[:, 1], normals[:, 1]
    sides = [_met_by_pad(members, sign * y, sign * facing, pad_reach) for sign in (1, -1)]
    return torch.stack(sides).mean(dim=0)


def _met_by_pad(members: Members, outward: Tensor, facing: Tensor, pad_reach: float) -> Tensor:
    """(C,) mean of `facing` (K,), at least 0, of the members that lie farthest `outward` (K,) in each box."""
    count = len(members.total)
    farthest = torch.full((count,), -torch.inf, device=outward.device)
    farthest = farthest.scatter_reduce(0, members.row, outward, "amax")
    met = outward >= farthest[members.row] - pad_reach
    sums = torch.zeros(count, 2, device=outward.device)
    sums.index_add_(0, members.row[met], torch.stack([facing, torch.ones_like(facing)], dim=1)[met])
    return (sums[:, 0] / sums[:, 1].clamp(min=1)).clamp(min=0)


def verticality(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C,) from 0 for a hand that travels up to 1 for one that travels down; where up is unknown, along the sight."""
    travel = candidates.Ts_canonical_grasp[:, :3, 2]
    against = cloud.view_directions[candidates.approach] if cloud.up is None else cloud.up.expand_as(travel)
    return (1 - (travel * against).sum(dim=1)) / 2
