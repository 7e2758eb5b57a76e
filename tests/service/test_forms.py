"""Forms over a real server: cloud files, depth images, and what is wrong with them."""

from __future__ import annotations

import io
import json
import re
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from pypcd4.pypcd4 import Encoding, PointCloud

from client.form import File, encode_form
from service.payloads import Payload, build_query, decoder_for, parse_options
from tesnet.errors import TooManyPoints
from tests.depth_scene import SIZE, box_on_table
from tests.service.test_contract import steady
from tests.service.wire import npy, post_octets, problem_of
from tests.tesnet.test_formats import ply

Cloud = NDArray[np.float32]

OPTIONS: dict[str, Any] = {"viewpoint": [0.35, 0.0, 0.5], "up": [0, 0, 1], "support_height": 0.0, "max_candidates": 300}
INTRINSICS = {"fx": 300.0, "fy": 310.0, "cx": 79.5, "cy": 60.0}
T_CLOUD_CAMERA = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]
"""Half a metre above the table, looking down."""


def png(image: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def grey_head(width: int, height: int, bits: int = 16, colours: int = 0) -> bytes:
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colours, 0, 0, 0))


SIGNATURE = b"\x89PNG\r\n\x1a\n"


def bomb(side: int) -> bytes:
    """A PNG of side x side pixels, all zero, in a thousandth of their bytes."""
    rows = zlib.compressobj(9)
    data = b"".join(rows.compress(bytes(1 + 2 * side)) for _ in range(side)) + rows.flush()
    return SIGNATURE + grey_head(side, side) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def post(http: httpx.Client, files: dict[str, bytes], options: Any = None, query: str = "") -> httpx.Response:
    parts: dict[str, Any] = {name: (f"{name}.bin", content) for name, content in files.items()}
    if options is not None:
        text = options if isinstance(options, bytes) else json.dumps(options).encode()
        parts["options"] = (None, text, "application/json")
    return http.post(f"/grasps{query}", files=parts)


def pcd(points: Cloud, encoding: Encoding) -> bytes:
    file = io.BytesIO()
    PointCloud.from_xyz_points(points).save(file, encoding)
    return file.getvalue()


def test_every_cloud_file_gives_the_grasps_of_its_points(http: httpx.Client, cloud: Cloud) -> None:
    expected = steady(post_octets(http, cloud, **OPTIONS))
    assert expected["grasps"]
    files = {
        "npy": npy(cloud),
        "ply, little-endian": ply(cloud, "<"),
        "ply, big-endian": ply(cloud, ">", before=True),
        "pcd, binary": pcd(cloud, Encoding.BINARY),
        "pcd, compressed": pcd(cloud, Encoding.BINARY_COMPRESSED),
    }
    for name, content in files.items():
        assert steady(post(http, {"cloud": content}, OPTIONS).json()) == expected, name
    text = post(http, {"cloud": ply(cloud, "text")}, OPTIONS).json()
    assert text["counts"]["points"] == len(cloud)
    assert text["grasps"]


def test_options_may_stand_in_the_part_in_fields_and_in_the_url(http: httpx.Client, cloud: Cloud) -> None:
    expected = steady(post(http, {"cloud": npy(cloud)}, OPTIONS).json())
    fields = {name: (None, json.dumps(value).encode()) for name, value in OPTIONS.items() if name != "seed"}
    assert steady(http.post("/grasps", files={"cloud": npy(cloud), **fields}).json()) == expected
    some = {name: value for name, value in OPTIONS.items() if name != "max_candidates"}
    halves = post(http, {"cloud": npy(cloud)}, some, f"?max_candidates={OPTIONS['max_candidates']}")
    assert steady(halves.json()) == expected
    twice = post(http, {"cloud": npy(cloud)}, OPTIONS, "?max_candidates=3")
    assert problem_of(twice, 422, "give it once").field == "max_candidates"


def test_a_target_of_many_indices_is_the_box_around_them(http: httpx.Client, cloud: Cloud) -> None:
    on_box = np.flatnonzero(cloud[:, 2] > 0.001)
    answer = post(http, {"cloud": npy(cloud)}, {**OPTIONS, "target": {"indices": on_box.tolist()}}).json()
    assert answer["grasps"]
    in_json = http.post("/grasps", json={"points": cloud.tolist(), **OPTIONS, "target": {"indices": on_box.tolist()}})
    assert steady(in_json.json()) == steady(answer)
    beyond = post(http, {"cloud": npy(cloud)}, {"target": {"indices": [*range(5000), len(cloud)]}})
    assert problem_of(beyond, 422, f"index {len(cloud)}, but {len(cloud)} points").field == "target"


