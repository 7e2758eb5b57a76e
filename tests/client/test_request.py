from __future__ import annotations

import io
import json
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from client.errors import InvalidArgument
from client.request import (
    LONGEST_QUERY,
    GraspOptions,
    GripperSize,
    Intrinsics,
    Request,
    checked_points,
    depth_request,
    header_value,
    points_request,
)
from service import schemas
from service.payloads import Payload, decoder_for
from tesnet.geometry import CameraIntrinsics, Pose
from tesnet.query import FAR

CLOUD = np.zeros((2, 3), dtype=np.float32)
EVERY_OPTION: dict[str, Any] = {
    "viewpoint": [np.array([0.3, 0, 0.6]), (0, 0, 1)],
    "up": np.array([0, 0, 1.0]),
    "workspace": {"min": np.zeros(3), "max": (1, 1, 1)},
    "support_height": np.float64(0.05),
    "target": {"indices": np.arange(2)},
    "approach": {"direction": [0, 0, -1], "max_angle_deg": 30.0},
    "max_grasps": np.int64(7),
    "min_score": 0.25,
    "min_separation": {"translation": 0.02, "rotation_deg": 20.0},
    "num_approach_points": 16,
    "max_candidates": 500,
    "gripper": {"max_width": 0.06, "finger_depth": np.float32(0.04)},
    "unseen": "occupied",
    "width": "fitted",
    "calibrate": True,
    "pregrasp_distance": 0.1,
    "frame_convention": "graspnet",
    "seed": 3,
    "model": "tesnet",
}


def _query(options: dict[str, Any]) -> dict[str, Any]:
    query = parse_qs(urlsplit(points_request(CLOUD, options).target).query, strict_parsing=bool(options))
    return {name: json.loads(values[0]) for name, values in query.items()}


@given(npst.arrays(np.float32, st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-60, 60, width=32)))
def test_the_body_is_the_points_as_little_endian_float32_triples(points: np.ndarray[Any, Any]) -> None:
    for same in (points, points.astype(">f4"), points.astype(np.float64), np.asfortranarray(points), points.tolist()):
        content = points_request(same, {}).content
        np.testing.assert_array_equal(np.frombuffer(content, "<f4").reshape(-1, 3), points)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 3)), "0 rows"),
        (np.zeros((5, 2)), r"shape \(5, 2\)"),
        (np.zeros(3), r"shape \(3,\)"),
        ([[0, 0, 0], [1, 1]], "rows of different lengths"),
        (np.zeros((4, 3), dtype=bool), "dtype bool"),
        (np.zeros((4, 3), dtype=complex), "dtype complex128"),
        (np.array([["a", "b", "c"]]), "dtype <U1"),
        (np.array([[0, 0, np.inf], [0, -np.inf, 1]]), "2 rows, none of them finite"),
        (np.array([[0, 0, 1e300]]), "beyond float32"),
    ],
)
def test_points_that_cannot_be_sent_are_refused_with_value_and_remedy(points: Any, words: str) -> None:
    with pytest.raises(InvalidArgument, match=words) as caught:
        checked_points(points)
    assert caught.value.argument == "points"
    assert isinstance(caught.value, ValueError)


def test_points_of_an_image_travel_row_by_row_with_those_that_are_none() -> None:
    image = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    image[1, 1] = np.nan
    np.testing.assert_array_equal(
        np.frombuffer(points_request(image, {}).content, "<f4").reshape(-1, 3), image.reshape(-1, 3)
    )


def test_points_far_from_the_origin_travel_as_float64() -> None:
    far = np.array([[5_400_000.0123, 1, 2], [5_400_000.5, np.nan, 2]])
    request = points_request(far, {"seed": 1})
    assert request.headers["Content-Type"] == "application/x-npy"
    np.testing.assert_array_equal(np.load(io.BytesIO(request.content)), far)
    assert points_request(far.astype(np.float32), {}).headers["Content-Type"] == "application/octet-stream"


