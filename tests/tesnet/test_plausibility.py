"""Each suspicion: numbers that rouse it, the words that name the remedy, and the usual numbers that do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tesnet import plausibility
from tesnet.geometry import CameraIntrinsics

CELL = 0.0045
CAMERA = CameraIntrinsics(640, 480, fx=612.0, fy=612.0, cx=322.0, cy=248.0)


def camera(width: int = 640, height: int = 480, fx: float = 612, cx: float = 320, cy: float = 240) -> CameraIntrinsics:
    return CameraIntrinsics(width, height, fx=fx, fy=fx, cx=cx, cy=cy)


def test_intrinsics_of_shares_are_named_with_what_to_multiply_them_by() -> None:
    said = plausibility.normalised_intrinsics(camera(fx=0.95, cx=0.5, cy=0.52))
    assert said is not None
    assert "fx and cx times 640, fy and cy times 480" in said
    for usual in (CAMERA, camera(cx=0, cy=0), camera(8, 8, fx=2, cx=1, cy=1)):
        assert plausibility.normalised_intrinsics(usual) is None


@pytest.mark.parametrize(
    ("given_camera", "words"),
    [
        (camera(cx=240, cy=320), "are cx and cy exchanged?"),
        (camera(1280, 720, cx=360, cy=640), "are cx and cy exchanged?"),
        (camera(cx=639.5, cy=359.5), "an image of about 1280 x 720 pixels; scale"),
        (camera(1280, 960, cx=319.5, cy=239.5), "an image of about 640 x 480 pixels; scale"),
    ],
)
def test_a_principal_point_off_the_middle_is_exchanged_or_of_another_resolution(
    given_camera: CameraIntrinsics, words: str
) -> None:
    said = plausibility.principal_point(given_camera)
    assert said is not None
    assert words in said


@given(
    st.sampled_from([(640, 480), (848, 480), (1280, 720), (1920, 1080), (512, 512)]),
    st.floats(-0.09, 0.09),
    st.floats(-0.09, 0.09),
)
def test_principal_points_of_usual_cameras_rouse_nothing(size: tuple[int, int], right: float, down: float) -> None:
    width, height = size
    usual = camera(width, height, cx=(width - 1) * 0.5 + right * width, cy=(height - 1) * 0.5 + down * height)
    assert plausibility.principal_point(usual) is None


def test_pixels_farther_apart_than_cells_are_named() -> None:
    said = plausibility.pixel_pitch(CAMERA, 3.06, 1, CELL)
    assert said is not None
    assert "5.0 mm apart at 3.06 m, more than the 4.5 mm cells" in said
    assert "stride" not in said
    coarse = plausibility.pixel_pitch(CAMERA, 0.612, 8, CELL)
    assert coarse is not None
    assert "smaller stride" in coarse
    assert plausibility.pixel_pitch(CAMERA, 0.6, 1, CELL) is None


@pytest.mark.parametrize(
    ("depth", "scale", "words"),
    [
        (5.0, 0.001, "counts of 0.1 mm need 0.0001 (then it is 0.5 m)"),
        (2.5, 0.001, "counts of 1/5000 m need 0.0002 (then it is 0.5 m)"),
        (0.04, 0.0001, "counts of 1 mm need 0.001 (then it is 0.4 m)"),
        (500.0, 1.0, "counts of 1 mm need 0.001"),
        (700.0, None, "divide millimetres by 1000 (then it is 0.7 m)"),
        (70.0, None, "divide centimetres by 100 (then it is 0.7 m)"),
    ],
)
def test_a_wrong_depth_scale_is_named_with_the_likely_one(depth: float, scale: float | None, words: str) -> None:
    said = plausibility.depth_scale(depth, scale)
    assert said is not None
    assert words in said
    assert plausibility.depth_scale(0.5, scale) is None


def test_what_spans_too_much_is_blamed_on_the_field_of_an_image() -> None:
    field, message = plausibility.depths_beyond(300.0, 500.0, 1.0)
    assert field == "depth_scale"
    assert "0.001" in message
    assert "millimetres by 1000" not in message
    field, message = plausibility.depths_beyond(60.0, 80.0, None)
    assert field == "depth"
    assert "divide centimetres by 100" in message
    assert "millimetres" not in message


@pytest.mark.parametrize("factor", [0.1, 0.2, 0.25])
@pytest.mark.parametrize("scale", [0.001, 0.0002])
def test_a_scale_that_brings_all_of_an_image_near_is_named_where_a_usual_one_would_fit(
    factor: float, scale: float
) -> None:
    said = plausibility.all_near(0.6 * factor, 0.9 * factor, scale * factor)
    assert said is not None
    assert f"need {scale:g} (then it is 0.6 m)" in said
    assert plausibility.all_near(0.1, 0.4, scale) is None  # such as fingers before a table
    assert plausibility.all_near(0.6 * factor, 0.9 * factor, None) is None


DEPTHS = {"a table": (0.5, 1.2), "a deep view": (1.0, 4.0), "a room": (0.6, 3.5), "a shelf": (0.4, 0.7)}


@pytest.mark.parametrize(("near", "far"), list(DEPTHS.values()), ids=list(DEPTHS))
@pytest.mark.parametrize(
    ("right", "sent"), [(0.001, 0.0001), (0.0002, 0.001), (0.0001, 0.001), (0.001, 0.01), (0.001, 1.0)]
)
@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_scale_is_named_once_with_the_right_one_also_in_deep_views(
    seed: int, right: float, sent: float, near: float, far: float
) -> None:
    """Of surfaces that go away from the camera, and of such with a wall behind them."""
    rng = np.random.default_rng(seed)
    counts = np.rint(np.append(rng.uniform(near, far, 4000), np.full(1000 * seed, far)) / right)
    notes, is_likely = plausibility.depth_notes(CAMERA, counts, sent, 1)
    assert not is_likely
    assert len(notes) == 1
    assert f"depth_scale {sent:g} is wrong" in notes[0]
    assert f"need {right:g} (then" in notes[0]
    notes, is_likely = plausibility.depth_notes(CAMERA, counts, right, 1)
    assert is_likely
    assert not [note for note in notes if "is wrong" in note]


def test_what_is_farther_than_cameras_see_is_named_though_something_is_near() -> None:
    """As by a robot's own arm in view."""
    rng = np.random.default_rng(0)
    counts = np.append(rng.integers(1000, 1500, 1000), rng.integers(5000, 15_000, 4000))
    (said,), is_likely = plausibility.depth_notes(CAMERA, counts, 0.001, 1)
    assert not is_likely
    assert "farther than depth cameras see" in said
    assert "counts of 1/5000 m need 0.0002" in said
    assert plausibility.depth_notes(CAMERA, counts, 0.0002, 1)[1]
    assert plausibility.far_away(14.0, None) is None


