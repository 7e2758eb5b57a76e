"""Targets and other hands: where candidates come from, and what fits between the fingers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet import candidates, cloud, collision
from tesnet.errors import InvalidQuery
from tesnet.geometry import PANDA, Box, Gripper, Pose
from tesnet.points import voxel_downsample
from tests.tesnet.scenes import ask, fresh_predictor, prepared, tabletop, tabletop_query

OBJECT = Box(np.array([-0.05, -0.05, 0.0]), np.array([0.05, 0.05, 0.2]))
"""Holds the object in the middle of the table, and nothing else."""


def inside(points: np.ndarray[Any, Any], box: Box = OBJECT) -> np.ndarray[Any, Any]:
    return np.asarray(((points >= box.minimum) & (points <= box.maximum)).all(axis=1))


def test_both_points_of_every_grasp_lie_in_the_target_s_box() -> None:
    predictor = fresh_predictor()
    found = predictor.predict(tabletop_query(target=OBJECT, max_grasps=100, max_candidates=300))
    assert len(found.grasps) > 10
    assert inside(found.grasps.approach_points).all()
    assert inside(found.grasps.contact_points).all()
    assert found.counts.prepared_points == len(prepared(tabletop_query()))


def test_a_mask_of_the_same_points_gives_grasps_on_the_same_object() -> None:
    query = tabletop_query(target=inside(tabletop(0)), max_grasps=100, max_candidates=300)
    found = fresh_predictor().predict(query)
    assert len(found.grasps) > 10
    grown = Box(OBJECT.minimum - 0.0045, OBJECT.maximum + 0.0045)
    assert inside(found.grasps.approach_points, grown).all()
    assert inside(found.grasps.contact_points, grown).all()


def test_the_rest_of_the_cloud_still_counts_for_collision() -> None:
    predictor = fresh_predictor()
    query = tabletop_query(target=OBJECT, max_candidates=1000)
    alone = replace(query, points=query.points[inside(query.points)], target=None)
    assert predictor.predict(query).counts.rejected["collision"] > predictor.predict(alone).counts.rejected["collision"]


def test_pairs_that_leave_the_target_are_counted() -> None:
    half = Box(np.array([-1.0, -1.0, -1.0]), np.array([0.0, 1.0, 1.0]))
    query = tabletop_query(target=half, max_candidates=20_000, num_approach_points=1024)
    ready = prepared(query, voxel_size=0.01)
    assert ready.on_target is not None
    found, rejected = candidates.generate(ready, query, candidates.CandidateConfig())
    assert rejected["target"] > 0
    assert bool(ready.on_target[found.approach].all())
    assert bool(ready.on_target[found.contact].all())


def test_everything_as_a_target_changes_nothing() -> None:
    predictor = fresh_predictor()
    everything = np.ones(len(tabletop(0)), dtype=bool)
    without, masked = (
        predictor.predict(tabletop_query(target=target, max_candidates=300)) for target in (None, everything)
    )
    np.testing.assert_array_equal(masked.grasps.Ts_cloud_grasp, without.grasps.Ts_cloud_grasp)
    assert masked.counts.rejected == without.counts.rejected


@pytest.mark.parametrize(
    ("target", "says"),
    [
        (np.zeros(40_000, dtype=bool), "target has 0 points"),
        (np.arange(40_000) == 700, "target has 1 points"),
        (Box(np.full(3, 5.0), np.full(3, 6.0)), "target holds none"),
    ],
)
def test_a_target_without_cells_has_no_candidates_and_a_warning(target: Any, says: str) -> None:
    points = tabletop(0)
    target = target[: len(points)] if isinstance(target, np.ndarray) else target
    found = fresh_predictor().predict(tabletop_query(target=target))
    assert (len(found.grasps), found.reason) == (0, "no_candidates")
    assert any(note.startswith(says) for note in found.warnings)


def test_a_cloud_that_is_too_large_is_cut_around_the_target() -> None:
    far = Box(np.array([0.05, 0.0, 0.0]), np.array([0.15, 0.1, 0.2]))
    ready = prepared(tabletop_query(target=far), max_points=300)
    assert len(ready) <= 300
    assert ready.on_target is not None
    assert float(ready.on_target.float().mean()) > 0.5


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 200))
def test_a_cell_is_on_target_when_half_of_its_points_are(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    table = np.column_stack([rng.uniform(0, 0.02, (count, 3)), rng.integers(0, 2, count)]).astype(np.float32)
    cells = voxel_downsample(torch.from_numpy(table), 0.005).numpy()
    keys = np.floor((table[:, :3] - table[:, :3].min(axis=0)) / np.float32(0.005) + 0.5).astype(int)
    _, cell = np.unique(keys, axis=0, return_inverse=True)
    shares = [table[cell.ravel() == index, 3].mean() for index in range(cell.max() + 1)]
    np.testing.assert_allclose(cells[:, 3], shares, atol=1e-6)


@pytest.mark.parametrize("target", [np.zeros(3, dtype=bool), np.zeros(4), "all", [0, 1]])
def test_a_target_that_is_no_mask_of_the_points_is_refused(target: Any) -> None:
    with pytest.raises(InvalidQuery, match=r"target: .*mask of the 4 points"):
        ask(np.zeros((4, 3)), target=target)


def test_the_hand_s_own_size_decides_width_and_collision() -> None:
    predictor = fresh_predictor()
    options: dict[str, Any] = {"max_candidates": 300, "max_grasps": 1000}
    panda = predictor.predict(tabletop_query(**options))
    narrow = predictor.predict(tabletop_query(gripper=PANDA.with_sizes({"max_width": 0.05}), **options))
    assert set(panda.grasps.widths) == {0.08}
    assert set(narrow.grasps.widths) == {0.05}
    assert any("gripper" in note for note in narrow.warnings)
    offsets = (narrow.grasps.contact_points - narrow.grasps.approach_points) * narrow.grasps.Ts_cloud_grasp[:, :3, 1]
    assert offsets.sum(axis=1).max() <= 0.025


def test_thinner_fingers_collide_less() -> None:
    query = tabletop_query(max_candidates=500)
    ready = prepared(query)
    poses = candidates.generate(ready, query, candidates.CandidateConfig())[0].Ts_canonical_grasp
    thin = PANDA.with_sizes({"finger_thickness": 0.006, "finger_breadth": 0.01})
    slim, panda = (collision.in_collision(ready.points, poses, hand, 0.08, 0.05) for hand in (thin, PANDA))
    assert not bool((slim & ~panda).any())
    assert int(slim.sum()) < int(panda.sum())


def test_a_larger_palm_comes_nearer_to_the_support() -> None:
    palms = [
        PANDA,
        PANDA.with_sizes({"palm_length": 0.3}),
        PANDA.with_sizes({"palm_length": 0.3, "palm_depth": 0.2}),
    ]
    rejected = []
    for gripper in palms:
        query = tabletop_query(gripper=gripper, max_candidates=20_000, num_approach_points=1024)
        ready = prepared(query, voxel_size=0.01)
        rejected.append(candidates.generate(ready, query, candidates.CandidateConfig())[1]["support"])
    assert rejected == sorted(rejected)
    assert rejected[0] < rejected[-1]


@pytest.mark.parametrize(
    ("gripper", "words"),
    [
        (Gripper(max_width=0.161), r"0\.161 m \(limit 0\.16 m\); give"),
        ("panda", "of type str"),
        (None, "of type NoneType"),
    ],
)
def test_what_is_no_hand_or_opens_too_wide_is_refused(gripper: Any, words: str) -> None:
    with pytest.raises(InvalidQuery, match=f"gripper: .*{words}"):
        ask(np.zeros((4, 3)), gripper=gripper)


def test_a_cell_with_as_many_target_points_as_others_is_on_the_target() -> None:
    table = torch.tensor([[0.0, 0.0, 0.0, share] for share in (0.0, 0.49, 0.5, 0.51, 1.0)])
    query = ask(np.zeros((5, 3)), target=np.ones(5, dtype=bool))
    found = cloud._on_target(query, table, Pose.identity())
    assert found is not None
    assert found.tolist() == [False, False, True, True, True]
