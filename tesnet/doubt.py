"""Hands that keep away from what is seen, where that may stand elsewhere than it seems to.

Vectorised torch; lengths in metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.points import points_in_grasp_frames

LEAST_DOUBT, MOST_DOUBT = 0.001, 0.015
"""Metres: less is noise, and to keep away further than the latter would leave no grasp on most things."""

LOG_ODDS = 3.0
"""What a candidate loses whose fingers touch what is seen."""


def doubted(scores: Tensor, cloud: PreparedCloud, candidates: Candidates, doubt: float) -> Tensor:
    """Scores (C,) of candidates where what is seen may stand up to `doubt` metres elsewhere.

    The nearer the fingers are to what is seen, the more they lose; nothing where they are further away than that. A
    network knows no such doubt: it takes points to be where they are.
    """
    if doubt < LEAST_DOUBT:
        return scores
    near = distance_of_fingers(cloud, candidates) / min(doubt, MOST_DOUBT)
    odds = scores * torch.exp(LOG_ODDS * (near.clamp(max=1) - 1))
    lowered: Tensor = odds / (1 - scores + odds)
    return lowered


def distance_of_fingers(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C,) from the boxes about the open fingers to the nearest of the cloud's points; zero where one lies inside."""
    x, y, z = points_in_grasp_frames(cloud.points, candidates.Ts_canonical_grasp)
    finger = candidates.gripper.parts[0]
    half = candidates.widths[:, None] / 2
    outwards = y.abs() - half
    aside = (x.abs() - finger.breadth.full / 2).clamp(min=0)
    across = torch.maximum(-outwards, outwards - finger.thickness.full).clamp(min=0)
    along = torch.maximum(z - finger.front, finger.back - z).clamp(min=0)
    return (aside.square() + across.square() + along.square()).amin(dim=1).sqrt()