def test_many_points_of_which_few_are_left_are_of_another_unit_where_they_lie_close() -> None:
    said = plausibility.crowded(20_000, 12, 0.009, CELL)
    assert said is not None
    assert "20000 points posted span 9 mm" in said
    assert plausibility.crowded(20_000, 12, 1.5, CELL) is None
    assert plausibility.crowded(20, 12, 0.009, CELL) is None


def test_the_notes_of_a_usual_image_are_none_and_those_of_small_ones_too() -> None:
    depths = np.full(1000, 500)
    assert plausibility.depth_notes(CAMERA, depths, 0.001, 1) == ([], True)
    assert len(plausibility.depth_notes(camera(cx=240, cy=320), 10 * depths, 0.001, 1)[0]) == 2
    assert len(plausibility.depth_notes(camera(cx=240, cy=320), 2 * depths, 0.001, 16)[0]) == 2
    assert plausibility.depth_notes(camera(4, 4), 10 * depths, 0.001, 1) == ([], True)
    assert plausibility.depth_notes(CAMERA, depths[:0], 0.001, 1) == ([], True)


@pytest.mark.parametrize(("name", "per_metre"), [("centimetres", 100), ("inches", 39.37), ("millimetres", 1000)])
def test_a_lone_thing_in_another_unit_has_it_named(name: str, per_metre: float) -> None:
    thing = 0.022 if name == "millimetres" else 0.12
    said = plausibility.unit(0.0015 * per_metre, thing * per_metre, CELL)
    assert said is not None
    assert name in said
    assert plausibility.unit(0.0015, thing, CELL) is None