def test_what_belongs_to_each_point_travels_in_a_form() -> None:
    points = np.zeros((4, 3), np.float32)
    request = points_request(points, {"seed": 1}, view_index=[0, 1, 1, 0], normals=np.eye(4, 3))
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 10)
    assert payload.view_index is not None
    assert payload.normals is not None
    assert payload.view_index.tolist() == [0, 1, 1, 0]
    assert payload.normals.tolist() == np.eye(4, 3).tolist()


def test_what_belongs_to_each_pixel_of_an_image_of_points_travels_row_by_row() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(0.1, 1, (2, 3, 4, 3)).astype(np.float32)
    index = np.arange(12).reshape(3, 4)
    payload, _ = as_sent(points_request(points, {}, view_index=index, normals=normals))
    assert payload.view_index is not None
    assert payload.normals is not None
    np.testing.assert_array_equal(payload.points, points.reshape(-1, 3))
    assert payload.view_index.tolist() == list(range(12))
    np.testing.assert_array_equal(payload.normals, normals.reshape(-1, 3))


@pytest.mark.parametrize(
    ("beside", "name"),
    [
        ({"view_index": [0, 1]}, "view_index"),
        ({"view_index": [0.0] * 4}, "view_index"),
        ({"normals": np.zeros((4, 2))}, "normals"),
        ({"normals": np.zeros((3, 3))}, "normals"),
    ],
)
def test_other_numbers_of_what_belongs_to_each_point_are_refused_here(beside: dict[str, Any], name: str) -> None:
    with pytest.raises(InvalidArgument, match="each of the 4 points") as caught:
        points_request(np.zeros((4, 3)), {}, **beside)
    assert caught.value.argument == name


def test_the_client_has_the_options_of_the_wire_and_no_other() -> None:
    assert set(GraspOptions.__annotations__) == set(schemas.GraspOptions.model_fields) == set(EVERY_OPTION)


def test_grippers_and_cameras_have_the_names_of_the_wire() -> None:
    assert set(GripperSize.__annotations__) == set(schemas.GripperSize.model_fields)
    assert set(Intrinsics.__annotations__) == set(schemas.Intrinsics.model_fields)


def test_every_option_reaches_the_wire_as_the_schema_reads_it() -> None:
    parsed = schemas.GraspOptions.model_validate_json(json.dumps(_query(EVERY_OPTION)))
    assert parsed.viewpoint == [(0.3, 0, 0.6), (0, 0, 1)]
    assert parsed.workspace == schemas.Box(min=(0, 0, 0), max=(1, 1, 1))
    assert parsed.support_height == 0.05
    assert parsed.target is not None
    assert parsed.target.indices == [0, 1]
    assert parsed.gripper == schemas.GripperSize(max_width=0.06, finger_depth=float(np.float32(0.04)))
    assert parsed.max_grasps == 7
    assert parsed.frame_convention == "graspnet"


def as_sent(request: Request) -> tuple[Payload, dict[str, Any]]:
    """What the service makes of a request: its points, and the options that stand in its URL or its form."""
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 100_000)
    in_url = parse_qs(urlsplit(request.target).query)
    options = {name: json.loads(values[0]) for name, values in in_url.items()}
    return payload, options | {name: json.loads(bytes(value)) for name, value in payload.options.items()}


def plain(value: Any) -> Any:
    """Arrays as lists, tuples too: as JSON has them."""
    return json.loads(json.dumps(value, default=lambda array: array.tolist()))


@pytest.mark.parametrize("name", EVERY_OPTION)
@pytest.mark.parametrize("way", ["points", "form", "depth"])
def test_every_option_arrives_as_it_was_given_however_it_travels(name: str, way: str) -> None:
    options = {name: EVERY_OPTION[name]}
    if way == "depth":
        camera: Intrinsics = {"fx": 50.0, "fy": 50.0, "cx": 1.0, "cy": 1.0}
        request = depth_request(np.ones((4, 4)), camera, options)
    else:
        request = points_request(CLOUD, options, normals=np.eye(2, 3) if way == "form" else None)
    assert as_sent(request)[1] == plain(options)


@pytest.mark.parametrize("value", [0, 0.0, False, [0.0, 0.0, 0.0]])
@pytest.mark.parametrize("name", ["seed", "calibrate", "viewpoint", "min_score", "support_height"])
def test_a_zero_is_no_option_that_was_left_out(name: str, value: Any) -> None:
    assert as_sent(points_request(CLOUD, {name: value}))[1] == {name: value}


