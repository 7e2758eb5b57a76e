"""What two points with normals are to each other, whatever frame they are seen from."""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud

PAIR_FEATURES = 4

_LENGTH = 0.02
"""Metres that count as 1."""


def pair_features(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C, 4) of approach and contact point: distance, cosines of both normals with the offset and with each other.

    Source: Drost et al., Model Globally, Match Locally, CVPR 2010, section 3.2.
    """
    offset = cloud.points[candidates.contact] - cloud.points[candidates.approach]
    n_a, n_c = cloud.normals[candidates.approach], cloud.normals[candidates.contact]
    distance = offset.norm(dim=1)
    direction = offset / distance.clamp(min=1e-6)[:, None]
    cosines = [(n_a * direction).sum(1), (n_c * direction).sum(1), (n_a * n_c).sum(1)]
    return torch.stack([distance / _LENGTH, *cosines], dim=1)