def test_points_that_lie_apart_in_a_small_cloud_are_sparse_and_of_no_other_unit() -> None:
    said = plausibility.unit(0.02, 0.5, CELL)
    assert said is not None
    assert "denser cloud" in said
    assert "inches" not in said


def test_a_cloud_smaller_than_anything_to_grasp_is_named() -> None:
    said = plausibility.tiny(0.0001)
    assert said is not None
    assert "0.1 mm" in said
    assert plausibility.tiny(0.03) is None


def test_low_scores_are_put_down_to_the_scale_only_where_another_one_would_fit() -> None:
    rng = np.random.default_rng(0)
    thing = rng.uniform(-0.05, 0.05, (500, 3)).astype(np.float32)
    extents = plausibility.extents(thing)
    assert plausibility.answer_notes(0.9, 7.0, 50 * extents, 0.08) == []
    scale, extent = plausibility.answer_notes(0.1, 7.0, 50 * extents, 0.08)
    assert "no score is over 0.10" in scale
    assert "centimetres" in scale
    assert "no hand of this size fits it" in extent
    assert plausibility.answer_notes(0.0, 0.15, extents * [1, 1, 0.5], 0.08) == []
    assert "nothing was found" in plausibility.answer_notes(0.0, 7.0, 50 * extents, 0.08)[0]
    scale, _ = plausibility.answer_notes(0.1, 7.0, 50 * extents, 0.08, of_image=True)
    assert "check depth_scale" in scale
    assert "multiply" not in scale


@given(st.integers(0, 100))
def test_extents_do_not_change_when_the_cloud_is_turned(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (400, 3)) * [0.1, 0.3, 0.6]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    np.testing.assert_allclose(
        np.sort(plausibility.extents(points @ turn + 5)), np.sort(plausibility.extents(points)), rtol=1e-6
    )


def test_up_is_reversed_where_every_camera_is_below_the_support() -> None:
    said = plausibility.reversed_up(np.array([-0.7, -0.4]), -0.1)
    assert said is not None
    assert "0.30 m below the support" in said
    assert "reverse it" in said
    assert plausibility.reversed_up(np.array([-0.7, 0.4]), -0.1) is None


def test_a_viewpoint_with_points_on_all_sides_is_within_the_cloud() -> None:
    ball = np.random.default_rng(1).normal(size=(4000, 3))
    ball = (0.05 * ball / np.linalg.norm(ball, axis=1, keepdims=True)).astype(np.float32)
    said = plausibility.enclosed_viewpoint(ball, np.zeros(3))
    assert said is not None
    assert "within the cloud" in said
    assert plausibility.enclosed_viewpoint(ball, np.array([0.3, 0.1, 0.2])) is None
    assert plausibility.enclosed_viewpoint(40 * ball, np.zeros(3)) is None


def test_a_camera_placed_in_millimetres_is_named_and_one_in_metres_or_far_away_is_not() -> None:
    said = plausibility.camera_distance(500.0)
    assert said is not None
    assert "divide its translation by 1000" in said
    for distance in (0.0, 0.5, 3.0, 20.0, 20_000.0):
        assert plausibility.camera_distance(distance) is None


@pytest.mark.parametrize("seed", range(5))
def test_extents_across_the_sight_are_those_of_what_is_seen(seed: int) -> None:
    """Of a face that is seen straight on, whose thickness is not."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    face = rng.uniform(-1, 1, (4000, 3)) * [0.15, 0.1, 0.0005] @ turn.T
    np.testing.assert_allclose(plausibility.extents_across(face, turn[:, 2]), [0.192, 0.288], rtol=0.03)