@given(st.integers(0, 1500), st.integers(0, 30), st.integers(10, 99_999))
@settings(max_examples=60, deadline=None)
def test_no_url_is_longer_than_any_proxy_takes_and_no_option_is_lost(count: int, near: int, largest: int) -> None:
    """Of around 800 or 1,400 indices on, as they have five digits or three, they travel in a form."""
    for number in (count, max(0, near + round(LONGEST_QUERY / (3 + len(str(largest)))) - 15)):
        options = {"target": {"indices": [largest] * number}, "seed": 3}
        request = points_request(CLOUD, options)
        assert len(request.target) <= len("/grasps?") + LONGEST_QUERY <= 4100
        payload, arrived = as_sent(request)
        assert arrived == options
        np.testing.assert_array_equal(payload.points, CLOUD)
        assert (request.target == "/grasps") == ("multipart" in request.headers["Content-Type"])


@pytest.mark.parametrize("stride", range(1, 6))
@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("scale", [0.001, 0.00025])
def test_the_service_sees_a_depth_image_as_the_caller_described_it(stride: int, moved: bool, scale: float) -> None:
    rng = np.random.default_rng(stride)
    depth = np.where(rng.random((11, 7)) < 0.8, rng.uniform(0.3, 2.0, (11, 7)), 0.0)
    labels = rng.integers(0, 4, (11, 7)).astype(np.uint8)
    camera = CameraIntrinsics(7, 11, fx=60.0, fy=70.0, cx=3.2, cy=5.1)
    pose = Pose.random(rng, reach=0.5) if moved else None
    request = depth_request(depth, camera, {}, mask=labels, T_cloud_camera=pose, depth_scale=scale, stride=stride)
    payload, _ = as_sent(request)
    used = np.zeros((11, 7), dtype=bool)
    used[::stride, ::stride] = depth[::stride, ::stride] > 0
    assert payload.is_point is not None
    assert payload.mask is not None
    assert payload.is_point.tolist() == used.ravel().tolist()
    assert payload.mask.tolist() == labels.ravel().tolist()
    points = camera.back_project(np.where(used, depth, 0.0))
    np.testing.assert_allclose(payload.points, points if pose is None else pose.apply(points), atol=4 * scale)
    assert payload.viewpoint is not None
    np.testing.assert_allclose(payload.viewpoint, np.zeros(3) if pose is None else pose.translation, atol=1e-9)


@pytest.mark.parametrize("decimals", [3, 4, 6])
def test_a_camera_s_pose_as_it_is_printed_is_the_pose_that_was_meant(decimals: int) -> None:
    """Its columns are of unit length and at right angles only as far as its decimals go."""
    for seed in range(20):
        pose = Pose.random(np.random.default_rng(seed), reach=0.5)
        printed = pose.matrix.round(decimals)
        camera: Intrinsics = {"fx": 50.0, "fy": 50.0, "cx": 1.0, "cy": 1.0}
        for given_as in (printed, printed.tolist()):
            arrived = as_sent(depth_request(np.ones((4, 4)), camera, {}, T_cloud_camera=given_as))[0]
            expected = as_sent(depth_request(np.ones((4, 4)), camera, {}, T_cloud_camera=pose))[0]
            np.testing.assert_allclose(arrived.points, expected.points, atol=4 * 10.0**-decimals)
            assert arrived.viewpoint is not None
            np.testing.assert_allclose(arrived.viewpoint, printed[:3, 3], atol=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.02, 1.02, 1.02, 1.0]),
        np.eye(4)[[1, 0, 2, 3]],
        np.zeros((4, 4)),
        np.eye(3),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused_by_name(wrong: np.ndarray[Any, Any]) -> None:
    with pytest.raises(InvalidArgument, match="T_cloud_camera"):
        depth_request(np.ones((4, 4)), {"fx": 50, "fy": 50, "cx": 1, "cy": 1}, {}, T_cloud_camera=wrong)


