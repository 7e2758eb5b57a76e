from __future__ import annotations

import io
import json
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from client.errors import InvalidArgument
from client.request import GraspOptions, GripperSize, Intrinsics, checked_points, header_value, points_request
from service import schemas
from service.payloads import decoder_for

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
