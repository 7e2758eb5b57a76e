"""What a rigid motion, or another order of the points, changes in an answer: nothing that matters."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tesnet import candidates, weights
from tesnet.geometry import Pose
from tesnet.networks import Network, encode
from tesnet.networks.tesnet import TesNetConfig
from tesnet.patches import group
from tesnet.predictor import GraspPredictor
from tests.tesnet.scenes import (
    CAMERA,
    ask,
    fresh_network,
    fresh_predictor,
    moved_cloud,
    moved_query,
    prepared,
    tabletop,
    tabletop_query,
)

# float32 coordinates, moved by up to half a metre, are exact to 6e-8 m; a normal turns by 1e-7. A point on the edge of
# the region that a candidate looks at may therefore enter or leave it, and a probe on the edge of what the camera saw
# may become unseen: that moves the logits of a few candidates more than rounding does.
LOGIT_TOLERANCE = 1e-3
SHARE_AT_AN_EDGE = 0.02
PATCH = TesNetConfig().patch_size
LEAST_AGREEMENT = 0.97
"""Correlation of the logits, where other patches are looked at."""
POSE_TOLERANCE = 3e-5
"""Of a rotation's entries and of metres; the axis of a grasp of 3 mm depth is the least exact number."""


@functools.cache
def predictor(which: str) -> GraspPredictor:
    return GraspPredictor.load(weights.default_weights()) if which == "shipped" else fresh_predictor()


def network(which: str) -> Network:
    return predictor(which)._network if which == "shipped" else fresh_network()


@pytest.mark.parametrize("which", ["untrained", "shipped"])
@given(seed=st.integers(0, 2**31), scene=st.integers(0, 2), with_up=st.booleans())
@example(seed=727174, scene=2, with_up=True)  # a point crosses the border of a patch
@settings(max_examples=5, deadline=None)
def test_for_a_prepared_cloud_scores_are_invariant_and_grasps_equivariant(
    which: str, seed: int, scene: int, with_up: bool
) -> None:
    motion = Pose.random(np.random.default_rng(seed), reach=0.5)
    query = tabletop_query(scene) if with_up else ask(tabletop(scene), viewpoints=CAMERA)
    query = replace(query, max_candidates=20_000)  # none is left to chance
    still = prepared(query)
    moved = moved_cloud(still, motion)
    found, again = (candidates.generate(c, query, candidates.CandidateConfig())[0] for c in (still, moved))
    common = dict(
        zip(zip(found.approach.tolist(), found.contact.tolist(), strict=True), range(len(found)), strict=True)
    )
    pairs = list(zip(again.approach.tolist(), again.contact.tolist(), strict=True))
    rows = [(common[pair], row) for row, pair in enumerate(pairs) if pair in common]
    # A pair on the limit of a rule may drop out; where two points are equally far, other approach points follow.
    assert len(rows) >= 0.5 * len(found)
    rows = rows[:: max(1, len(rows) // 200)]
    first, second = (torch.tensor(column) for column in zip(*rows, strict=True))
    T_moved = motion.matrix @ found.Ts_canonical_grasp[first].double().numpy()
    np.testing.assert_allclose(again.Ts_canonical_grasp[second], T_moved, atol=POSE_TOLERANCE)

    with torch.inference_mode():
        scorer = network(which)
        before = scorer.score(encode(scorer, still), still, found.select(first))
        after = scorer.score(encode(scorer, moved), moved, again.select(second))
    if len(group(still, PATCH)) == len(group(moved, PATCH)):
        change = (before - after).abs()
        assert (change > LOGIT_TOLERANCE).float().mean() < SHARE_AT_AN_EDGE
    else:
        # A point that rounding takes over the border of a patch may make one more or one fewer. Which of many patches a
        # candidate looks at is a pseudo-random choice among all there are, and another one then: all scores move a bit.
        assert np.corrcoef(before, after)[0, 1] > LEAST_AGREEMENT


def test_end_to_end_the_top_score_hardly_moves_with_the_scene() -> None:
    rng = np.random.default_rng(0)
    changes, distances = [], []
    for scene in range(4):
        query = tabletop_query(scene)
        still = predictor("shipped").predict(query).grasps
        for _ in range(3):
            motion = Pose.random(rng, reach=0.5)
            moved = predictor("shipped").predict(moved_query(query, motion)).grasps
            changes.append(abs(float(still.scores[0] - moved.scores[0])))
            back = motion.inverse().apply(moved.Ts_cloud_grasp[0, :3, 3])
            distances.append(float(np.linalg.norm(back - still.Ts_cloud_grasp[0, :3, 3])))
    assert np.median(changes) < 0.05
    assert np.median(distances) < 0.005


@pytest.mark.parametrize("scene", range(2))
def test_the_order_of_the_points_does_not_matter(scene: int) -> None:
    """Cells are averaged in float64, so only the last bit of float32 may differ, and hardly ever does."""
    query = tabletop_query(scene)
    order = np.random.default_rng(scene).permutation(len(query.points))
    first = predictor("untrained").predict(query).grasps
    second = predictor("untrained").predict(replace(query, points=query.points[order])).grasps
    np.testing.assert_allclose(first.scores, second.scores, atol=1e-5)
    np.testing.assert_allclose(first.Ts_cloud_grasp, second.Ts_cloud_grasp, atol=1e-5)


def test_repeated_points_do_not_matter() -> None:
    query = tabletop_query()
    twice = replace(query, points=np.concatenate([query.points, query.points]))
    first, second = (predictor("untrained").predict(q).grasps for q in (query, twice))
    np.testing.assert_allclose(first.scores, second.scores, atol=1e-5)
    np.testing.assert_allclose(first.Ts_cloud_grasp, second.Ts_cloud_grasp, atol=1e-5)


def test_grasps_move_with_the_scene() -> None:
    """Each of the best is found again, with its score; near ties may change places."""
    query, every = tabletop_query(1), {"max_grasps": 1000, "separation_translation": 0.0}
    motion = Pose.from_quaternion([0.3, -0.5, 0.2, 0.7], [0.2, -0.1, 0.4])
    still = predictor("untrained").predict(query).grasps
    moved = predictor("untrained").predict(moved_query(query, motion).but(**every)).grasps
    pairs, others = (np.hstack([grasps.approach_points, grasps.contact_points]) for grasps in (still, moved))
    expected = np.hstack([motion.apply(part) for part in np.hsplit(pairs, 2)])
    distance, where = cKDTree(others).query(expected)
    assert distance.max() < 1e-5
    apart = np.linalg.inv(motion.matrix @ still.Ts_cloud_grasp) @ moved.Ts_cloud_grasp[where] - np.eye(4)
    aside = np.abs(apart[:, 1, 3])  # where a point enters another slice, the hand moves a little as it closes
    assert aside.max() < 0.002
    stays = aside < 1e-4
    assert np.mean(stays) > 0.7
    np.testing.assert_allclose(moved.scores[where], still.scores, atol=5e-3)
    np.testing.assert_allclose(moved.scores[where][stays], still.scores[stays], atol=1e-3)
    apart[:, 1, 3] = 0.0
    np.testing.assert_allclose(apart, 0.0, atol=1e-4)
