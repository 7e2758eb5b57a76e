"""The search for grasps in a cloud: candidates, each hand where it would stand, and those that meet nothing.

The predictor and the training's labels search alike. Vectorised torch; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tesnet.beside_target import closes_on_others
from tesnet.candidates import CandidateConfig, Candidates, generate
from tesnet.cloud import PreparedCloud
from tesnet.collision import blocked, palm_blocked
from tesnet.fitting import fitted, reach_of_fitting
from tesnet.geometry import Box
from tesnet.outline import Outline
from tesnet.query import GraspQuery

_FITTED_AT_ONCE = 250
"""Candidates whose walls are looked for at a time: a large hand has thousands of points between its fingers."""


@dataclass(frozen=True, eq=False, slots=True)
class Found:
    """What a search found.

    Args:
        candidates: C of them.
        is_free: (C,) whether the hand meets nothing. Hands whose palm meets something are not fitted.
        rejected: pairs or candidates dropped, by step.
    """

    candidates: Candidates
    is_free: Tensor
    rejected: dict[str, int]


def search(
    cloud: PreparedCloud,
    query: GraspQuery,
    config: CandidateConfig,
    edges: Callable[[], Outline] | None = None,
    between: Callable[[], None] = lambda: None,
) -> Found:
    """At most `max_candidates` candidates of a cloud, and which are free of collision.

    Where the camera's pose is in doubt, hands go by the rules whatever was learned: where it puts them, they fit into
    less room than a camera may be off.

    Args:
        cloud: where.
        query: what is asked.
        config: the limits.
        edges: finds the cloud's outline, for who searches one cloud several times.
        between: called between blocks of work of some tens of milliseconds.
    """
    between()
    config = replace(config, centring=None) if cloud.pose_in_doubt else config
    found, rejected = generate(cloud, query, config, edges, between)
    between()
    lost = palm_blocked(cloud.points, found, *reach_of_fitting(cloud, found, config), between)
    poses, widths = found.Ts_canonical_grasp.clone(), found.widths.clone()
    for rows in (~lost).nonzero()[:, 0].split(_FITTED_AT_ONCE):
        between()
        some = fitted(cloud, found.select(rows), config, policy=query.opening_policy)
        poses[rows], widths[rows] = some.Ts_canonical_grasp, some.widths
    found = replace(found, Ts_canonical_grasp=poses, widths=widths)
    is_free = ~lost
    is_free[~lost] = ~blocked(cloud, found.select(~lost), query.unseen, between)
    if cloud.on_target is not None and not isinstance(query.target, Box):
        alone = torch.ones_like(is_free)
        alone[is_free] = ~closes_on_others(cloud, found.select(is_free), between)
        rejected = rejected | {"target": rejected.get("target", 0) + int((~alone).sum())}
        found, is_free = found.select(alone), is_free[alone]
    return Found(found, is_free, rejected | {"collision": int((~is_free).sum())})
