"""Decoders by themselves: what they give for every cloud, however it is cut into pieces."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import json
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import Invalid, ServiceError, Undecodable
from service.payloads import (
    CONTENT_TYPES,
    Payload,
    build_query,
    decoder_for,
    depth_image,
    json_object,
    parse_options,
    parse_query_string,
)
from service.payloads.json_body import decode_json
from service.payloads.options import unknown_option
from service.payloads.payload import cloud_payload, kept, most_rows
from service.payloads.per_point import known_normals
from tesnet.errors import TesnetError, TooManyPoints
from tesnet.geometry import Box, Gripper, Pose
from tesnet.query import FAR, GraspQuery

coordinates = st.floats(-10, 10, width=32) | st.integers(-10, 10)
clouds = st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=40)
layouts = st.sampled_from([(",", ":"), (", ", ": "), (" ,\n\t", " :\r\n")])


@given(clouds, layouts, st.integers(1, 60))
def test_json_points_are_the_same_however_they_are_cut(
    cloud: list[tuple[float, float, float]], layout: tuple[str, str], chunk: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_object, "CHUNK", chunk)
        body = bytearray(json.dumps({"seed": 1, "points": cloud, "up": [0, 0, 1]}, separators=layout).encode())
        payload = decode_json(body, 1000)
    np.testing.assert_array_equal(payload.points, np.array(cloud, np.float32).reshape(-1, 3))
    assert payload.points.dtype == np.float32
    assert {name: json.loads(value) for name, value in payload.options.items()} == {"seed": 1, "up": [0, 0, 1]}


anything: Any = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats(-9, 9) | st.text('[]{},:"\\ a1', max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("ab]", max_size=2), inner, max_size=3),
    max_leaves=20,
)


@given(anything, st.integers(1, 20))
def test_json_that_is_no_cloud_is_refused_however_it_is_cut(points: Any, chunk: int) -> None:
    triples = isinstance(points, list) and all(
        isinstance(point, list) and len(point) == 3 and all(type(value) in (int, float) for value in point)
        for point in points
    )
    body = bytearray(json.dumps({"points": points}).encode())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_object, "CHUNK", chunk)
        if triples:
            assert len(decode_json(body, 1000).points) == len(points)
        else:
            with pytest.raises(Invalid, match=r"^points: "):
                decode_json(body, 1000)


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_what_the_table_of_problems_knows(body: bytes) -> None:
    part = b'--b\r\nContent-Disposition: form-data; name="cloud"\r\n\r\n'
    prefixes = (
        b"",
        b'{"points": [[',
        b"\x93NUMPY\x01\x00",
        b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', ",
        b"--b\r\n",
        part,
        part + b"ply\n",
        part + b"FIELDS x y z\n",
    )
    for kind in CONTENT_TYPES:
        decode = decoder_for(f"{kind}; boundary=b")
        for prefix, suffix in itertools.product(prefixes, (b"", b"\r\n--b--\r\n")):
            try:
                payload = decode(bytearray(prefix + body + suffix), 1000)
            except (ServiceError, TesnetError):
                continue
            assert payload.points.shape[1:] == (3,)


def test_a_bad_point_is_counted_from_the_start_of_the_cloud(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_object, "CHUNK", 20)
    points: list[Any] = [[0, 0, 1]] * 50
    points[37] = [0, 0, None]
    with pytest.raises(Invalid, match="point 37"):
        decode_json(bytearray(json.dumps({"points": points}).encode()), 1000)


def test_decoding_stops_at_the_first_point_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_object, "CHUNK", 20)
    body = bytearray(b'{"points": [' + b"[0,0,1]," * 100 + b"null]}")
    with pytest.raises(TooManyPoints, match="limit"):
        decode_json(body, 10)


@pytest.mark.parametrize(
    "points",
    [
        "[[1, 2, 0.3 4]]",
        "[[1,2,3],[4,5,0.3\n4]]",
        "[[1,2,3]4,[5,6,7]]",
        "[[1,2,3],4[5,6,7]]",
        "[[1,2,3]4]",
        "[4[1,2,3]]",
        "[[1,2,3],-\n[4,5,6]]",
    ],
)
def test_digits_that_no_json_number_holds_are_not_joined_to_one(points: str) -> None:
    with pytest.raises((Undecodable, Invalid)):
        decode_json(bytearray(b'{"points": %b}' % points.encode()), 1000)


@pytest.mark.parametrize("chunk", range(1, 20))
def test_a_comma_that_nothing_follows_is_refused_wherever_it_is_cut(
    monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr(json_object, "CHUNK", chunk)
    with pytest.raises((Undecodable, Invalid)):
        decode_json(bytearray(b'{"points": [[1,2,3],[4,5,6], ]}'), 1000)
    spaces = b" " * 10_000  # else a target is read in one go
    with pytest.raises((Undecodable, Invalid)):
        parse_options({"target": b'{"indices": [0,1, ]}' + spaces}, 1000)


def test_a_long_target_that_is_no_json_is_undecodable_like_a_short_one() -> None:
    with pytest.raises(Undecodable):
        parse_options({"target": b'{"box": {"min": [0,0,0], "max": [1,1 1]}}' + b" " * 10_000}, 1000)


NUMBERS = json.dumps(np.random.default_rng(0).uniform(-1, 1, (40_000, 3)).tolist()).encode()
INDICES = json.dumps(list(range(400_000))).encode()


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("application/json", b'{"points": %b, "seed": 1}' % NUMBERS),
        ("application/json", b'{"points": %b}' % NUMBERS[:-1]),
        ("application/json", b'{"points": %b, "seed": NaN}' % NUMBERS),
        ("application/json", b'{"points": %b' % NUMBERS.replace(b"], [", b", ")),
        ("application/json", NUMBERS),
        ("application/json", b'{"points": [], "target": {"indices": %b}}' % INDICES),
        ("application/json", b'{"points": [], "sed": 1, "target": {"indices": %b}}' % INDICES),
        (
            "multipart/form-data; boundary=b",
            b'--b\r\nContent-Disposition: form-data; name="target"\r\n\r\n{"indices": %b}\r\n--b--\r\n' % INDICES,
        ),
    ],
    ids=["points", "cut off", "NaN behind", "no triples", "no object", "indices", "unknown name", "indices in a form"],
)
def test_no_text_is_copied_as_a_whole(kind: str, body: bytes) -> None:
    """A copy, and a parser that goes over everything in one call, would keep the interpreter from all other threads."""
    text, decode = bytearray(body), decoder_for(kind)
    with contextlib.suppress(ServiceError):
        decode(bytearray(b"{}"), 1)  # what the first request alone takes
    tracemalloc.start()
    with contextlib.suppress(ServiceError):
        parse_options(decode(text, 100_000).options, 100_000)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < len(text)


@given(layouts, st.permutations(["points", "seed", "workspace", "unseen"]))
def test_the_members_of_an_object_are_found_whatever_their_order_and_white_space(
    layout: tuple[str, str], order: list[str]
) -> None:
    values = {
        "points": [[0, 0, 1], [1, 0, 1]],
        "seed": 7,
        "workspace": {"min": [0, 0, 0], "max": [1, 1, 1]},
        "unseen": 'a "]}" \\',
    }
    text = f" \n{json.dumps({name: values[name] for name in order}, separators=layout)}\t".encode()
    found = json_object.members(json_object.Span.of(text), "body", values, unknown_option)
    assert {name: json.loads(bytes(span)) for name, span in found.items()} == values
    for cut in range(len(text.rstrip())):
        with pytest.raises(ServiceError):
            json_object.members(json_object.Span(text, 0, cut), "body", values, unknown_option)


@pytest.mark.parametrize(
    ("body", "name"),
    [
        (b'{"seed": 1, "points": [], "seed": 2}', "seed"),
        (b'{"points": [], "points": []}', "points"),
        (b'{"s\\u0065ed": 1, "seed": 1}', "seed"),
        (b'{"points": [], "workspace": {"min": [0, 0, 0], "max": [1, 1, 1], "min": [0, 0, 0]}}', "min"),
        (b'{"points": [], "target": {"indices": [0], "indices": [' + b"0," * 9000 + b"0]}}", "indices"),
    ],
)
def test_a_name_that_is_given_twice_is_refused_as_in_query_strings(body: bytes, name: str) -> None:
    with pytest.raises(Invalid, match=f"^{name}: is given twice"):
        parse_options(decode_json(bytearray(body), 10_000).options, 10_000)


def test_query_strings_hold_json_and_plain_words() -> None:
    raw = parse_query_string(b"viewpoint=%5B0.3,0,0.6%5D&up=[0,+0,%201]&unseen=occupied&seed=7&&model=%22tesnet%22")
    options = parse_options(raw)
    assert options.viewpoint == (0.3, 0.0, 0.6)
    assert options.up == (0.0, 0.0, 1.0)
    assert (options.unseen, options.seed, options.model) == ("occupied", 7, "tesnet")


def test_options_arrive_in_the_query_and_defaults_are_the_library_s_own() -> None:
    points = np.zeros((4, 3), np.float32)
    default, library = build_query(Payload(points), parse_options({})), GraspQuery(points)
    for name in GraspQuery.__slots__:
        if name != "points":
            assert getattr(default, name) == getattr(library, name), name

    raw = {
        "viewpoint": b"[[0, 0, 1], [1, 0, 1]]",
        "up": b"[0, 0, 2]",
        "workspace": b'{"min": [0, 0, 0], "max": [1, 2, 3]}',
        "support_height": b"0.25",
        "approach": b'{"direction": [0, 0, -1], "max_angle_deg": 30}',
        "max_grasps": b"3",
        "min_score": b"0.5",
        "min_separation": b'{"rotation_deg": 40}',
        "num_approach_points": b"8",
        "max_candidates": b"99",
        "target": b'{"box": {"min": [0, 0, 0], "max": [1, 1, 1]}}',
        "gripper": b'{"max_width": 0.05, "finger_thickness": 0.01}',
        "unseen": b'"occupied"',
        "seed": b"5",
    }
    query = build_query(Payload(points), parse_options(raw))
    assert query.viewpoints is not None
    assert query.viewpoints.tolist() == [[0, 0, 1], [1, 0, 1]]
    assert query.known_up is not None
    assert query.known_up.tolist() == [0, 0, 1]
    assert query.workspace is not None
    assert query.workspace.maximum.tolist() == [1, 2, 3]
    assert query.approach is not None
    assert query.approach.max_angle_deg == 30
    assert (query.support_height, query.max_grasps, query.min_score) == (0.25, 3, 0.5)
    assert (query.separation_translation, query.separation_rotation_deg) == (0.01, 40)
    assert (query.num_approach_points, query.max_candidates, query.unseen, query.seed) == (8, 99, "occupied", 5)
    assert isinstance(query.target, Box)
    assert query.target.maximum.tolist() == [1, 1, 1]
    assert query.gripper == Gripper(max_width=0.05, finger_thickness=0.01, finger_tip_thickness=0.01)


@st.composite
def gappy(draw: st.DrawFn) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Rows (R, 3) of which some, anywhere, hold NaN or an infinity; and which are points."""
    count = draw(st.integers(1, 12))
    is_point = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count).filter(any)))
    rows = np.arange(3.0 * count).reshape(count, 3).astype(np.float32) / 10
    for row in np.flatnonzero(~is_point):
        rows[row, draw(st.integers(0, 2))] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    return rows, is_point