def test_coordinates_travel_as_float64_from_where_float32_would_blur_them_on_either_side() -> None:
    for sign in (1, -1):
        for size, content_type in ((0.99, "application/octet-stream"), (1.0, "application/x-npy")):
            for column in range(3):
                points = np.zeros((2, 3))
                points[1, column] = sign * size * FAR
                assert points_request(points, {}).headers["Content-Type"] == content_type
                assert checked_points(points).dtype == (np.float64 if size == 1.0 else np.float32)


def test_options_that_are_absent_or_none_are_left_to_the_service() -> None:
    assert _query({"up": None, "max_grasps": 3}) == {"max_grasps": 3}
    assert points_request(CLOUD, {"up": None}).target == "/grasps"


def test_an_unknown_option_is_a_type_error_that_lists_the_known_ones() -> None:
    with pytest.raises(TypeError, match=r"'top_k'; valid: approach, .*max_grasps"):
        points_request(CLOUD, {"top_k": 3})


@pytest.mark.parametrize("value", [np.array([0, np.nan, 1]), float("inf"), object()])
def test_an_option_that_json_cannot_express_is_refused(value: object) -> None:
    with pytest.raises(InvalidArgument, match="up: holds"):
        points_request(CLOUD, {"up": value})


@pytest.mark.parametrize("value", ["", "a\r\nX-Evil: 1", "naïve", " padded ", "x" * 4001])
def test_a_header_cannot_be_smuggled(value: str) -> None:
    with pytest.raises(InvalidArgument, match="request_id"):
        header_value("request_id", value)
    with pytest.raises(InvalidArgument, match="request_id"):
        points_request(CLOUD, {}, request_id=value)


@pytest.mark.parametrize("name", ["a", "x" * 128, "robot-7/cell:3", "aZ09._:/+=-"])
def test_a_request_id_goes_as_it_is_up_to_128_characters(name: str) -> None:
    for request in (
        points_request(CLOUD, {}, request_id=name),
        points_request(CLOUD, {}, request_id=name, normals=np.eye(2, 3)),
        depth_request(np.ones((2, 2)), {"fx": 50, "fy": 50, "cx": 1, "cy": 1}, {}, request_id=name),
    ):
        assert request.headers["X-Request-ID"] == name
        assert request.headers["Accept"] == "application/json"
    for wrong in (name + " ", name + "x" * 128, "\n" + name):
        with pytest.raises(InvalidArgument, match="request_id"):
            points_request(CLOUD, {}, request_id=wrong)


@pytest.mark.parametrize("value", ["~", " ".join("ab"), "x" * 4000, "!"])
def test_a_header_may_hold_what_is_printable_up_to_4000_characters(value: str) -> None:
    assert header_value("api_key", value) == value


@pytest.mark.parametrize(
    ("beside", "words"),
    [
        ({"normals": np.zeros((2, 2, 2))}, "normals: has shape .*give x, y, z for each of the 4 points"),
        ({"normals": np.zeros((1, 2, 2, 3))}, "give x, y, z"),
        ({"normals": np.zeros((4, 3), bool)}, "dtype bool; give x, y, z"),
        ({"view_index": np.zeros((2, 3), int)}, "view_index: .*give a whole number for each of the 4 points"),
        ({"view_index": np.zeros(4, bool)}, "give a whole number"),
    ],
)
def test_what_belongs_to_each_point_says_what_it_should_be(beside: dict[str, Any], words: str) -> None:
    for points in (np.zeros((4, 3)), np.zeros((2, 2, 3))):
        with pytest.raises(InvalidArgument, match=words):
            points_request(points, {}, **beside)


@pytest.mark.parametrize("shape", [(4, 3), (2, 2, 3)])
@pytest.mark.parametrize("kind", [int, float, np.float32, np.uint8])
def test_normals_of_any_numbers_and_of_points_or_pixels_arrive(shape: tuple[int, ...], kind: type) -> None:
    normals: np.ndarray[Any, Any] = (np.arange(12).reshape(shape) % 5).astype(kind)
    payload, _ = as_sent(points_request(np.zeros(shape), {}, normals=normals))
    assert payload.normals is not None
    np.testing.assert_array_equal(payload.normals, normals.reshape(-1, 3))
