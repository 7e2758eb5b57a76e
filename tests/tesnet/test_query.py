from __future__ import annotations

import itertools
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet.errors import InvalidQuery, TesnetError
from tesnet.geometry import PANDA, Box
from tesnet.hands import HANDS
from tesnet.query import (
    LARGE_HAND,
    MAX_CANDIDATES,
    MAX_CANDIDATES_OF_LARGE_HANDS,
    NO_VIEWPOINT,
    ApproachCone,
    box_option,
)
from tests.tesnet.scenes import UP, ask

POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))

BAD_POINTS: list[tuple[Any, str]] = [
    (np.zeros(3), r"shape \(3,\); give an array of N x 3"),
    (np.zeros((4, 2)), r"shape \(4, 2\); give"),
    (np.zeros((2, 2, 3)), "give an array of N x 3"),
    ([], "give an array of N x 3"),
    ([[1, 2, 3], [1, 2]], "no array of real numbers; give"),
    ([["a", "b", "c"]], "no array of real numbers; give"),
    (np.zeros((5, 3), dtype=complex), "no array of real numbers; give"),
    (None, "no array of real numbers; give"),
    (np.array([[0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0]]), "2 of 3 are NaN or infinite; remove them"),
    (np.full((5, 3), 1e39), "5 of 5 are NaN or infinite; remove them"),
    (POINTS * 1000, r"span 310 m \(.*limit 20 m\); .*divide millimetres by 1000"),
    (np.array([[3e38] * 3, [-3e38] * 3] * 20), r"limit 20 m"),
]

BAD_OPTIONS: list[tuple[str, dict[str, Any], str]] = [
    ("viewpoint", {"viewpoints": [1.0, 2.0]}, r"shape \(1, 2\); give an array of N x 3"),
    ("viewpoint", {"viewpoints": "here"}, "no array of real numbers; give"),
    ("viewpoint", {"viewpoints": [[1, 2, 3], [1]]}, "no array of real numbers; give"),
    ("viewpoint", {"viewpoints": np.zeros((0, 3))}, "has 0 positions; give 1 to 64"),
    ("viewpoint", {"viewpoints": np.zeros((65, 3))}, "has 65 positions; give 1 to 64"),
    ("viewpoint", {"viewpoints": [0, np.nan, 0]}, "NaN or an infinity; .*remove"),
    ("viewpoint", {"viewpoints": [0, 0, -1e300]}, r"is 1e\+300; it must lie between 0 and 1e\+09 m"),
    ("up", {"up": [0, 0, 0]}, "length 0; give a direction whose length is between"),
    ("up", {"up": [0, 0, 1e39]}, r"length 1e\+39; give a direction"),
    ("up", {"up": [0, 1]}, r"shape \(2,\); give"),
    ("up", {"up": [0, np.inf, 0]}, "must be finite, remove"),
    ("support_height", {"support_height": 0.1}, "needs `up`.*give `up` as well"),
    ("support_height", {"up": UP, "support_height": np.nan}, "is nan; it must lie between"),
    ("support_height", {"up": UP, "support_height": -1e300}, r"is -1e\+300; it must lie between"),
    ("support_height", {"up": UP, "support_height": "low"}, "is of type str; give a number between"),
    ("workspace", {"workspace": [[0, 0, 0], [1, 1, 1]]}, "is of type list; give a Box"),
    ("approach", {"approach": UP}, "is of type ndarray; give an? ApproachCone"),
    ("max_grasps", {"max_grasps": 0}, "is 0; it must be a whole number between 1 and 1000"),
    ("max_grasps", {"max_grasps": 1001}, "is 1001; .* between 1 and 1000"),
    ("max_grasps", {"max_grasps": 2.5}, "is 2.5; it must be a whole number"),
    ("max_grasps", {"max_grasps": None}, "is of type NoneType; it must be a whole number"),
    ("min_score", {"min_score": -0.1}, "is -0.1; it must lie between 0 and 1"),
    ("min_score", {"min_score": 1.1}, "is 1.1; it must lie between 0 and 1"),
    ("min_score", {"min_score": np.nan}, "is nan; it must lie between 0 and 1"),
    ("min_score", {"min_score": "high"}, "is of type str; give a number between 0 and 1"),
    ("min_separation", {"separation_translation": -0.01}, "is -0.01; it must lie between 0 and 1 m"),
    ("min_separation", {"separation_translation": 1.5}, "is 1.5; it must lie between 0 and 1 m"),
    ("min_separation", {"separation_rotation_deg": -1}, "is -1; it must lie between 0 and 180 degrees"),
    ("min_separation", {"separation_rotation_deg": 181}, "is 181; it must lie between 0 and 180 degrees"),
    ("num_approach_points", {"num_approach_points": 0}, "is 0; .* between 1 and 1024"),
    ("num_approach_points", {"num_approach_points": 1025}, "is 1025; .* between 1 and 1024"),
    ("max_candidates", {"max_candidates": 0}, "is 0; .* between 1 and 20000"),
    ("max_candidates", {"max_candidates": 20_001}, "is 20001; .* between 1 and 20000"),
    ("view_index", {"view_index": np.zeros(49, np.uint8)}, r"shape \(49,\); give a whole number for each of the 50"),
    ("view_index", {"view_index": np.zeros(50)}, "array of float64"),
    (
        "view_index",
        {"view_index": np.full(50, 1)},
        "from 1 to 1, but there are 1 viewpoints; count them from 0",
    ),
    ("view_index", {"view_index": np.full(50, -1)}, "reaches from -1 to -1"),
    ("normals", {"normals": np.zeros((50, 2))}, r"shape \(50, 2\); give x, y, z for each of the 50 points"),
    ("normals", {"normals": np.full((50, 3), np.nan)}, "hold NaN or an infinity; give zeros"),
    ("unseen", {"unseen": "maybe"}, "is 'maybe'; valid: free, occupied"),
    ("seed", {"seed": -1}, "is -1; .* between 0 and 9223372036854775807"),
    ("seed", {"seed": 2**63}, "is 9223372036854775808; .* between 0 and"),
    ("seed", {"seed": 0.5}, "is 0.5; it must be a whole number"),
]