@given(gappy(), st.data())
def test_what_belongs_to_a_row_stays_with_it_whichever_rows_are_no_points(
    cloud: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]], data: st.DataObject
) -> None:
    rows, is_point = cloud
    count = len(rows)
    view_index = np.array(data.draw(st.lists(st.integers(0, 2), min_size=count, max_size=count)))
    indices = data.draw(st.lists(st.integers(0, count - 1), min_size=1, unique=True))
    normals = np.eye(3, dtype=np.float32)[view_index]
    raw = {
        "viewpoint": b"[[0, 0, 1], [1, 0, 1], [0, 1, 1]]",
        "target": json.dumps({"indices": indices}).encode(),
    }
    payload = cloud_payload(rows, raw, {"view_index": view_index, "normals": normals})
    query = build_query(payload, parse_options(payload.options))
    assert query.view_index is not None
    assert query.normals is not None
    assert query.ignored_points == int((~is_point).sum())
    expected = [row for row in range(count) if is_point[row]]
    assert query.points.tolist() == [rows[row].tolist() for row in expected]
    assert query.view_index.tolist() == [view_index[row] for row in expected]
    assert query.normals.tolist() == [normals[row].tolist() for row in expected]
    assert isinstance(query.target, np.ndarray)
    assert query.target.tolist() == [row in indices for row in expected]


