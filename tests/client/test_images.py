from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from PIL import Image

from client.errors import InvalidArgument
from client.images import depth_counts, mask_levels, png
from client.request import depth_request, points_request
from service.payloads import decoder_for
from tesnet.geometry import CameraIntrinsics, Pose

CAMERA: Any = {"fx": 100.0, "fy": 100.0, "cx": 1.0, "cy": 1.0}
shapes = st.tuples(st.integers(1, 9), st.integers(1, 9))


@settings(max_examples=40)
@given(npst.arrays(st.sampled_from([np.uint8, np.uint16]), shapes))
def test_a_png_is_the_image_that_other_programs_read(pixels: NDArray[Any]) -> None:
    with Image.open(io.BytesIO(png(pixels))) as image:
        image.verify()
    with Image.open(io.BytesIO(png(pixels))) as image:
        np.testing.assert_array_equal(np.array(image), pixels)


def test_metres_are_rounded_to_counts_and_what_is_no_depth_becomes_zero() -> None:
    metres = np.array([[0.5004, 0.5006, np.nan], [np.inf, -1.0, 0.0]])
    assert depth_counts(metres, 0.001).tolist() == [[500, 501, 0], [0, 0, 0]]
    assert depth_counts(np.array([[500, 0]]), 0.001).tolist() == [[500, 0]]
    assert depth_counts(metres, 0.0001).max() == 5006
    assert mask_levels(np.array([[True, False]]), (1, 2)).tolist() == [[255, 0]]


@pytest.mark.parametrize(("labels", "dtype"), [([[0, 7, 255]], np.uint8), ([[0, 7, 65_535]], np.uint16)])
def test_labels_of_a_mask_stay_what_they_are(labels: list[list[int]], dtype: type) -> None:
    levels = mask_levels(np.array(labels), (1, 3))
    assert levels.dtype == dtype
    assert levels.tolist() == labels
    request = depth_request(np.ones((1, 3)), CAMERA, {"target": {"label": 7}}, mask=np.array(labels), stride=1)
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 1000)
    assert payload.mask is not None
    assert payload.mask.tolist() == labels[0]


def test_images_of_npy_travel_as_they_are_with_the_stride() -> None:
    files = []
    for array in (np.full((4, 6), 0.5, np.float32), np.eye(4, 6, dtype=np.uint8)):
        file = io.BytesIO()
        np.save(file, array)
        files.append(file.getvalue())
    request = depth_request(files[0], CAMERA, {}, mask=files[1], stride=2)
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 1000)
    assert len(payload.points) == 6
    np.testing.assert_allclose(payload.points[:, 2], 0.5)
    assert payload.mask is not None
    assert payload.mask.reshape(4, 6).tolist() == np.eye(4, 6).tolist()


@pytest.mark.parametrize(
    ("depth", "mask", "scale", "argument"),
    [
        (np.zeros((2, 2, 3)), None, 0.001, "depth"),
        (np.zeros((0, 2)), None, 0.001, "depth"),
        (np.array([["far"]]), None, 0.001, "depth"),
        (np.full((2, 2), 70.0), None, 0.001, "depth"),
        (np.full((2, 2), 70_000), None, 0.001, "depth"),
        (np.full((2, 2), -1), None, 0.001, "depth"),
        (np.ones((2, 2)), None, 0.0, "depth_scale"),
        (np.ones((2, 2)), np.ones((2, 3)), 0.001, "mask"),
        (np.ones((2, 2)), np.array([["a", "b"], ["c", "d"]]), 0.001, "mask"),
        (np.ones((2, 2)), np.full((2, 2), 65_536), 0.001, "mask"),
        (np.ones((2, 2)), np.full((2, 2), -1), 0.001, "mask"),
    ],
)
def test_an_image_that_cannot_be_sent_is_refused_before_it_is(
    depth: Any, mask: Any, scale: float, argument: str
) -> None:
    with pytest.raises(InvalidArgument) as caught:
        depth_request(depth, CAMERA, {}, mask=mask, depth_scale=scale)
    assert caught.value.argument == argument


