from __future__ import annotations

import functools
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bench import rooms
from tesnet import cloud, collision, networks, notices, weights
from tesnet import predictor as predictor_module
from tesnet.candidates import CandidateConfig, generate
from tesnet.errors import DeviceError, GaveUp, WeightsError
from tesnet.geometry import PANDA, Box
from tesnet.hands import HANDS
from tesnet.predictor import GraspPredictor, configuration_of
from tesnet.query import MAX_SEED, ApproachCone, GraspQuery
from tesnet.result import REJECTIONS, GraspResult
from tests.tesnet.scenes import (
    CAMERA,
    UP,
    WORKSPACE,
    Array,
    ask,
    fresh_network,
    fresh_predictor,
    open_hands,
    prepared,
    tabletop,
    tabletop_query,
)
from tests.tesnet.test_collision import depths

RNG = np.random.default_rng(0)
ALONG = np.linspace(-0.15, 0.15, 600)[:, None]
SHEET = RNG.uniform(-0.1, 0.1, (3000, 2))

STRANGE_CLOUDS: dict[str, Array] = {
    "empty": np.empty((0, 3)),
    "one point": np.zeros((1, 3)),
    "all points equal": np.full((500, 3), 0.3),
    "a line": ALONG * [1.0, 0, 0],
    "an upright line": ALONG * [0, 0, 1.0],
    "a slanted line": ALONG * [0.3, 0.5, 0.8],
    "a horizontal plane": np.column_stack([SHEET, np.zeros(3000)]),
    "an upright plane": np.column_stack([np.zeros(3000), SHEET]),
    "a blob": RNG.normal(0, 0.02, (2000, 3)),
    "dust": RNG.uniform(-0.5, 0.5, (3000, 3)),
    "two tables": np.vstack([tabletop(0), tabletop(1) + np.array([4.0, 0, 0])]),
    "outliers": np.vstack([tabletop(0), RNG.normal(0, 1e6, (100, 3))]),
    "extreme outliers": np.vstack([tabletop(0), [[3e38, -3e38, 3e38], [-3e38, 3e38, 0]]]),
    "far away": tabletop(0) + np.array([1e6, -1e6, 0]),
}


@functools.cache
def predictor() -> GraspPredictor:
    return fresh_predictor(calibration=(8.0, 0.5))


@functools.cache
def answer(**options: Any) -> GraspResult:
    return predictor().predict(tabletop_query(**options))


def assert_equal(one: GraspResult, other: GraspResult) -> None:
    np.testing.assert_array_equal(one.grasps.Ts_cloud_grasp, other.grasps.Ts_cloud_grasp)
    np.testing.assert_array_equal(one.grasps.scores, other.grasps.scores)
    assert one.counts == other.counts


def assert_sound(result: GraspResult, query: GraspQuery) -> None:
    """What holds for every answer."""
    counts = result.counts
    assert counts.points == len(query.points)
    assert set(counts.rejected) == set(REJECTIONS)
    assert all(count >= 0 for count in counts.rejected.values())
    assert counts.candidates - counts.rejected["collision"] == counts.collision_free
    kept = counts.collision_free - counts.rejected["min_score"] - counts.rejected["duplicates"]
    assert counts.returned <= kept
    assert counts.returned == len(result.grasps) <= query.max_grasps
    assert (counts.returned == min(kept, query.max_grasps)) or counts.returned == query.max_grasps
    assert (result.reason is None) == (counts.returned > 0)
    assert list(result.timings_ms) == ["prepare", "candidates", "network", "rank"]
    assert all(value >= 0 for value in result.timings_ms.values())
    scores = result.grasps.scores
    assert ((scores >= query.min_score) & (scores <= 1)).all()
    assert (np.diff(scores) <= 0).all()


# Limits