@pytest.mark.parametrize(
    ("indices", "word"),
    [
        ("[" + "0," * 5000 + "-1]", "negative"),
        ("[" + "0," * 5000 + "0.5]", "whole numbers"),
        ("[" + "0," * 5000 + "[0]]", "whole numbers"),
        ("[" + "0," * 5000 + "1" + "0" * 30 + "]", "whole numbers"),
        ('"' + "0," * 5000 + '0"', "target"),
        ("[" + "0," * 1_000_001 + "0]", "limit"),
        ("[" + "[]," * 1_000_000 + "[]]", "whole numbers"),
    ],
)
def test_indices_that_are_none_are_a_422(http: httpx.Client, cloud: Cloud, indices: str, word: str) -> None:
    answer = post(http, {"cloud": npy(cloud)}, f'{{"target": {{"indices": {indices}}}}}'.encode())
    assert problem_of(answer, 422, word).field == "target"


def test_a_depth_image_gives_grasps_on_what_its_mask_marks(http: httpx.Client) -> None:
    view = box_on_table()
    options = {**view.camera, "up": [0, 0, 1], "support_height": "auto", "max_candidates": 300}
    everything = post(http, {"depth": png(view.counts)}, options).json()
    assert everything["counts"]["points"] == np.count_nonzero(view.counts)
    assert not [note for note in everything["warnings"] if "viewpoint" in note]
    assert any("support_height auto: the plane at 0.000" in note for note in everything["warnings"])
    files = {"depth": png(view.counts), "mask": png(np.where(view.mask, 7, 0).astype(np.uint8))}
    marked = post(http, files, options).json()
    assert marked["grasps"]
    for grasp in marked["grasps"]:
        for point in (grasp["approach_point"], grasp["contact_point"]):
            assert (np.abs(np.array(point) - [0, 0, SIZE[2] / 2]) <= SIZE / 2 + 0.003).all()
    pixels = {"target": {"indices": np.flatnonzero(view.mask).tolist()}}
    assert steady(post(http, {"depth": png(view.counts)}, {**options, **pixels}).json()) == steady(marked)
    black = {"depth": png(view.counts), "mask": png(np.zeros(view.mask.shape, np.uint8))}
    assert post(http, black, options).json()["reason"] == "no_candidates"


def test_up_is_found_in_a_depth_image_and_in_a_cloud_where_it_is_asked_for(http: httpx.Client) -> None:
    view = box_on_table()
    image = {"depth": png(view.counts)}
    bare = post(http, image, {**view.camera, "max_candidates": 300}).json()
    (note,) = [note for note in bare["warnings"] if note.startswith("up auto: [")]
    assert "the plane at" in note
    assert steady(bare) == steady(post(http, image, {**view.camera, "up": "auto", "max_candidates": 300}).json())
    for grasp in bare["grasps"]:
        assert (np.abs(np.array(grasp["contact_point"]) - [0, 0, SIZE[2] / 2]) <= SIZE / 2 + 0.003).all()
    points = view.T_cloud_camera.apply(view.intrinsics.back_project(view.counts / 1000)).astype(np.float32)
    asked = {"viewpoint": view.T_cloud_camera.translation.tolist(), "up": "auto", "max_candidates": 300}
    in_query, in_json = (
        post_octets(http, points, **asked),
        http.post("/grasps", json={"points": points.tolist(), **asked}),
    )
    assert any(note.startswith("up auto: [") for note in in_query["warnings"])
    assert any(note.startswith("up auto: [") for note in in_json.json()["warnings"])
    without = post_octets(http, points, **{name: value for name, value in asked.items() if name != "up"})
    assert not any("up auto" in note for note in without["warnings"])