@pytest.mark.parametrize(("points", "says"), BAD_POINTS)
def test_bad_points_are_refused_with_value_limit_and_remedy(points: Any, says: str) -> None:
    with pytest.raises(InvalidQuery, match=says) as caught:
        ask(points)
    assert caught.value.field == "points"


@pytest.mark.parametrize(("field", "options", "says"), BAD_OPTIONS)
def test_bad_options_are_refused_with_value_limit_and_remedy(field: str, options: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidQuery, match=says) as caught:
        ask(POINTS, **options)
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{field}: ")
    assert isinstance(caught.value, TesnetError)


@pytest.mark.parametrize("option", ["workspace", "target"])
def test_what_is_no_box_is_refused_under_its_options_name(option: str) -> None:
    says = f"{option}: min [0.0, 0.0, 0.0] is not below max [1.0, 0.0, 1.0] on every axis"
    with pytest.raises(InvalidQuery, match=re.escape(says)) as caught:
        box_option(option, (0, 0, 0), (1, 0, 1))
    assert caught.value.field == option
    np.testing.assert_array_equal(box_option(option, (0, 0, 0), (1, 2, 3)).maximum, [1, 2, 3])


@pytest.mark.parametrize("angle", [-1.0, 181.0, float("nan"), float("inf")])
def test_a_cone_has_an_angle_between_0_and_180_degrees(angle: float) -> None:
    with pytest.raises(InvalidQuery, match="between 0 and 180 degrees") as caught:
        ApproachCone(UP, angle)
    assert caught.value.field == "approach"
    with pytest.raises(InvalidQuery, match="length 0"):
        ApproachCone(np.zeros(3), 30.0)


@given(
    seed=st.integers(0, 2**31),
    size=st.sampled_from([1, 2, 50]),
    scale=st.sampled_from([1e-30, 1e-3, 1, 1e30, 1e38, np.nan]),
)
@settings(max_examples=40, deadline=None)
def test_any_cloud_is_either_taken_or_refused(seed: int, size: int, scale: float) -> None:
    points = np.random.default_rng(seed).normal(size=(size, 3)) * scale
    try:
        query = ask(points)
    except InvalidQuery as error:
        assert error.field == "points"  # noqa: PT017  either outcome is right
    else:
        assert query.points.shape == (size, 3)
        assert np.isfinite(query.points).all()


def test_far_outliers_do_not_make_a_cloud_look_like_millimetres() -> None:
    points = np.vstack([POINTS, [[1e5, 0, 0]], [[0, -1e7, 0]]])
    assert len(ask(points).points) == 52


def test_a_query_copies_its_arrays_and_keeps_them_read_only() -> None:
    points, viewpoint = POINTS.copy(), np.array([0.0, 0.0, 1.0])
    query = ask(points, viewpoints=viewpoint, up=viewpoint)
    points[:], viewpoint[:] = 9, 9
    assert query.points.dtype == np.float32
    np.testing.assert_allclose(query.points, POINTS, atol=1e-7)
    assert query.viewpoints is not None
    assert query.known_up is not None
    np.testing.assert_array_equal(query.viewpoints, [[0, 0, 1]])
    for array in (query.points, query.viewpoints, query.known_up):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