@given(gappy(), st.data())
def test_a_label_marks_the_points_of_the_rows_that_have_it(
    cloud: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]], data: st.DataObject
) -> None:
    rows, is_point = cloud
    labels = np.array(data.draw(st.lists(st.integers(0, 3), min_size=len(rows), max_size=len(rows))))
    wanted = data.draw(st.sampled_from([None, 0, 1, 2, 3]))
    raw = {} if wanted is None else {"target": json.dumps({"label": wanted}).encode()}
    payload = dataclasses.replace(cloud_payload(rows, raw), mask=labels)
    query = build_query(payload, parse_options(payload.options))
    assert isinstance(query.target, np.ndarray)
    marked = [bool(labels[row]) if wanted is None else labels[row] == wanted for row in range(len(rows))]
    assert query.target.tolist() == [marked[row] for row in range(len(rows)) if is_point[row]]
    assert any("which no pixel of the mask has" in note for note in query.notes) == (
        wanted is not None and not any(marked)
    )


@pytest.mark.parametrize("given_one", [None, [0.5, 0.0, 0.7], [[0.5, 0.0, 0.7], [0.0, 0.5, 0.7]], [0.25, 0.0, 0.5]])
@pytest.mark.parametrize("of_file", [None, [0.25, 0.0, 0.5]])
@pytest.mark.parametrize("of_image", [None, [0.0, 0.0, 0.125]])
def test_a_viewpoint_that_is_asked_for_goes_before_that_of_the_file_and_that_before_the_image_s(
    given_one: Any, of_file: Any, of_image: Any
) -> None:
    payload = Payload(
        np.zeros((4, 3), np.float32),
        options={} if given_one is None else {"viewpoint": json.dumps(given_one).encode()},
        viewpoint=None if of_image is None else np.array(of_image),
        file_viewpoint=None if of_file is None else np.array(of_file),
    )
    query = build_query(payload, parse_options(payload.options))
    expected = next((one for one in (given_one, of_file, of_image) if one is not None), None)
    if expected is None:
        assert query.viewpoints is None
    else:
        assert query.viewpoints is not None
        assert query.viewpoints.tolist() == np.array(expected).reshape(-1, 3).tolist()
    told = [note for note in query.notes if "of the file" in note]
    if of_file is None or given_one == of_file:
        assert told == []
    else:
        (note,) = told
        assert "[0.25, 0, 0.5]" in note
        assert ("is ignored" in note) == (given_one is not None)
    assert (query.up == "auto") == (of_image is not None)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