@pytest.mark.parametrize("seed", range(3))
def test_no_grasp_breaks_a_limit_of_the_conventions(seed: int) -> None:
    """Recomputed in float64 from what is returned; coordinates of the cloud are float32, hence a micrometre."""
    cone = ApproachCone(np.array([0.0, 0.3, -1.0]), 70.0)
    query = tabletop_query(seed, max_grasps=1000, separation_translation=0.0, approach=cone, workspace=WORKSPACE)
    result = predictor().predict(query)
    grasps = result.grasps
    assert len(grasps) > 50
    assert_sound(result, query)
    p_a, p_c, Ts = grasps.approach_points, grasps.contact_points, grasps.Ts_cloud_grasp
    x, y, z, tcp = (Ts[:, :3, column] for column in range(4))
    d = p_c - p_a
    offset = np.einsum("ij,ij->i", d, y)  # the closing direction is the contact point's normal
    depth = np.einsum("ij,ij->i", d, z)
    aside = np.abs(np.einsum("ij,ij->i", d, x))  # the hand's plane holds both points, but those of an outline
    assert (aside <= 0.005 + 2e-6).all()
    of_outline = aside > 2e-6
    assert of_outline.mean() < 0.02
    assert (np.linalg.norm(d, axis=1) <= 0.038 + 2e-6).all()
    assert ((depth >= np.where(of_outline, -0.003, 0.003) - 2e-6) & (depth <= 0.040 + 2e-6)).all()
    assert ((offset >= -0.003 - 2e-6) & (offset <= 0.038 + 2e-6)).all()
    middle = p_a + np.einsum("ij,ij->i", tcp - p_a, y)[:, None] * y  # midway between the walls
    short = np.einsum("ij,ij->i", middle + (depth - 0.0016)[:, None] * z - tcp, z)  # of the support
    np.testing.assert_allclose(tcp, middle + (depth - 0.0016 - short)[:, None] * z, atol=2e-6)
    assert ((short >= -2e-6) & (short <= 0.007 + 2e-6)).all()
    assert (short > 2e-6).mean() < 0.1
    assert (z @ UP < 0.1 + 1e-6).all()
    angles = np.degrees(np.arccos(np.clip(z @ cone.direction, -1, 1)))
    assert angles.max() <= 70.0 + 1e-3
    corners = np.einsum("cij,kj->cki", Ts[:, :3, :3], PANDA.corners(0.08)) + tcp[:, None]
    assert corners[:, :, 2].min() >= 0.0015 - 2e-6
    np.testing.assert_allclose(x, np.cross(y, z), atol=1e-6)
    assert (grasps.widths == 0.08).all()
    for points in (p_a, p_c):
        assert cKDTree(query.points).query(points)[0].max() < 0.0045
        assert ((points >= WORKSPACE.minimum) & (points <= WORKSPACE.maximum)).all()


def test_grasps_keep_their_distance_from_each_other() -> None:
    grasps = answer(max_grasps=100, separation_translation=0.02, separation_rotation_deg=180.0).grasps
    tcp = grasps.Ts_cloud_grasp[:, :3, 3]
    between = np.linalg.norm(tcp[:, None] - tcp[None], axis=2)[np.triu_indices(len(tcp), 1)]
    assert len(tcp) > 5
    assert between.min() >= 0.02 - 1e-6


def test_a_grasp_in_the_shadow_counts_as_a_collision_when_the_unseen_is_occupied() -> None:
    free, occupied = answer(), answer(unseen="occupied")
    assert occupied.counts.collision_free < free.counts.collision_free
    assert occupied.counts.candidates == free.counts.candidates
    assert_sound(occupied, tabletop_query(unseen="occupied"))


# Reasons


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        (ask(np.empty((0, 3))), "too_few_points"),
        (tabletop_query(workspace=Box(np.full(3, 3.0), np.full(3, 4.0))), "no_points_in_workspace"),
        (ask(tabletop(0), up=UP, support_height=1.0), "no_points_in_workspace"),
        (ask(np.zeros((1, 3))), "too_few_points"),
        (ask(np.full((500, 3), 0.2)), "too_few_points"),
        (ask(RNG.uniform(-1, 1, (60, 3))), "no_candidates"),
        (tabletop_query(approach=ApproachCone(UP, 30.0)), "no_candidates"),  # from below only
        (ask(RNG.uniform(-0.08, 0.08, (60_000, 3)), viewpoints=UP, max_candidates=50), "all_in_collision"),
        (tabletop_query(min_score=1.0), "below_min_score"),
    ],
)
def test_an_empty_answer_says_why(query: GraspQuery, reason: str) -> None:
    result = predictor().predict(query)
    assert result.reason == reason
    assert_sound(result, query)