def test_directions_become_unit_vectors_and_limits_are_inclusive() -> None:
    query = ask(
        POINTS,
        viewpoints=np.zeros((64, 3)),
        up=np.array([0, 0, 7.0]),
        approach=ApproachCone(np.array([0, -3.0, 0]), 180.0),
        max_grasps=1000,
        min_score=1.0,
        separation_translation=1.0,
        separation_rotation_deg=180,
        num_approach_points=1024,
        max_candidates=20_000,
        seed=2**63 - 1,
    )
    assert query.up is not None
    assert query.approach is not None
    np.testing.assert_array_equal(query.up, [0, 0, 1])
    np.testing.assert_array_equal(query.approach.direction, [0, -1, 0])


def test_whole_numbers_of_numpy_are_whole_numbers() -> None:
    query = ask(POINTS, max_grasps=np.int64(3), seed=np.uint32(7), min_score=np.float32(0.5))
    assert query.max_grasps == 3


@given(st.sampled_from([0.0, 63.0, 65.0, 1e4, 5.4e6, -1e8]), st.integers(0, 100))
def test_a_far_cloud_of_float64_keeps_its_detail_and_moves_what_comes_with_it(distance: float, seed: int) -> None:
    offset = distance * np.array([1.0, 0.5, -0.25])
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (50, 3))
    far = ask(
        points + offset,
        viewpoints=offset + UP,
        up=UP,
        workspace=Box(offset - 1, offset + 1),
        target=Box(offset - 2, offset + 2),
        support_height=0.05 + float(offset @ UP),
    )
    assert (far.origin is not None) == (abs(distance) > 64)
    rounded = np.spacing(np.float32(1.0 if far.origin is not None else max(abs(distance), 1.0)))
    spacing = float(np.spacing(2 * max(abs(distance), 1.0)) + rounded)
    np.testing.assert_allclose(far.points + far.offset, points + offset, atol=4 * spacing)
    assert far.viewpoints is not None
    assert far.workspace is not None
    assert isinstance(far.target, Box)
    assert isinstance(far.support_height, float)
    np.testing.assert_allclose(far.viewpoints + far.offset, [offset + UP], atol=4 * spacing)
    np.testing.assert_allclose(far.workspace.minimum + far.offset, offset - 1, atol=4 * spacing)
    np.testing.assert_allclose(far.target.maximum + far.offset, offset + 2, atol=4 * spacing)
    assert far.support_height + far.offset @ UP == pytest.approx(0.05 + float(offset @ UP), abs=4 * spacing)
    again = replace(far, max_grasps=3)
    np.testing.assert_array_equal(again.points, far.points)
    np.testing.assert_array_equal(again.viewpoints, far.viewpoints)


def test_the_origin_as_default_viewpoint_is_told_of_a_far_cloud_too() -> None:
    far = ask(POINTS + 1e5)
    assert far.notes == (NO_VIEWPOINT,)
    np.testing.assert_array_equal(far.viewpoints, [-far.offset])
    assert ask(POINTS).notes == ()


@pytest.mark.parametrize("distance", [1.1e9, 2e9, 1e12, 1e30, 3.4e38])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cloud_that_lies_nowhere_near_is_refused_and_a_few_such_points_are_not(distance: float, dtype: Any) -> None:
    points: Any = np.random.default_rng(0).uniform(0, 0.1, (100, 3)).astype(dtype)
    with pytest.raises(InvalidQuery, match=r"m from the origin \(limit 1e\+09 m\)"):
        ask(points + dtype(distance))
    points[:3] = distance
    assert len(ask(points).points) == 100


@pytest.mark.parametrize("part", ["hand_to_tcp", "palm_length"])
def test_a_hand_with_a_very_long_part_has_fewer_candidates(part: str) -> None:
    points = np.zeros((1, 3))
    for name, hand in HANDS.items():
        assert ask(points, gripper=hand.gripper, max_candidates=MAX_CANDIDATES).most_candidates == 20_000, name
    longer: Any = {part: LARGE_HAND + 0.01}
    large = replace(PANDA, **longer)
    asked = ask(points, gripper=large, max_candidates=MAX_CANDIDATES)
    assert asked.most_candidates == asked.candidate_limit == MAX_CANDIDATES_OF_LARGE_HANDS
    assert ask(points, gripper=large, max_candidates=7).most_candidates == 7


@pytest.mark.parametrize("name", HANDS)
def test_a_hand_opens_wide_unless_its_tips_swing_as_they_close(name: str) -> None:
    hand = HANDS[name].gripper
    swings = hand.travel > 0
    assert ask(POINTS, gripper=hand).opening_policy == ("fitted" if swings else "full")
    for asked in ("fitted", "full"):
        assert ask(POINTS, gripper=hand, width=asked).opening_policy == asked