@given(st.data())
@settings(max_examples=40, deadline=None)
def test_a_depth_image_gives_the_points_of_a_loop_over_its_pixels(kind: type[np.generic], data: st.DataObject) -> None:
    """Of any size, stride, camera and pose, however many rows are worked on in one go."""
    height, width = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 7))
    stride, block = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 30))
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    if kind is np.uint16:
        image = np.where(rng.random((height, width)) < 0.7, rng.integers(200, 2000, (height, width)), 0).astype(kind)
        scale = data.draw(st.sampled_from([0.001, 0.0005]))
    else:
        image = rng.uniform(0.2, 2.0, (height, width)).astype(kind)
        image[rng.random((height, width)) < 0.3] = data.draw(st.sampled_from([0.0, -1.0, np.nan, np.inf]))
        scale = 1.0
    pose = data.draw(st.sampled_from([Pose.identity(), Pose.random(rng, reach=0.5)]))
    fx, fy, cx, cy = (2.5 * width + 20, 2.2 * width + 20, 0.45 * width + 1, 0.6 * height + 2)
    camera = {
        "intrinsics": json.dumps({"fx": fx, "fy": fy, "cx": cx, "cy": cy}).encode(),
        "depth_scale": json.dumps(scale if kind is np.uint16 else 0.25).encode(),
        "stride": str(stride).encode(),
        "T_cloud_camera": json.dumps(pose.matrix.tolist()).encode(),
    }
    content = io.BytesIO()
    np.save(content, image)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(depth_image, "_BLOCK", block)
        payload = depth_image.decode_depth(memoryview(content.getvalue()), None, camera, {}, 1000)
    expected, of_pixel = [], np.zeros(height * width, dtype=bool)
    for row in range(0, height, stride):
        for column in range(0, width, stride):
            depth = float(image[row, column])
            if np.isfinite(depth) and depth > 0:
                of_pixel[row * width + column] = True
                z = depth * scale
                expected.append([(column - cx) / fx * z, (row - cy) / fy * z, z])
    places = pose.apply(np.array(expected).reshape(-1, 3))
    np.testing.assert_allclose(payload.points, places, atol=1e-5)
    assert payload.is_point is not None
    assert payload.is_point.tolist() == of_pixel.tolist()
    assert payload.viewpoint is not None
    np.testing.assert_allclose(payload.viewpoint, pose.translation, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("column", range(3))
@pytest.mark.parametrize(("size", "is_far"), [(0.0, False), (0.999, False), (1.0, True), (50.0, True)])
def test_coordinates_stay_precise_from_where_float32_would_blur_them_on_either_side(
    sign: int, column: int, size: float, is_far: bool
) -> None:
    rows = np.full((3, 3), 0.1)
    rows[1, column] = sign * size * FAR + 1e-4 * (not is_far)
    for array in (rows, rows.astype(">f8"), np.asfortranarray(rows)):
        points = kept(array)
        assert points.dtype == (np.float64 if is_far else np.float32)
        assert points.flags.c_contiguous
        np.testing.assert_array_equal(points, rows.astype(points.dtype))
    assert kept(rows.astype(np.float32)).dtype == np.float32
    assert kept((rows * 3).astype(np.int32)).dtype == np.float32
    assert kept(np.zeros((0, 3))).shape == (0, 3)


@given(gappy(), st.booleans())
def test_a_cloud_says_how_many_of_its_rows_are_no_points(
    cloud: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]], of_file: bool
) -> None:
    rows, is_point = cloud
    place = np.array([0.0, 0.25, 0.5]) if of_file else None
    payload = cloud_payload(rows, {"seed": b"1"}, file_viewpoint=place)
    assert payload.points.tolist() == rows[is_point].tolist()
    assert payload.ignored_points == np.count_nonzero(~is_point)
    assert (payload.is_point is None) == is_point.all()
    assert payload.is_point is None or payload.is_point.tolist() == is_point.tolist()
    assert payload.options == {"seed": b"1"}
    assert payload.file_viewpoint is place
    with pytest.raises(Invalid, match=f"are {len(rows)}, all of them"):
        cloud_payload(np.full_like(rows, np.nan))