def test_depth_is_scaled_and_moved_as_the_camera_says() -> None:
    depth = np.zeros((3, 4), np.uint16)
    depth[1, 2], depth[2, 0] = 1000, 2000
    options = {"intrinsics": {"fx": 100, "fy": 50, "cx": 1, "cy": 0}, "depth_scale": 0.0005}
    form = httpx.Request("POST", "http://x", files={"depth": png(depth), "options": json.dumps(options).encode()})
    payload = decoded(form)
    expected = [[(2 - 1) / 100 * 0.5, 1 / 50 * 0.5, 0.5], [-1 / 100 * 1.0, 2 / 50 * 1.0, 1.0]]
    np.testing.assert_allclose(payload.points, expected, atol=1e-7)
    assert payload.is_point is not None
    assert np.flatnonzero(payload.is_point).tolist() == [6, 8]
    moved = {**options, "T_cloud_camera": T_CLOUD_CAMERA}
    again = decoded(
        httpx.Request("POST", "http://x", files={"depth": png(depth), "options": json.dumps(moved).encode()})
    )
    np.testing.assert_allclose(again.points, np.array(expected) * [1, -1, -1] + [0, 0, 0.5], atol=1e-7)
    assert again.viewpoint is not None
    assert again.viewpoint.tolist() == [0, 0, 0.5]


def decoded(form: httpx.Request) -> Payload:
    return decoder_for(form.headers["Content-Type"])(bytearray(form.read()), 1000)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([b"\r\n--", b"--b", b"\r\n--b", b"\r", b"\n", b"-", b"xyz", bytes(12)]), max_size=12))
def test_parts_come_out_as_they_went_in_whatever_looks_like_a_boundary(pieces: list[bytes]) -> None:
    points = np.frombuffer(b"".join(pieces).ljust(12 * 12, b"\x00")[: 12 * 12], "<f4").reshape(-1, 3)
    content = npy(points)
    head = b'--bound\r\nContent-Disposition: form-data; name="cloud"; filename="a"\r\n\r\n'
    body = bytearray(head + content + b"\r\n--bound--\r\n")
    payload = decoder_for("multipart/form-data; boundary=bound")(body, 1000)
    assert payload.points.tobytes() == points.tobytes()


VIEW = box_on_table()
DEPTH, MASK = png(VIEW.counts), png(VIEW.mask.astype(np.uint8))
CAMERA = {"intrinsics": INTRINSICS}

