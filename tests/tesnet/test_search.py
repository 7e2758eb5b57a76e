from __future__ import annotations

import pytest
import torch

from tesnet.candidates import CandidateConfig, generate
from tesnet.collision import blocked
from tesnet.fitting import fitted
from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from tesnet.search import search
from tests.tesnet.scenes import WORKSPACE, prepared, tabletop_query


@pytest.mark.parametrize(
    "hand", [PANDA, HANDS["robotiq_2f85"].gripper, HANDS["rg2"].gripper], ids=["panda", "2f85", "rg2"]
)
@pytest.mark.parametrize("width", ["full", "fitted"])
@pytest.mark.parametrize("unseen", ["free", "occupied"])
def test_what_is_free_is_what_a_check_of_every_fitted_hand_leaves(hand: Gripper, width: str, unseen: str) -> None:
    query = tabletop_query(3, workspace=WORKSPACE, gripper=hand, width=width, unseen=unseen, max_candidates=600)
    cloud, config = prepared(query), CandidateConfig()
    found = search(cloud, query, config)
    every, rejected = generate(cloud, query, config)
    every = fitted(cloud, every, config, policy=query.opening_policy)
    free = ~blocked(cloud, every, query.unseen)
    assert 20 < int(free.sum()) < len(every)
    assert torch.equal(found.is_free, free)
    # The search fits fewer hands at a time; how a matrix product is rounded may depend on its size.
    for name in ("Ts_canonical_grasp", "widths"):
        one, other = (getattr(candidates, name)[free] for candidates in (found.candidates, every))
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0)
    assert found.rejected == rejected | {"collision": int((~free).sum())}


def test_hands_whose_palm_meets_something_are_not_fitted() -> None:
    query = tabletop_query(3, workspace=WORKSPACE)
    cloud, config = prepared(query), CandidateConfig()
    found, (every, _) = search(cloud, query, config), generate(cloud, query, config)
    moved = (found.candidates.Ts_canonical_grasp != every.Ts_canonical_grasp).flatten(1).any(dim=1)
    assert bool(moved[found.is_free].float().mean() > 0.9)
    assert bool(moved.float().mean() < 0.9)


def test_nothing_is_found_where_nothing_is_a_candidate() -> None:
    query = tabletop_query(3, workspace=WORKSPACE, max_candidates=1)
    cloud = prepared(query)
    found = search(cloud, query, CandidateConfig(min_depth=1.0, max_depth=0.5))
    assert len(found.candidates) == len(found.is_free) == 0
    assert found.rejected["collision"] == 0


def test_hands_go_by_rules_where_the_camera_s_pose_is_in_doubt() -> None:
    query = tabletop_query(max_candidates=200)
    learned, doubted, by_rules = (
        search(prepared(asked), asked, config).candidates.Ts_canonical_grasp
        for asked, config in (
            (query, CandidateConfig()),
            (query.but(calibrate=True), CandidateConfig()),
            (query, CandidateConfig(centring=None)),
        )
    )
    assert torch.equal(doubted, by_rules)
    assert not torch.equal(learned, by_rules)