def test_a_large_image_may_be_posted_at_the_limit_of_the_points_that_matter() -> None:
    assert most_rows(1_000_000) == 8_500_000 > 3840 * 2160
    assert most_rows(1) == 8


@pytest.mark.parametrize("of_image", [False, True])
@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf])
def test_a_normal_that_is_not_finite_is_none(missing: float, of_image: bool) -> None:
    """In a .npy file, beside points that are all there: zeros, which the library takes for no normal."""
    normals = np.tile(np.eye(3, dtype=np.float32), (2, 1))
    normals[1, 2] = normals[4, 0] = missing
    found = known_normals(normals.reshape(2, 3, 3) if of_image else normals)
    expected = normals.copy()
    expected[[1, 4]] = 0
    np.testing.assert_array_equal(found, expected)
    query = build_query(cloud_payload(np.zeros((6, 3), np.float32), {}, {"normals": found}), parse_options({}))
    np.testing.assert_array_equal(query.normals, expected)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_the_points_that_count_against_the_limit_are_those_in_the_workspace_and_on_the_mask(
    data: st.DataObject,
) -> None:
    """A target without a mask lets no more of them through: its points are looked at among all others."""
    count, limit = data.draw(st.integers(1, 20)), data.draw(st.integers(1, 12))
    points = np.random.default_rng(data.draw(st.integers(0, 99))).uniform(0, 1, (count, 3)).astype(np.float32)
    low, high = [0.1, 0.0, 0.0], [0.8, 0.9, 1.0]
    bounded, kind = data.draw(st.booleans()), data.draw(st.sampled_from(["none", "mask", "label", "indices", "box"]))
    labels = np.arange(count) % 3
    target = {
        "label": {"label": 2},
        "indices": {"indices": [0]},
        "box": {"box": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}},
    }
    raw = {"workspace": json.dumps({"min": low, "max": high}).encode()} if bounded else {}
    raw |= {"target": json.dumps(target[kind]).encode()} if kind in target else {}
    payload = Payload(points, options=raw, mask=labels if kind in ("mask", "label") else None)
    matter = sum(
        (not bounded or all(a <= x <= b for a, x, b in zip(low, point, high, strict=True)))
        and (kind != "mask" or label != 0)
        and (kind != "label" or label == 2)
        for point, label in zip(points.tolist(), labels.tolist(), strict=True)
    )
    with contextlib.nullcontext() if matter <= limit else pytest.raises(TooManyPoints, match=f"{matter}.*{limit}"):
        build_query(payload, parse_options(raw), limit)