@pytest.mark.parametrize("name", STRANGE_CLOUDS)
@pytest.mark.parametrize("options", [{}, {"up": UP, "support_height": -0.2}], ids=["bare", "with_up"])
def test_strange_clouds_have_a_sound_answer(name: str, options: dict[str, Any]) -> None:
    query = ask(STRANGE_CLOUDS[name], **options)
    assert_sound(predictor().predict(query), query)


@pytest.mark.slow
def test_a_million_points_all_over_a_room_are_answered_with_a_warning() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (1_000_000, 3)) * [8.0, 6.0, 3.0]
    query = ask(points, viewpoints=np.array([4.0, 3, 2.9]), up=UP)
    result = predictor().predict(query)
    assert_sound(result, query)
    assert result.counts.prepared_points <= 12_000
    assert any("the cloud is large" in note and "set workspace or target" in note for note in result.warnings)


# Warnings


def test_a_careful_query_has_no_warnings() -> None:
    assert answer().warnings == ()


@pytest.mark.parametrize(
    ("query", "says"),
    [
        (ask(tabletop(0), up=UP), "viewpoint not given"),
        (ask(tabletop(0), viewpoints=CAMERA), "up not given"),
        (tabletop_query(points=STRANGE_CLOUDS["outliers"]), "points farther than 10 m"),
        (tabletop_query(points=np.float32(tabletop(0) + np.array([1e5, 0, 0]))), "kept to 7.8 mm only: use"),
        (
            tabletop_query(points=(tabletop(0) + np.array([1e9, 0, 0])).astype(np.float32)),
            "kept to 6.4e+04 mm only: use",
        ),
    ],
)
def test_what_the_caller_should_know_is_a_warning(query: GraspQuery, says: str) -> None:
    assert [says in note for note in predictor().predict(query).warnings] == [True]


# Batches


def test_a_batch_has_the_answers_of_its_queries_one_by_one() -> None:
    """Scores to 1e-5: the rounding of a matrix product depends on its size. All else is equal to the bit."""
    nothing = GraspQuery(np.zeros((5, 3), np.float32))
    queries = [
        tabletop_query(),
        nothing,
        tabletop_query(1, max_grasps=50),
        replace(tabletop_query(2), points=tabletop_query(2).points[::3]),
    ]
    together = predictor().predict_batch(queries)
    for query, batched in zip(queries, together, strict=True):
        alone = predictor().predict(query)
        assert_sound(batched, query)
        assert batched.counts == alone.counts
        assert (batched.reason, batched.warnings) == (alone.reason, alone.warnings)
        np.testing.assert_array_equal(batched.grasps.Ts_cloud_grasp, alone.grasps.Ts_cloud_grasp)
        np.testing.assert_allclose(batched.grasps.scores, alone.grasps.scores, atol=1e-5)
    assert predictor().predict_batch([]) == []


def test_the_time_of_a_shared_pass_is_divided_by_prepared_points(monkeypatch: pytest.MonkeyPatch) -> None:
    queries = [tabletop_query(max_candidates=100), replace(tabletop_query(1), points=tabletop_query(1).points[::4])]
    proposals = [predictor()._propose(query, None) for query in queries]
    assert all(isinstance(one, predictor_module._Proposal) for one in proposals)
    clock = iter(range(10))  # seconds
    monkeypatch.setattr(predictor_module, "time", Mock(perf_counter=lambda: float(next(clock))))
    with torch.inference_mode():
        predictor()._encode(proposals)  # type: ignore[arg-type]
    told = [one.clock.laps_ms["network"] for one in proposals]  # type: ignore[union-attr]
    sizes = [len(one.prepared) for one in proposals]  # type: ignore[union-attr]
    assert sizes[0] > 1.3 * sizes[1]
    assert told == pytest.approx([1000 * size / sum(sizes) for size in sizes])


