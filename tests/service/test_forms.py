"""Forms over a real server: cloud files, depth images, and what is wrong with them."""

from __future__ import annotations

import io
import json
import struct
import zlib
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from pypcd4.pypcd4 import Encoding, PointCloud

from service.payloads import Payload, decoder_for
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
    "a bomb": ({"depth": bomb(3000)}, CAMERA, 413, "3000 x 3000 pixels (limit 4000000"),
    "too many points in a depth image": ({"depth": png(np.ones((1001, 1000), np.uint16))}, CAMERA, 413, "1001000"),
    "mask of another size": ({"depth": DEPTH, "mask": png(VIEW.mask[1:].astype(np.uint8))}, CAMERA, 422, "200 x 159"),
    "mask of 16 bits": ({"depth": DEPTH, "mask": DEPTH}, CAMERA, 422, "16 bits"),
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
    assert steady(answer) == steady(expected)


def test_the_service_is_well_after_bad_forms(http: httpx.Client) -> None:
    assert 'status="500"' not in http.get("/metrics").text
