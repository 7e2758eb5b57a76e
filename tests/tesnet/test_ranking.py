from __future__ import annotations

import math

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from tesnet.ranking import Ranking, rank

HALF_TURN = Rotation.from_euler("z", 180, degrees=True)


def stack(rotations: Rotation, translations: np.ndarray) -> Tensor:
    Ts = np.tile(np.eye(4), (len(translations), 1, 1))
    Ts[:, :3, :3] = rotations.as_matrix()
    Ts[:, :3, 3] = translations
    return torch.from_numpy(Ts)


@st.composite
def scored_grasps(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Grasps in clusters, so that many are near-duplicates; half of them turned by half a turn; scores with ties."""
    count, seed = draw(st.integers(0, 120)), draw(st.integers(0, 2**31))
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 5, count)
    translations = rng.uniform(-0.2, 0.2, (5, 3))[centres] + rng.normal(0, 0.006, (count, 3))
    if count == 0:
        return torch.zeros(0), torch.zeros(0, 4, 4)
    rotations = Rotation.random(5, rng=rng)[centres] * Rotation.from_rotvec(rng.normal(0, 0.15, (count, 3)))
    turned = rng.random(count) < 0.5
    rotations = Rotation.concatenate([r * HALF_TURN if t else r for r, t in zip(rotations, turned, strict=True)])
    scores = np.round(rng.random(count), draw(st.integers(1, 6)))
    return torch.from_numpy(scores).float(), stack(rotations, translations)


def default_rank(
    scores: Tensor,
    Ts: Tensor,
    max_grasps: int = 10,
    min_score: float = 0.0,
    translation: float = 0.01,
    rotation_deg: float = 15.0,
) -> Ranking:
    return rank(
        scores,
        Ts,
        max_grasps=max_grasps,
        min_score=min_score,
        separation_translation=translation,
        separation_rotation_deg=rotation_deg,
    )


def same_pairs(Ts: Tensor, translation: float, rotation_deg: float) -> np.ndarray:
    """Brute-force twin of the rule for all pairs (C, C), with SciPy's angles."""
    count = len(Ts)
    if count == 0:
        return np.zeros((0, 0), dtype=bool)
    positions, rotations = Ts[:, :3, 3].numpy(), Rotation.from_matrix(Ts[:, :3, :3].numpy())
    first, second = np.divmod(np.arange(count**2), count)
    turns = rotations[first].inv() * rotations[second]
    angles = np.minimum(turns.magnitude(), (turns * HALF_TURN).magnitude())
    near = np.linalg.norm(positions[first] - positions[second], axis=1) < translation
    pairs: np.ndarray = (near & (angles <= math.radians(rotation_deg))).reshape(count, count)
    return pairs


@given(grasps=scored_grasps(), max_grasps=st.integers(1, 30), min_score=st.sampled_from([0.0, 0.3, 0.5, 1.0]))
@settings(max_examples=40, deadline=None)
def test_ranking_equals_the_brute_force_twin(grasps: tuple[Tensor, Tensor], max_grasps: int, min_score: float) -> None:
    scores, Ts = grasps
    same = same_pairs(Ts, translation=0.01, rotation_deg=15.0)
    passing = [i for i in range(len(scores)) if scores[i] >= min_score]
    order = sorted(passing, key=lambda i: (-float(scores[i]), i))
    taken: list[int] = []
    for i in order:
        if len(taken) < max_grasps and not same[taken, i].any():
            taken.append(i)
    duplicates = sum(i not in taken and bool(same[taken, i].any()) for i in order)

    ranking = default_rank(scores, Ts, max_grasps, min_score)

    assert ranking.indices.tolist() == taken
    assert ranking.below_min_score == len(scores) - len(passing)
    assert ranking.duplicates == duplicates


@given(grasps=scored_grasps())
@settings(max_examples=25, deadline=None)
def test_every_candidate_is_returned_or_counted_when_nothing_is_cut_off(grasps: tuple[Tensor, Tensor]) -> None:
    ranking = default_rank(*grasps, max_grasps=1000, min_score=0.4)
    assert len(ranking.indices) + ranking.below_min_score + ranking.duplicates == len(grasps[0])


@given(grasps=scored_grasps(), few=st.integers(1, 10), more=st.integers(0, 20))
@settings(max_examples=25, deadline=None)
def test_asking_for_fewer_returns_the_first_of_the_more(grasps: tuple[Tensor, Tensor], few: int, more: int) -> None:
    short, long = (default_rank(*grasps, max_grasps=n).indices.tolist() for n in (few, few + more))
    assert short == long[:few]


@given(grasps=scored_grasps(), seed=st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_the_order_of_candidates_with_distinct_scores_does_not_matter(grasps: tuple[Tensor, Tensor], seed: int) -> None:
    _, Ts = grasps
    scores = torch.randperm(len(Ts), generator=torch.Generator().manual_seed(seed)).float()
    order = torch.randperm(len(Ts), generator=torch.Generator().manual_seed(seed + 1))
    ranking, shuffled = default_rank(scores, Ts), default_rank(scores[order], Ts[order])
    assert order[shuffled.indices].tolist() == ranking.indices.tolist()
    assert shuffled.duplicates == ranking.duplicates


@given(grasps=scored_grasps(), seed=st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_ranking_does_not_change_when_the_cloud_is_moved(grasps: tuple[Tensor, Tensor], seed: int) -> None:
    scores, Ts = grasps
    rng = np.random.default_rng(seed)
    T = stack(Rotation.random(1, rng=rng), rng.uniform(-2, 2, (1, 3)))[0]
    assert default_rank(scores, T.to(Ts.dtype) @ Ts).indices.tolist() == default_rank(scores, Ts).indices.tolist()


def grasp_pair(offset: float, turn_deg: float, axis: str) -> Tensor:
    """A grasp and another, `offset` metres away and turned about an axis of its own."""
    first = Rotation.from_euler("xyz", [0.3, -1.1, 2.0])
    rotations = Rotation.concatenate([first, first * Rotation.from_euler(axis, turn_deg, degrees=True)])
    return stack(rotations, np.array([[0.1, 0.2, 0.3], [0.1 + offset, 0.2, 0.3]]))


def count_of_two(T: Tensor, translation: float = 0.01, rotation_deg: float = 15.0) -> int:
    return len(default_rank(torch.tensor([0.9, 0.8]), T, 10, 0.0, translation, rotation_deg).indices)


def test_half_a_turn_about_the_approach_axis_is_the_same_grasp() -> None:
    assert count_of_two(grasp_pair(0.0, 180, "z")) == 1
    assert count_of_two(grasp_pair(0.0, 170, "z")) == 1


def test_half_a_turn_about_another_axis_is_another_grasp() -> None:
    assert count_of_two(grasp_pair(0.0, 180, "x")) == 2
    assert count_of_two(grasp_pair(0.0, 180, "y")) == 2


def test_grasps_are_the_same_only_when_both_near_and_aligned() -> None:
    assert count_of_two(grasp_pair(0.009, 14, "x")) == 1
    assert count_of_two(grasp_pair(0.011, 14, "x")) == 2
    assert count_of_two(grasp_pair(0.009, 16, "x")) == 2


def test_a_separation_of_no_length_suppresses_nothing() -> None:
    assert count_of_two(grasp_pair(0.0, 0, "z"), translation=0.0) == 2


def test_a_separation_of_180_degrees_leaves_the_translation_to_decide() -> None:
    assert count_of_two(grasp_pair(0.009, 180, "x"), rotation_deg=180.0) == 1
    assert count_of_two(grasp_pair(0.011, 180, "x"), rotation_deg=180.0) == 2


def test_equal_scores_rank_by_index() -> None:
    Ts = stack(Rotation.identity(50), np.arange(150.0).reshape(50, 3))
    assert default_rank(torch.full((50,), 0.5), Ts, max_grasps=50).indices.tolist() == list(range(50))


def test_a_score_equal_to_the_threshold_passes() -> None:
    Ts = stack(Rotation.identity(3), np.arange(9.0).reshape(3, 3))
    ranking = default_rank(torch.tensor([0.25, 0.5, 0.75]), Ts, min_score=0.5)
    assert ranking.indices.tolist() == [2, 1]
    assert ranking.below_min_score == 1


def test_no_candidates_make_an_empty_ranking() -> None:
    ranking = default_rank(torch.zeros(0), torch.zeros(0, 4, 4))
    assert ranking.indices.tolist() == []
    assert ranking.indices.dtype == torch.int64
    assert (ranking.below_min_score, ranking.duplicates) == (0, 0)


def test_arguments_are_left_as_they_were() -> None:
    scores = torch.tensor([0.2, 0.9], dtype=torch.float64)
    Ts = grasp_pair(0.0, 0, "z")
    before = scores.clone(), Ts.clone()
    default_rank(scores, Ts)
    assert torch.equal(scores, before[0])
    assert torch.equal(Ts, before[1])