# Repetition


def test_equal_queries_have_equal_answers() -> None:
    first, second = (predictor().predict(tabletop_query()) for _ in range(2))
    assert_equal(first, second)


def test_another_seed_tries_other_candidates() -> None:
    other = predictor().predict(replace(tabletop_query(), seed=1))
    assert not np.array_equal(other.grasps.approach_points, answer().grasps.approach_points)


def test_an_answer_leaves_no_trace_in_the_predictor() -> None:
    fresh = fresh_predictor(calibration=(8.0, 0.5))
    fresh.warm_up()
    fresh.predict(tabletop_query(2))
    np.testing.assert_array_equal(fresh.predict(tabletop_query()).grasps.scores, answer().grasps.scores)


def test_a_prediction_that_nobody_waits_for_ends_wherever_it_is() -> None:
    asked = 0

    def count() -> bool:
        nonlocal asked
        asked += 1
        return False

    query = tabletop_query()
    whole = predictor().predict(query, count)
    assert asked >= 5
    for last in range(1, asked + 1):
        answers = iter([False] * (last - 1) + [True])
        with pytest.raises(GaveUp):
            predictor().predict(query, answers.__next__)
    assert_equal(predictor().predict(query), whole)


def test_one_query_of_a_batch_that_nobody_waits_for_ends_the_batch() -> None:
    queries = [tabletop_query(), tabletop_query(seed=1)]
    with pytest.raises(GaveUp):
        predictor().predict_batch(queries, [None, lambda: True])


def test_another_query_may_be_answered_while_one_is_asked_whether_to_go_on() -> None:
    other = tabletop_query(seed=3)
    between: list[GraspResult] = []

    def answer_another() -> bool:
        between.append(predictor().predict(other))
        return False

    assert_equal(predictor().predict(tabletop_query(), answer_another), predictor().predict(tabletop_query()))
    for result in between:
        assert_equal(result, between[0])
    assert_equal(between[0], predictor().predict(other))


def test_the_time_that_asking_whether_to_go_on_takes_is_no_stages() -> None:
    asked = [0.0]

    def go_on() -> bool:
        began = time.perf_counter()
        time.sleep(0.003)
        asked[0] += time.perf_counter() - began
        return False

    began = time.perf_counter()
    result = predictor().predict(tabletop_query(max_candidates=100), go_on)
    took = time.perf_counter() - began
    assert asked[0] > 0.02
    assert sum(result.timings_ms.values()) <= 1e3 * (took - asked[0])


def test_the_global_random_state_is_neither_read_nor_changed() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    result = predictor().predict(tabletop_query())
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(result.grasps.scores, answer().grasps.scores)


def test_scores_are_calibrated_logits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor_module, "FURTHER_SEARCHES", 0)  # low scores would begin one
    plain = fresh_predictor(calibration=(1.0, 0.0)).predict(tabletop_query()).grasps.scores
    logits = np.log(plain / (1 - plain))
    sharper = fresh_predictor(calibration=(8.0, 0.5)).predict(tabletop_query()).grasps.scores
    np.testing.assert_allclose(sharper, 1 / (1 + np.exp(-(8.0 * logits + 0.5))), atol=1e-5)


