"""What candidates say together that are nearly the same grasp.

A network's errors differ from one candidate to the next, and the best of hundreds of scores is best also by its error;
nor does a hand arrive quite where it was sent. So each candidate's logit is averaged with those of the candidates about
it. Knows no network and no cloud. Vectorised torch; lengths in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tesnet.points import strips

_FARTHEST = 3.0
"""Of the kernel's standard deviations: candidates farther away are not looked at."""

_STRONGEST = 6.0
"""Others' logits count no more than this, either way: one of them shall not decide alone."""

_MOST = 4_000
"""Of more candidates so many, spread evenly over their order, are averaged over."""


@dataclass(frozen=True, slots=True)
class AgreementConfig:
    """How alike candidates are that are averaged; travels with the weights.

    Args:
        distance: of TCPs, standard deviation of the kernel.
        angle_deg: between hands, likewise.
        share: of the average in the result; the rest is the candidate's own.
    """

    distance: float = 0.008
    angle_deg: float = 20.0
    share: float = 0.5

    @classmethod
    def stored(cls, section: Mapping[str, Any] | None) -> AgreementConfig | None:
        """That of a weights file's header; networks whose header has none are taken at their word."""
        return None if section is None else cls(**section)


def agreed(
    logits: Tensor, poses: Tensor, config: AgreementConfig, between: Callable[[], None] = lambda: None
) -> Tensor:
    """The logits (C,), each between itself and the average over it and the candidates about it.

    In the average a candidate weighs 1 for itself and another one exp(-(d^2 / distance^2 + t^2 / angle^2) / 2), where d
    is the distance of their TCPs and t^2 = 2 - 2 cos(turn) from hand to hand, a parallel hand turned by half a turn
    about z being the same.

    Args:
        logits: (C,).
        poses: (C, 4, 4) TCP poses.
        config: how alike.
        between: called between blocks of work of some milliseconds.
    """
    if len(logits) < 2:
        return logits
    places, axes = poses[:, :3, 3], poses[:, :3, :3]
    some = torch.arange(0, len(logits), math.ceil(len(logits) / _MOST), device=logits.device)
    strongest = logits.clamp(-_STRONGEST, _STRONGEST)
    total, weight = logits.clone(), torch.ones_like(logits)
    angle = math.radians(config.angle_deg)
    for rows, near in strips(places[some], places, _FARTHEST * config.distance, between):
        about = some[near]
        apart = torch.cdist(places[rows], places[about], compute_mode="donot_use_mm_for_euclid_dist") / config.distance
        x, y, z = (axes[rows, :, axis] @ axes[about, :, axis].T for axis in range(3))
        turn = (3.0 - (x + y).abs() - z) / angle**2  # 1 + 2 cos(turn) = |x + y| + z
        kernel = torch.exp((apart.square() + turn) / -2) * (apart <= _FARTHEST)
        kernel[rows[:, None] == about[None]] = 0.0
        total[rows] += kernel @ strongest[about]
        weight[rows] += kernel.sum(dim=1)
    return torch.lerp(logits, total / weight, config.share)