BAD_FORMS: dict[str, tuple[dict[str, bytes], Any, int, str]] = {
    "no file": ({}, {"up": [0, 0, 1]}, 422, "cloud: is missing"),
    "cloud and depth": ({"cloud": npy(np.zeros((1, 3))), "depth": DEPTH}, CAMERA, 422, "beside"),
    "mask and cloud": ({"cloud": npy(np.zeros((1, 3))), "mask": DEPTH}, None, 422, "target"),
    "camera and cloud": ({"cloud": npy(np.zeros((1, 3)))}, CAMERA, 422, "depth image"),
    "unknown part": ({"cluod": b"x"}, None, 422, "cluod"),
    "empty cloud": ({"cloud": b""}, None, 400, "empty"),
    "no cloud file": ({"cloud": b"PK\x03\x04"}, None, 400, "none of .npy"),
    "broken npy": ({"cloud": npy(np.zeros((9, 3)))[:-1]}, None, 400, "cut off"),
    "integer npy": ({"cloud": npy(np.zeros((9, 3), int))}, None, 422, "int64"),
    "NaN in npy": ({"cloud": npy(np.full((9, 3), np.nan))}, None, 422, "NaN"),
    "NaN in PLY": ({"cloud": ply(np.full((9, 3), np.nan, np.float32), "<")}, None, 422, "NaN"),
    "broken PLY": ({"cloud": b"ply\nend_header\n"}, None, 400, "format"),
    "PLY that claims a trillion points": (
        {"cloud": ply(np.zeros((9, 3), np.float32), "<").replace(b"vertex 9", b"vertex 999999999999")},
        None,
        413,
        "limit 1000000",
    ),
    "broken PCD": ({"cloud": b"VERSION 0.7\n"}, None, 400, "PCD"),
    "options that are no JSON": ({"cloud": npy(np.zeros((1, 3)))}, b'{"up": ', 400, "JSON"),
    "options that are a list": ({"cloud": npy(np.zeros((1, 3)))}, b"[1]", 422, "options"),
    "options nested": ({"cloud": npy(np.zeros((1, 3)))}, b'{"up": ' + b"[" * 90_000, 400, "nested"),
    "options with points": ({"cloud": npy(np.zeros((1, 3)))}, {"points": []}, 422, "points"),
    "options of many names": (
        {"cloud": npy(np.zeros((1, 3)))},
        ("{" + ",".join(f'"a{i}": 0' for i in range(100_000)) + "}").encode(),
        422,
        "a0",
    ),
    "depth without camera": ({"depth": DEPTH}, None, 422, "intrinsics"),
    "camera without fx": ({"depth": DEPTH}, {"intrinsics": {"fy": 1, "cx": 0, "cy": 0}}, 422, "fx"),
    "camera of no focal length": ({"depth": DEPTH}, {"intrinsics": {**INTRINSICS, "fx": 0}}, 422, "greater than 0"),
    "camera pose that is none": ({"depth": DEPTH}, {**CAMERA, "T_cloud_camera": [[2, 0, 0, 0]] * 4}, 422, "last row"),
    "camera pose that scales": (
        {"depth": DEPTH},
        {**CAMERA, "T_cloud_camera": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
        422,
        "no rotation",
    ),
    "depth scale of nothing": ({"depth": DEPTH}, {**CAMERA, "depth_scale": 0}, 422, "depth_scale"),
    "depth of metres per count": ({"depth": DEPTH}, {**CAMERA, "depth_scale": 1}, 422, "metres"),
    "depth that is no PNG": ({"depth": b"\xff\xd8\xff\xe0 a JPEG, for example"}, CAMERA, 400, "PNG"),
    "depth of 8 bits": ({"depth": MASK}, CAMERA, 422, "8 bits"),
    "depth cut off behind its head": ({"depth": DEPTH[:40]}, CAMERA, 400, "PNG (no pixels"),
    "depth in colours": ({"depth": png(np.zeros((4, 4, 3), np.uint8))}, CAMERA, 422, "coloured"),
    "depth cut off": ({"depth": DEPTH[:-40]}, CAMERA, 400, "damaged"),
    "depth of no pixels": ({"depth": SIGNATURE + grey_head(0, 5) + bytes(20)}, CAMERA, 400, "PNG"),
    "depth that claims 4 billion squared": ({"depth": SIGNATURE + grey_head(2**31, 2**31)}, CAMERA, 413, "limit"),
    "depth with a second head": (
        {"depth": SIGNATURE + grey_head(4, 4) + grey_head(40_000, 40_000) + chunk(b"IDAT", b"")},
        CAMERA,
        400,
        "PNG",
    ),
    "depth with a text that expands": (
        {
            "depth": SIGNATURE
            + grey_head(4, 4)
            + chunk(b"zTXt", b"k\x00\x00" + zlib.compress(bytes(90_000_000), 9))
            + chunk(b"IDAT", zlib.compress(bytes(36)))
            + chunk(b"IEND", b"")
        },
        CAMERA,
        400,
        "damaged",
    ),
    "a bomb": ({"depth": bomb(3000)}, CAMERA, 413, "3000 x 3000 pixels (limit 8500000"),
    "too many points in a depth image": ({"depth": png(np.ones((1001, 1000), np.uint16))}, CAMERA, 413, "1001000"),
    "mask of another size": ({"depth": DEPTH, "mask": png(VIEW.mask[1:].astype(np.uint8))}, CAMERA, 422, "200 x 159"),
    "label without a mask": ({"depth": DEPTH}, {**CAMERA, "target": {"label": 1}}, 422, "no file `mask`"),
    "intrinsics of shares": (
        {"depth": DEPTH},
        {"intrinsics": {"fx": 0.9, "fy": 0.9, "cx": 0.5, "cy": 0.5}},
        422,
        "shares of the image's size",
    ),
    "counts of millimetres as metres": ({"depth": DEPTH}, {**CAMERA, "depth_scale": 1.0}, 422, "depth_scale"),
    "stride of nothing": ({"depth": DEPTH}, {**CAMERA, "stride": 0}, 422, "stride"),
    "view index of another length": (
        {"cloud": npy(np.zeros((9, 3), np.float32)), "view_index": npy(np.zeros(8, np.uint8))},
        {},
        422,
        "8 entries for 9",
    ),
    "view index of an unknown viewpoint": (
        {"cloud": npy(np.zeros((9, 3), np.float32)), "view_index": npy(np.ones(9, np.uint8))},
        {},
        422,
        "1 viewpoints",
    ),
    "normals of pairs": (
        {"cloud": npy(np.zeros((9, 3), np.float32)), "normals": npy(np.zeros((9, 2), np.float32))},
        {},
        422,
        "normals",
    ),
    "no finite point": ({"cloud": npy(np.full((9, 3), np.nan, np.float32))}, {}, 422, "all of them NaN"),
    "mask that is none": ({"depth": DEPTH, "mask": b"mask"}, CAMERA, 400, "mask"),
    "mask and target": (
        {"depth": DEPTH, "mask": MASK},
        {**CAMERA, "target": {"indices": [1]}},
        422,
        "give one",
    ),
}


@pytest.mark.parametrize("case", BAD_FORMS)
def test_a_bad_form_is_refused_with_the_reason(http: httpx.Client, case: str) -> None:
    files, options, status, words = BAD_FORMS[case]
    problem_of(post(http, files, options), status, words)


@pytest.mark.parametrize(
    ("content_type", "body", "status", "words"),
    [
        ("multipart/form-data", b"x", 400, "boundary"),
        ("multipart/form-data; boundary=" + "b" * 71, b"x", 400, "boundary"),
        ("multipart/form-data; boundary=b", b"", 400, "empty"),
        ("multipart/form-data; boundary=b", b"x", 400, "form"),
        ("multipart/form-data; boundary=b", b"--b\r\n", 400, "cut off"),
        ("multipart/form-data; boundary=b", b"--b\r\nA: b\r\n\r\nx\r\n--b--\r\n", 400, "no name"),
        ("multipart/form-data; boundary=b", b"--b\r\n" + b"A" * 100_000 + b": b\r\n\r\nx\r\n--b--\r\n", 400, "form"),
        ("multipart/form-data; boundary=b", b"--b\r\n" + b"A: b\r\n" * 100_000 + b"\r\nx\r\n--b--\r\n", 400, "form"),
        (
            "multipart/form-data; boundary=b",
            b'--b\r\nContent-Disposition: form-data; name="seed"\r\n\r\n1\r\n' * 2 + b"--b--\r\n",
            422,
            "twice",
        ),
    ],
)
def test_what_is_no_form_is_refused(
    http: httpx.Client, content_type: str, body: bytes, status: int, words: str
) -> None:
    problem_of(http.post("/grasps", content=body, headers={"Content-Type": content_type}), status, words)


def test_a_pcd_without_some_pixels_counts_its_rows_for_targets(http: httpx.Client, cloud: Cloud) -> None:
    rows = np.insert(cloud, np.arange(0, len(cloud), 3), np.nan, axis=0)
    on_box = np.flatnonzero(rows[:, 2] > 0.001).tolist()
    content = pcd(rows, Encoding.BINARY)
    answer = post(http, {"cloud": content}, {**OPTIONS, "target": {"indices": on_box}}).json()
    expected = post(
        http, {"cloud": npy(cloud)}, {**OPTIONS, "target": {"indices": np.flatnonzero(cloud[:, 2] > 0.001).tolist()}}
    ).json()
    assert answer["counts"].pop("ignored_points") == len(rows) - len(cloud)
    assert expected["counts"].pop("ignored_points") == 0
    assert steady(answer) == steady(expected)


def test_depth_as_npy_of_metres_and_of_counts_is_the_depth_of_a_png(http: httpx.Client) -> None:
    view = box_on_table()
    options = {**view.camera, "up": [0, 0, 1], "support_height": 0.0, "max_candidates": 300}
    expected = steady(post(http, {"depth": png(view.counts)}, options).json())
    assert expected["grasps"]
    metres = np.where(view.counts, view.counts / 1000, -1.0)
    for depth in (view.counts.astype(np.int32), view.counts[..., None], metres):
        assert steady(post(http, {"depth": npy(depth)}, options).json()) == expected
    gaps = np.where(view.counts, metres, np.nan)
    assert steady(post(http, {"depth": npy(gaps)}, {**options, "depth_scale": 0.5}).json()) == expected


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_label_of_a_mask_is_the_target(http: httpx.Client, dtype: type) -> None:
    view = box_on_table()
    options = {**view.camera, "up": [0, 0, 1], "support_height": "auto", "max_candidates": 300}
    expected = post(http, {"depth": png(view.counts), "mask": png(view.mask.astype(np.uint8))}, options).json()
    label = 3 if dtype == np.uint8 else 40_000
    labels: NDArray[Any] = np.where(view.mask, label, 7).astype(dtype)
    for mask in (png(labels), npy(labels)):
        answer = post(http, {"depth": png(view.counts), "mask": mask}, {**options, "target": {"label": label}}).json()
        assert steady(answer) == steady(expected)
    absent = post(http, {"depth": png(view.counts), "mask": png(labels)}, {**options, "target": {"label": 9}}).json()
    assert absent["grasps"] == []
    words = f"no pixel of the mask has; labels there: {min(label, 7)}, {max(label, 7)}"
    assert any(words in warning for warning in absent["warnings"])
    assert not re.search("inches|unit|depth_scale|measures|metres", " ".join(absent["warnings"]))


def test_a_stride_uses_every_so_many_th_pixel(http: httpx.Client) -> None:
    view = box_on_table()
    coarse = np.zeros_like(view.counts)
    coarse[::3, ::3] = view.counts[::3, ::3]
    expected = post(http, {"depth": png(coarse)}, view.camera).json()
    answer = post(http, {"depth": png(view.counts)}, {**view.camera, "stride": 3}).json()
    assert answer["counts"]["points"] == np.count_nonzero(coarse)
    assert answer["grasps"] == expected["grasps"]


def test_a_pose_of_three_decimals_is_made_orthonormal(http: httpx.Client) -> None:
    view = box_on_table()
    rounded = {**view.camera, "T_cloud_camera": view.T_cloud_camera.matrix.round(3).tolist()}
    answer = post(http, {"depth": png(view.counts)}, {**rounded, "up": [0, 0, 1], "support_height": 0.002}).json()
    assert answer["grasps"]
    coarse = {**view.camera, "T_cloud_camera": view.T_cloud_camera.matrix.round(1).tolist()}
    assert problem_of(post(http, {"depth": png(view.counts)}, coarse), 422, "decimals").field == "T_cloud_camera"


def test_the_limit_of_points_concerns_those_that_matter() -> None:
    decode = form_decoder({"cloud": npy(np.linspace(0, 1, 300, dtype=np.float32).reshape(100, 3))})
    for options, count in (({}, 100), ({"workspace": {"min": [-1, -1, -1], "max": [0.1, 2, 2]}}, 10)):
        payload = decode(options)
        build_query(payload, parse_options(payload.options), count)
        with pytest.raises(TooManyPoints, match=rf"{count} points \(limit {count - 1}\)"):
            build_query(payload, parse_options(payload.options), count - 1)


def test_an_image_of_too_many_points_has_stride_workspace_and_mask_named() -> None:
    image = np.full((30, 40), 500, np.uint16)
    options = {"intrinsics": {"fx": 40.0, "fy": 40.0, "cx": 20.0, "cy": 15.0}}
    payload = form_decoder({"depth": npy(image)})(options)
    with pytest.raises(
        TooManyPoints, match=r"use 3 times its `stride`, or give a `workspace` or the `mask`"
    ) as refused:
        build_query(payload, parse_options(payload.options), 140)
    assert refused.value.field == "depth"
    coarser = form_decoder({"depth": npy(image)})({**options, "stride": 3})
    build_query(coarser, parse_options(coarser.options), 140)


def test_a_mask_that_is_no_mask_is_told_to_be_of_whole_numbers(http: httpx.Client) -> None:
    view = box_on_table()
    floats = np.zeros(view.counts.shape)
    problem = problem_of(
        post(http, {"depth": png(view.counts), "mask": npy(floats)}, view.camera), 422, "whole numbers"
    )
    assert problem.field == "mask"


def test_an_image_of_eight_million_pixels_takes_little_more_memory_than_its_points() -> None:
    image = np.full((2160, 3840), 500, np.uint16)
    decode = form_decoder({"depth": npy(image)})
    options = {"intrinsics": {"fx": 2000.0, "fy": 2000.0, "cx": 1920.0, "cy": 1080.0}}
    decode(options)
    tracemalloc.start()
    try:
        payload = decode(options)
        points = payload.points.nbytes
        assert tracemalloc.get_traced_memory()[1] < 2.5 * points
    finally:
        tracemalloc.stop()
    assert len(payload.points) == image.size


def test_the_viewpoint_of_a_file_is_used_unless_another_one_is_given(http: httpx.Client, cloud: Cloud) -> None:
    file = PointCloud.from_xyz_points(cloud)
    file.metadata.viewpoint = (*OPTIONS["viewpoint"], 1.0, 0.0, 0.0, 0.0)
    content = io.BytesIO()
    file.save(content, Encoding.BINARY)
    without = {name: value for name, value in OPTIONS.items() if name != "viewpoint"}
    expected = post(http, {"cloud": npy(cloud)}, OPTIONS).json()
    answer = post(http, {"cloud": content.getvalue()}, without).json()
    assert answer["grasps"] == expected["grasps"]
    assert answer["warnings"] == ["viewpoint is that of the file: [0.35, 0, 0.5]"]
    other = post(http, {"cloud": content.getvalue()}, {**OPTIONS, "viewpoint": [0, 0.1, 0.5]}).json()
    assert other["warnings"] == ["the viewpoint [0.35, 0, 0.5] of the file is ignored, since viewpoint is given"]


def test_view_index_and_normals_mean_the_same_in_every_body(http: httpx.Client, cloud: Cloud) -> None:
    views = {**OPTIONS, "viewpoint": [OPTIONS["viewpoint"], [-0.35, 0, 0.5]]}
    index = (cloud[:, 0] < 0).astype(np.int32)
    normals = np.where(cloud[:, 2:] > 0.001, cloud, 0).astype(np.float32)
    plain = steady(post(http, {"cloud": npy(cloud)}, views).json())
    for name, array in (("view_index", index), ("normals", normals)):
        told = steady(post(http, {"cloud": npy(cloud), name: npy(array)}, views).json())
        assert told["grasps"] != plain["grasps"]
        in_text = steady(post(http, {"cloud": npy(cloud), name: json.dumps(array.tolist()).encode()}, views).json())
        in_json = steady(http.post("/grasps", json={"points": cloud.tolist(), name: array.tolist(), **views}).json())
        assert told == in_text == in_json
        tensors = [
            {"name": "points", "datatype": "FP32", "shape": list(cloud.shape), "data": cloud.ravel().tolist()},
            {
                "name": name,
                "datatype": "INT32" if name == "view_index" else "FP32",
                "shape": list(array.shape),
                "data": array.ravel().tolist(),
            },
        ]
        body = {"inputs": tensors, "parameters": {key: json.dumps(value) for key, value in views.items()}}
        outputs = http.post("/v2/models/tesnet/infer", json=body).json()["outputs"]
        scores = next(output["data"] for output in outputs if output["name"] == "scores")
        assert scores == [grasp["score"] for grasp in told["grasps"]]


def test_a_far_cloud_has_the_grasps_of_a_near_one(http: httpx.Client, cloud: Cloud) -> None:
    offset = np.array([460_000.0, 5_402_000.0, 100.0])
    exact = cloud.astype(np.float64)
    near = post(http, {"cloud": npy(exact)}, {**OPTIONS, "max_grasps": 3}).json()
    place = {"viewpoint": (OPTIONS["viewpoint"] + offset).tolist(), "support_height": 100.0}
    options = {**OPTIONS, **place, "max_grasps": 3}
    bodies = [
        post(http, {"cloud": npy(exact + offset)}, options),
        http.post("/grasps", json={"points": (exact + offset).tolist(), **options}),
    ]
    assert near["grasps"]
    for answer in bodies:
        found = answer.json()
        assert [grasp["score"] for grasp in found["grasps"]] == pytest.approx(
            [grasp["score"] for grasp in near["grasps"]], abs=1e-3
        )
        for far_grasp, near_grasp in zip(found["grasps"], near["grasps"], strict=True):
            np.testing.assert_allclose(far_grasp["position"] - offset, near_grasp["position"], atol=1e-5)


def test_the_viewer_is_shown_the_points_of_a_far_cloud_where_they_are(http: httpx.Client) -> None:
    far = np.array([[460_000.0, 5_402_000.0, 100.0], [460_001.0, 5_402_000.5, 100.25]])
    shown = np.frombuffer(http.post("/viewer/points", json={"points": far.tolist()}).content, "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(shown, far.astype(np.float32))


def test_what_looks_like_a_mistake_is_a_warning(http: httpx.Client, cloud: Cloud) -> None:
    view = box_on_table()
    k = view.camera["intrinsics"]
    shifted = {**view.camera, "intrinsics": {**k, "cx": 60.0}}
    exchanged = {**view.camera, "intrinsics": {**k, "cx": 80.0, "cy": 100.0}}
    suspicions = {
        "cx and cy exchanged": ({"depth": png(view.counts)}, exchanged),
        "off the middle": ({"depth": png(view.counts)}, shifted),
        "0.0001": ({"depth": png(10 * view.counts)}, view.camera),
        "1/5000 m": ({"depth": png(5 * view.counts)}, view.camera),
        "centimetres": ({"cloud": npy(cloud[cloud[:, 2] > 0.001] * np.float32(100))}, {"viewpoint": [35, 0, 50]}),
        "inches": ({"cloud": npy(cloud[cloud[:, 2] > 0.001] * np.float32(39.37))}, {"viewpoint": [14, 0, 20]}),
        "reverse it": ({"cloud": npy(cloud)}, {**OPTIONS, "up": [0, 0, -1]}),
    }
    for words, (files, options) in suspicions.items():
        answer = post(http, files, options)
        assert answer.status_code == 200, answer.text
        assert any(words in warning for warning in answer.json()["warnings"]), (words, answer.json()["warnings"])


@pytest.mark.parametrize("times", [0.1, 5, 10])
@pytest.mark.parametrize("target", [None, {"box": {"min": [-9, -9, -9], "max": [9, 9, 9]}}])
def test_of_a_wrong_depth_scale_an_answer_says_one_thing(
    http: httpx.Client, times: float, target: dict[str, Any] | None
) -> None:
    view = box_on_table()
    options = {**view.camera, "depth_scale": 0.001 * times, "target": target, "max_candidates": 300}
    warnings = post(http, {"depth": png(view.counts)}, options).json()["warnings"]
    (said,) = [warning for warning in warnings if "depth_scale" in warning]
    assert "need 0.001 (then" in said
    assert not [warning for warning in warnings if re.search("multiply|divide|in metres|unit|inches", warning)]


@pytest.mark.parametrize("names", ["x,y,z", "X Y Z intensity"])
def test_text_with_names_of_columns_is_refused_with_the_line_and_the_remedy(
    http: httpx.Client, cloud: Cloud, names: str
) -> None:
    rows = "\n".join(",".join(map(str, row)) for row in cloud[:100].tolist())
    answer = post(http, {"cloud": f"{names}\n{rows}".encode()}, {})
    problem_of(answer, 400, "in line 1, which is no point; delete it or begin it with #")
    assert post(http, {"cloud": f"# {names}\n{rows}".encode()}, {}).status_code == 200


def form_decoder(files: dict[str, bytes]) -> Callable[[dict[str, Any]], Payload]:
    """Decodes a form of these files and of options."""

    def decode(options: dict[str, Any]) -> Payload:
        parts = [File(name, f"{name}.bin", content) for name, content in files.items()]
        content_type, body = encode_form([*parts, File("options", None, json.dumps(options).encode())])
        return decoder_for(content_type)(bytearray(body), 1_000_000)

    return decode


@pytest.mark.parametrize(("place", "value"), [(26, 7), (26, 1), (27, 1), (28, 2)])
def test_a_png_of_a_method_that_there_is_not_is_a_400(http: httpx.Client, place: int, value: int) -> None:
    """Of compression, filtering and interlacing (PNG specification, 11.2.2); the head's checksum is right."""
    image = bytearray(DEPTH)
    image[place] = value
    image[29:33] = struct.pack(">I", zlib.crc32(image[12:29]))
    problem_of(post(http, {"depth": bytes(image)}, CAMERA), 400, "methods", str(value))


def test_the_service_is_well_after_bad_forms(http: httpx.Client) -> None:
    assert 'status="500"' not in http.get("/metrics").text