def test_other_candidates_are_searched_for_while_the_best_score_is_low(monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = fresh_predictor()
    query = tabletop_query(max_candidates=300)
    searches = []
    search = predictor._search

    def note(prepared: cloud.PreparedCloud, asked: GraspQuery, *others: Any) -> Any:
        found = search(prepared, asked, *others)
        searches.append((asked.num_approach_points, asked.seed, found.count))
        return found

    monkeypatch.setattr(predictor, "_search", note)
    best = predictor.predict(query)
    assert [count for count, _, _ in searches] == [32] + [128] * predictor_module.FURTHER_SEARCHES
    assert len({seed for _, seed, _ in searches}) == len(searches)
    assert best.counts.candidates == 300
    assert best.counts.collision_free + best.counts.rejected["collision"] == 300
    monkeypatch.setattr(predictor_module, "FURTHER_SEARCHES", 0)
    first = predictor.predict(query)
    assert best.grasps.scores[0] > first.grasps.scores[0]
    monkeypatch.setattr(predictor_module, "FURTHER_SEARCHES", 4)
    monkeypatch.setattr(predictor_module, "GOOD_SCORE", float(first.grasps.scores[0]))
    np.testing.assert_array_equal(predictor.predict(query).grasps.scores, first.grasps.scores)


# Loading


def test_a_saved_network_answers_like_the_one_in_memory(tmp_path: Path) -> None:
    network = fresh_network()
    header = weights.Header("tesnet", "3", configuration_of(network), (8.0, 0.5), {"seed": 7})
    weights.save(tmp_path / "a.safetensors", network.state_dict(), header)
    loaded = GraspPredictor.load(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(loaded.predict(tabletop_query()).grasps.scores, answer().grasps.scores)
    assert (loaded.model.name, loaded.model.version, loaded.model.card) == ("tesnet", "3", {"seed": 7})
    assert loaded.model.weights_sha256 == weights.sha256(tmp_path / "a.safetensors")
    assert set(loaded.model.configuration) == {"network", "preparation", "candidates"}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("vgn", {}),
        ("tesnet", {"network": {"depth": 3}}),
        ("tesnet", {"network": {"channels": 16}}),
        ("tesnet", {"network": {"channels": "wide"}}),
        ("tesnet", {"preparation": {"voxel": 1}}),
        ("tesnet", {"candidates": None}),
    ],
)
def test_weights_of_another_network_are_refused(tmp_path: Path, name: str, change: dict[str, Any]) -> None:
    network = fresh_network()
    configuration = configuration_of(network) | change
    weights.save(tmp_path / "a.safetensors", network.state_dict(), weights.Header(name, "0", configuration))
    with pytest.raises(WeightsError, match=r"a\.safetensors"):
        GraspPredictor.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("device", ["abacus", "meta", "cuda:99"])
def test_a_device_that_does_not_exist_is_refused(tmp_path: Path, device: str) -> None:
    with pytest.raises(DeviceError, match="choose"):
        GraspPredictor.load(tmp_path / "none.safetensors", device=device)


