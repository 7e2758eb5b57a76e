"""Labelled views without a simulator: real candidates of a made-up scene, called successes where they are shallow."""

from __future__ import annotations

from pathlib import Path

import torch

from simharness.sim.outcome_kinds import OUTCOME_KINDS
from tesnet import candidates
from tests.tesnet.scenes import WORKSPACE, prepared, tabletop_query
from training.views import LabelledView, save_scene


def labelled_view(seed: int = 0, count: int = 60, positives: int | None = None) -> LabelledView:
    """A view of `tabletop(seed)` with `count` labels, all of candidates that count as free of collision.

    Args:
        seed: of scene and sampling.
        count: labels.
        positives: so many are successes; a third unless given.
    """
    query = tabletop_query(seed, max_candidates=count, workspace=WORKSPACE)
    ready = prepared(query)
    found, _ = candidates.generate(ready, query, candidates.CandidateConfig())
    assert len(found) == count
    depth = (ready.points[found.contact] - ready.points[found.approach]).norm(dim=1)
    successes = depth.argsort()[: count // 3 if positives is None else positives]
    outcomes = torch.full((count,), OUTCOME_KINDS.index("approach"), dtype=torch.uint8)
    outcomes[successes] = OUTCOME_KINDS.index("success")
    return LabelledView(
        cloud=ready,
        poses=found.Ts_canonical_grasp,
        widths=found.widths,
        approach=found.approach,
        contact=found.contact,
        outcomes=outcomes,
        collision_free=torch.ones(count, dtype=torch.bool),
        scene="packed",
    )


def write(folder: Path, views: list[LabelledView]) -> Path:
    """The views, one scene file each, in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(views):
        save_scene(folder / f"scene_{number:07d}.npz", {"number": number}, [view])
    return folder