@pytest.mark.parametrize(("offset", "length"), [(0.0, None), *itertools.product([-0.03, 0.0, 0.02], [0.08, 0.2])])
def test_a_hand_of_one_s_own_swings_if_it_has_cranks_wherever_their_pivots_stand(
    offset: float, length: float | None
) -> None:
    hand = replace(PANDA, linkage_length=length, linkage_offset=offset)
    assert ask(POINTS, gripper=hand).opening_policy == ("full" if length is None else "fitted")
    assert ask(POINTS, gripper=hand, width="full").opening_policy == "full"


def test_the_least_of_every_option_is_taken() -> None:
    query = ask(
        POINTS,
        up=UP,
        support_height=-1e9,
        approach=ApproachCone(UP, 0.0),
        max_grasps=1,
        min_score=0.0,
        separation_translation=0.0,
        separation_rotation_deg=0,
        num_approach_points=1,
        max_candidates=1,
        seed=0,
    )
    assert query.support_height == -1e9
    assert ask(POINTS, up=UP, support_height=1e9).support_height == 1e9
    for height in (-1.001e9, 1.001e9):
        with pytest.raises(InvalidQuery, match="support_height"):
            ask(POINTS, up=UP, support_height=height)


def test_the_defaults_are_those_that_the_interface_names() -> None:
    query = ask(POINTS)
    named: dict[str, Any] = {
        "viewpoints": None,
        "up": None,
        "workspace": None,
        "support_height": None,
        "target": None,
        "approach": None,
        "max_grasps": 10,
        "min_score": 0.0,
        "separation_translation": 0.01,
        "separation_rotation_deg": 15.0,
        "num_approach_points": 32,
        "max_candidates": 2000,
        "gripper": PANDA,
        "unseen": "free",
        "width": None,
        "seed": 0,
        "model": None,
        "calibrate": False,
    }
    assert {name: getattr(query, name) for name in named} == named


@pytest.mark.parametrize(
    ("up", "height", "says"), [("auto", 0.1, "give both, or neither"), (None, "auto", "needs `up`")]
)
def test_a_height_is_given_or_found_along_an_up_that_is(up: Any, height: Any, says: str) -> None:
    with pytest.raises(InvalidQuery, match=says):
        ask(POINTS, up=up, support_height=height)
    for good in ({"up": "auto", "support_height": "auto"}, {"up": UP, "support_height": "auto"}, {"up": "auto"}):
        ask(POINTS, **good)
    with pytest.raises(InvalidQuery, match="give a direction x, y, z, or auto"):
        ask(POINTS, up="down")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_what_belongs_to_points_is_counted_from_0_to_the_last_viewpoint(count: int) -> None:
    viewpoints = np.eye(count, 3) + 1
    index = np.arange(len(POINTS)) % count
    query = ask(POINTS, viewpoints=viewpoints, view_index=index)
    assert query.view_index is not None
    assert query.view_index.tolist() == index.tolist()
    for wrong in (index + 1, index - 1):
        with pytest.raises(InvalidQuery, match="count them from 0"):
            ask(POINTS, viewpoints=viewpoints, view_index=wrong)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("distance", "moves"), [(63.0, False), (64.0, True), (1e9, True)])
def test_a_cloud_of_float64_has_its_own_origin_from_64_m_on_either_way(
    sign: int, axis: int, distance: float, moves: bool
) -> None:
    """An origin of whole metres, the middle of the points."""
    points = POINTS - POINTS.mean(axis=0)
    points[:, axis] += sign * distance
    query = ask(points)
    expected = np.zeros(3)
    expected[axis] = sign * distance
    if moves:
        np.testing.assert_array_equal(query.offset, expected)
    else:
        assert query.origin is None
    assert ask(points.astype(np.float32)).origin is None


def test_a_query_counts_the_bytes_of_all_that_grows_with_its_cloud() -> None:
    count = len(POINTS)
    assert ask(POINTS).nbytes == 12 * count
    whole = ask(POINTS, target=np.ones(count, bool), view_index=np.zeros(count, int), normals=np.ones((count, 3)))
    assert whole.nbytes == (12 + 1 + 1 + 12) * count
    assert ask(POINTS, target=Box(np.zeros(3), np.ones(3))).nbytes == 12 * count


def test_no_array_of_a_query_can_be_changed() -> None:
    count = len(POINTS)
    query = ask(
        POINTS + 1e5,
        viewpoints=np.zeros(3),
        up=UP,
        target=np.ones(count, bool),
        view_index=np.zeros(count, int),
        normals=np.ones((count, 3)),
        approach=ApproachCone(UP, 30.0),
    )
    arrays: list[Any] = [query.points, query.known_up, query.target, query.view_index, query.normals, query.origin]
    assert query.approach is not None
    for array in [*arrays, query.approach.direction]:
        assert isinstance(array, np.ndarray)
        assert not array.flags.writeable