def test_the_number_of_threads_is_set_on_request(tmp_path: Path) -> None:
    """In a process of its own, since it is the whole process's number, which is set when a prediction begins."""
    network = fresh_network()
    weights.save(
        tmp_path / "a.safetensors",
        network.state_dict(),
        weights.Header("tesnet", "0", configuration_of(network)),
    )
    program = (
        "import sys, numpy, torch; from pathlib import Path; from tesnet.errors import GaveUp;"
        "from tesnet.predictor import GraspPredictor; from tesnet.query import GraspQuery\n"
        "predictor = GraspPredictor.load(Path(sys.argv[1]), num_threads=3)\n"
        "try: predictor.predict(GraspQuery(numpy.zeros((1, 3))), lambda: print(torch.get_num_threads()) or True)\n"
        "except GaveUp: pass"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.safetensors")], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "3"


def table_top(extent: float, pitch: float = 0.0045) -> Array:
    """A square of points with nothing on it, noisy by half a millimetre."""
    rng = np.random.default_rng(0)
    along = np.arange(-extent / 2, extent / 2, pitch)
    flat = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return np.column_stack([flat, rng.normal(0, 0.0005, len(flat))])


def tall_box() -> Array:
    """A box of 10 x 10 x 30 cm whose top and nearer sides were seen, and a table of 0.6 m."""
    rng = np.random.default_rng(0)
    sides = [
        np.column_stack([rng.uniform(-0.05, 0.05, (15_000, 1)), np.full(15_000, -0.05), rng.uniform(0, 0.3, 15_000)]),
        np.column_stack([np.full(15_000, 0.05), rng.uniform(-0.05, 0.05, (15_000, 1)), rng.uniform(0, 0.3, 15_000)]),
        np.column_stack([rng.uniform(-0.05, 0.05, (5_000, 2)), np.full(5_000, 0.3)]),
    ]
    return np.vstack([table_top(0.6), *sides]) + rng.normal(0, 0.0005, (sum(map(len, sides)) + len(table_top(0.6)), 3))


CUT = Box(np.array([-0.2, -0.2, 0.02]), np.array([0.2, 0.2, 0.1]))
"""Holds the foot of the tall box and cuts off what stands above it."""


@pytest.mark.parametrize(
    "query",
    [
        lambda: ask(table_top(0.7), viewpoints=[0, -0.4, 0.6]),
        lambda: ask(tall_box(), viewpoints=[0.4, -0.5, 0.6], workspace=CUT),
        lambda: ask(tall_box(), viewpoints=[0.4, -0.5, 0.6], up=UP, workspace=CUT, support_height=0.0),
        lambda: ask(tall_box(), viewpoints=[0.4, -0.5, 0.6], up=UP, support_height=0.0, max_grasps=1000),
    ],
    ids=["a table wider than the limit of cells", "cut by the workspace", "cut over a support", "whole"],
)
@pytest.mark.parametrize("limit", [12_000, 1500])
def test_no_returned_hand_holds_posted_points(query: Any, limit: int) -> None:
    asked = query()
    settings = configuration_of(fresh_network())
    settings["preparation"]["max_points"] = limit
    network = GraspPredictor(fresh_network().eval(), settings, (8.0, 0.5), predictor().model, torch.device("cpu"))
    result = network.predict(asked)
    for T in result.grasps.Ts_cloud_grasp:
        assert int((depths(asked.points.astype(np.float64), T, PANDA.max_width) > 0.004).sum()) < 10
    assert_sound(result, asked)


def test_what_the_workspace_hides_is_met_on_the_way() -> None:
    """The box's top stands over its foot; a hand that comes down over the foot would pass through it."""
    asked = ask(tall_box(), viewpoints=[0.4, -0.5, 0.6], up=UP, workspace=CUT, support_height=0.0)
    prepared = cloud.prepare(asked, predictor().preparation, torch.device("cpu"))
    assert prepared is not None
    assert prepared.unsought is not None
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = [0.0, 0.0, 0.15]
    hand = open_hands(torch.from_numpy((prepared.T_cloud_canonical.inverse().matrix @ down)[None]).float())
    assert collision.blocked(prepared, hand, "free").all()
    assert not collision.blocked(replace(prepared, unsought=None), hand, "free").any()


def test_points_that_stand_alone_and_the_supports_own_block_nothing() -> None:
    alone = np.array([[0.0, 0.0, z] for z in (0.16, 0.2)])
    box = tall_box()
    box = box[box[:, 2] < 0.1]
    asked = ask(np.vstack([box, alone]), viewpoints=[0.4, -0.5, 0.6], up=UP, workspace=CUT, support_height=0.0)
    prepared = cloud.prepare(asked, predictor().preparation, torch.device("cpu"))
    assert prepared is not None
    assert prepared.unsought is not None  # the lowest 2 cm of the box
    heights = prepared.T_cloud_canonical.apply(prepared.unsought.points.double().numpy())[:, 2]
    assert heights.min() > cloud.LEAST_SUPPORT_NOISE - 1e-6
    assert heights.max() < CUT.minimum[2] + 1e-6


def test_a_collision_check_can_be_left_in_its_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tesnet.collision._BLOCK", 1000)
    between = Mock(side_effect=[None, GaveUp])
    ready = cloud.prepare(tabletop_query(), predictor().preparation, torch.device("cpu"))
    assert ready is not None
    with pytest.raises(GaveUp):
        collision.blocked(ready, open_hands(torch.eye(4).expand(5000, 4, 4)), "free", between)


# Further searches


def noted_searches(predictor: GraspPredictor, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What each search of the predictor finds from now on."""
    found: list[Any] = []
    search = predictor._search

    def noted(*given: Any) -> Any:
        found.append(search(*given))
        return found[-1]

    monkeypatch.setattr(predictor, "_search", noted)
    return found


@pytest.mark.parametrize("best", range(5))
def test_the_search_with_the_best_score_is_answered_whichever_it_was(
    monkeypatch: pytest.MonkeyPatch, best: int
) -> None:
    predictor = fresh_predictor()
    found = noted_searches(predictor, monkeypatch)
    told: list[torch.Tensor] = []
    factors = [0.3, 0.5, 0.4, 0.6, 0.2]
    factors[best] = 0.8

    def scripted(features: Any, prepared: Any, searched: Any, clock: Any) -> torch.Tensor:
        told.append(torch.linspace(0.5, 1.0, len(searched.free)) * factors[len(told)])
        return told[-1]

    monkeypatch.setattr(predictor, "_scores", scripted)
    query = tabletop_query(max_candidates=60, max_grasps=1000, separation_translation=0.0)
    result = predictor.predict(query)
    assert len(told) == len(found) == 5
    assert result.grasps.scores[0] == pytest.approx(0.8)
    assert result.counts.candidates == found[best].count
    assert set(result.grasps.scores.astype(np.float32).tolist()) <= set(told[best].tolist())


@pytest.mark.parametrize(
    ("cone_deg", "most", "searches"),
    [
        (1.0, 6000, 1),  # fewer than half of what it may have: all approach points were tried
        (180.0, 300, 5),
        (180.0, 3000, 4),  # with the fourth it is 12,000, more than are scored in all
    ],
)
def test_no_further_search_follows_one_of_few_candidates_or_many_scored_ones(
    monkeypatch: pytest.MonkeyPatch, cone_deg: float, most: int, searches: int
) -> None:
    predictor = fresh_predictor()
    found = noted_searches(predictor, monkeypatch)
    monkeypatch.setattr(predictor, "_scores", lambda *given: torch.full((len(given[2].free),), 0.1))
    predictor.predict(tabletop_query(approach=ApproachCone(-UP, cone_deg), max_candidates=most))
    assert len(found[0].free) > 0
    assert (2 * found[0].count < most) == (searches == 1)
    assert len(found) == searches


def test_a_query_that_is_kept_about_another_origin_has_the_same_answer() -> None:
    """As far clouds are: what is given lies in the query's frame, what is answered in the caller's."""
    origin = np.array([0.5, -0.25, 1.0])
    query = tabletop_query(max_candidates=300)
    kept = replace(
        query,
        points=(query.points - origin).astype(np.float32),
        viewpoints=CAMERA - origin,
        support_height=-float(UP @ origin),
        origin=origin,
    )
    one, other = predictor().predict(query).grasps, predictor().predict(kept).grasps
    assert len(one) > 0
    for name, within in (
        ("Ts_cloud_grasp", 1e-4),
        ("approach_points", 1e-4),
        ("contact_points", 1e-4),
        ("scores", 1e-3),
    ):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=within)
    np.testing.assert_allclose(other.widths, one.widths, atol=1e-4)


def test_queries_whose_seeds_follow_each_other_share_no_search() -> None:
    asked = tabletop_query()
    for first in (0, 1000, MAX_SEED - 20):
        queries = [asked.but(seed=first + step) for step in range(20)]
        further = [
            predictor_module._further(query, number)
            for query in queries
            for number in range(1, predictor_module.FURTHER_SEARCHES + 1)
        ]
        seeds = [query.seed for query in (*queries, *further)]
        assert len(set(seeds)) == len(seeds)
        assert {query.num_approach_points for query in further} == {4 * 32}


@pytest.mark.parametrize("knows_hands", [True, False])
def test_another_hand_is_warned_of_where_the_network_does_not_know_it(knows_hands: bool) -> None:
    asked = {hand: tabletop_query().but(gripper=HANDS[hand].gripper) for hand in ("franka", "rg2")}
    warned = {
        hand: any("not the hand" in note for note in notices.of_query(query, knows_hands=knows_hands))
        for hand, query in asked.items()
    }
    assert warned == {"franka": False, "rg2": not knows_hands}


@pytest.mark.parametrize(("width", "warned"), [(0.012, True), (0.03, False)])
def test_a_hand_that_opens_less_than_any_in_training_is_warned_of(width: float, warned: bool) -> None:
    query = tabletop_query(gripper=PANDA.with_sizes({"max_width": width}))
    notes = notices.of_query(query, knows_hands=True)
    assert any(f"gripper opens {width:g} m, less than any" in note for note in notes) == warned


@pytest.mark.parametrize("told", [True, False])
def test_a_network_knows_hands_where_it_is_told_of_them(told: bool) -> None:
    assert networks.build("tesnet", {"told": told}).knows_hands == told


def face(half: tuple[float, float, float], count: int, seed: int = 0) -> NDArray[np.float64]:
    """Points (count, 3) of the three sides of a box that are seen from +x, +y, +z."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * half
    rows, side = np.arange(count), rng.integers(0, 3, count)
    points[rows, side] = np.array(half)[side]
    return points + rng.normal(0, 0.0003, points.shape)


@pytest.mark.parametrize("count", [6000, 200_000])
def test_the_unit_is_judged_by_what_was_posted_however_much_of_it_is_looked_at(count: int) -> None:
    result = fresh_predictor().predict(ask(100 * face((0.03, 0.025, 0.06), count), viewpoints=[40.0, 40, 50]))
    assert any("centimetres" in note for note in result.warnings)
    assert not any("inches" in note and "centimetres" not in note for note in result.warnings)


@pytest.mark.parametrize("noise", [0.001, 0.002, 0.003])
@pytest.mark.parametrize("given", ["auto", "up", "height"])
def test_the_noise_of_an_empty_plane_is_not_grasped(noise: float, given: str) -> None:
    """Nor is it taken for a cloud in another unit."""
    rng = np.random.default_rng(0)
    frame = rooms.photograph(rooms.empty(rng), (320, 240), noise, rng)
    points, truth = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE), frame.truth
    options: dict[str, Any] = {"up": "auto"} if given == "auto" else {"up": truth.up, "support_height": "auto"}
    if given == "height":
        options["support_height"] = truth.height
    result = fresh_predictor().predict(ask(points, viewpoints=np.zeros(3), **options))
    assert len(result.grasps) == 0
    assert not any("inches" in note for note in result.warnings)


def test_a_box_under_the_camera_that_is_wider_than_the_hand_is_named() -> None:
    top = np.random.default_rng(0).uniform([-0.15, -0.15, 0.1], [0.15, 0.15, 0.1], (20_000, 3))
    table = np.random.default_rng(1).uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.0], (20_000, 3))
    table = table[(np.abs(table[:, :2]) > 0.18).any(axis=1)]
    asked = ask(np.concatenate([top, table]), viewpoints=[0, 0, 0.8], up=UP, support_height="auto")
    result = fresh_predictor().predict(asked)
    assert len(result.grasps) == 0
    assert any("no hand of this size fits it" in note for note in result.warnings)


def test_candidates_that_hold_posted_points_after_all_count_as_collisions_with_those_before() -> None:
    query = tabletop_query(max_candidates=60)
    ready = prepared(query)
    free = generate(ready, query, CandidateConfig())[0]
    found = predictor_module._Free(free, 100, {"support": 3, "collision": 7})
    clear = torch.ones(len(free), dtype=torch.bool)
    clear[[0, 4, 5]] = False
    left = found.only(clear)
    assert left.rejected == {"support": 3, "collision": 10}
    assert (len(left.free), left.count) == (len(free) - 3, 100)
    assert torch.equal(left.free.approach, free.approach[clear])