@pytest.mark.parametrize(
    ("intrinsics", "pose", "argument"),
    [
        ({"fx": 1.0}, None, "intrinsics"),
        ({**CAMERA, "k1": 0.1}, None, "intrinsics"),
        ({**CAMERA, "fx": float("nan")}, None, "intrinsics"),
        (CAMERA, np.zeros((4, 4)), "T_cloud_camera"),
        (CAMERA, np.eye(3), "T_cloud_camera"),
    ],
)
def test_a_camera_that_is_none_is_refused(intrinsics: Any, pose: Any, argument: str) -> None:
    with pytest.raises(InvalidArgument) as caught:
        depth_request(np.ones((2, 2)), intrinsics, {}, T_cloud_camera=pose)
    assert caught.value.argument == argument


@settings(max_examples=30, deadline=None)
@given(npst.arrays(np.uint16, shapes), st.booleans(), st.booleans())
def test_the_service_reads_the_points_and_the_mask_that_the_client_means(
    counts: NDArray[np.uint16], as_files: bool, as_values: bool
) -> None:
    height, width = counts.shape
    intrinsics = CameraIntrinsics(width, height, fx=90.0, fy=80.0, cx=2.0, cy=1.0)
    k: Any = {name: getattr(intrinsics, name) for name in CAMERA}
    pose = Pose.look_at([0.1, 0.2, 0.3], [0, 0, 0], [0, 0, 1])
    mask = counts % 2 == 0
    request = depth_request(
        png(counts) if as_files else counts,
        intrinsics if as_values else k,
        {"seed": 3},
        mask=png(mask.astype(np.uint8)) if as_files else mask,
        T_cloud_camera=pose if as_values else pose.matrix.tolist(),
    )
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 1000)
    np.testing.assert_allclose(payload.points, pose.apply(intrinsics.back_project(counts * 0.001)), rtol=1e-5)
    assert payload.mask is not None
    np.testing.assert_array_equal(payload.mask != 0, mask.ravel())
    assert payload.options == {"seed": b"3"}


def test_options_that_outgrow_a_url_travel_in_a_form() -> None:
    points = np.arange(9000, dtype=np.float32).reshape(-1, 3)
    indices = np.arange(0, 3000, 2)
    request = points_request(points, {"target": {"indices": indices}, "seed": 1}, "r-1")
    assert (request.target, request.headers["X-Request-ID"]) == ("/grasps", "r-1")
    payload = decoder_for(request.headers["Content-Type"])(bytearray(request.content), 5000)
    np.testing.assert_array_equal(payload.points, points)
    assert json.loads(payload.options["target"]) == {"indices": indices.tolist()}
    assert points_request(points, {"target": {"indices": [1, 2]}}).target.startswith("/grasps?target=")


@pytest.mark.parametrize("largest", [0, 1, 254, 255, 256, 257, 65_534, 65_535])
@pytest.mark.parametrize("dtype", [np.int64, np.uint16, np.int32])
def test_a_label_never_becomes_another_wherever_the_image_gets_wider(largest: int, dtype: type) -> None:
    labels: NDArray[Any] = np.array([[largest, 0], [largest // 2, max(largest - 1, 0)]]).astype(dtype)
    levels = mask_levels(labels, (2, 2))
    assert levels.tolist() == labels.tolist()
    assert levels.dtype == (np.uint8 if largest <= 255 else np.uint16)


@settings(max_examples=60)
@given(npst.arrays(np.int64, shapes, elements=st.integers(0, 65_535)), st.sampled_from([1.0, 0.001, 0.00025, 1e-5]))
def test_metres_and_counts_of_one_image_are_one(counts: NDArray[np.int64], scale: float) -> None:
    """Also where metres lie up to almost half a count beside."""
    shift = np.where(counts > 0, np.linspace(-0.49, 0.49, counts.size).reshape(counts.shape), 0.0)
    np.testing.assert_array_equal(depth_counts(counts, scale), counts)
    np.testing.assert_array_equal(depth_counts((counts + np.where(counts < 65_535, shift, 0)) * scale, scale), counts)


@pytest.mark.parametrize(("scale", "fits"), [(1e-9, True), (1.0, True), (1.001, False), (0.0, False), (-1.0, False)])
def test_a_scale_is_at_most_a_metre_per_count(scale: float, fits: bool) -> None:
    counts = np.array([[65_535, 0]])
    if fits:
        assert depth_counts(counts, scale).tolist() == counts.tolist()
    else:
        with pytest.raises(InvalidArgument, match="depth_scale"):
            depth_counts(counts, scale)
