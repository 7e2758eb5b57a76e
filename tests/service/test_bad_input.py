"""Every error row of api.md, over a real server: the status, the problem document, and nothing else."""

from __future__ import annotations

import json
import os
import pickle
import urllib.parse
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.service.wire import OCTETS, npy, post_head, problem_of, status_of

JSON = {"Content-Type": "application/json"}
NPY = {"Content-Type": "application/x-npy"}

TRIANGLE = [[0.0, 0.0, 0.5], [0.01, 0.0, 0.5], [0.0, 0.01, 0.5]]


def npy_header(text: str, version: bytes = b"\x01\x00") -> bytes:
    header = text.encode() + b"\n"
    length = len(header).to_bytes(2 if version[0] == 1 else 4, "little")
    return b"\x93NUMPY" + version + length + header


class Bomb:
    """Leaves a mark when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, ("/tmp/unpickled-by-the-service",))


UNDECODABLE = {
    "empty JSON": (JSON, b"", "empty"),
    "empty octets": (OCTETS, b"", "empty"),
    "empty npy": (NPY, b"", "empty"),
    "truncated JSON": (JSON, b'{"points": [[0, 0, 1], [0, 0', "truncated"),
    "truncated after a bad value": (JSON, b'{"points": [["a", 0, 1], [0, 0', ""),
    "no JSON": (JSON, b"points", "JSON"),
    "two documents": (JSON, b'{"points": []} {}', "JSON"),
    "trailing comma": (JSON, b'{"points": [[0, 0, 1],]}', "JSON"),
    "UTF-16": (JSON, '{"points": []}'.encode("utf-16"), "JSON"),
    "broken UTF-8 in a name": (JSON, b'{"\xff": 1}', "UTF-8"),
    "broken UTF-8 in an option": (JSON, b'{"points": [], "unseen": "\xff"}', "UTF-8"),
    "a million brackets": (JSON, b"[" * 1_000_000, "JSON"),
    "a million brackets in points": (JSON, b'{"points": ' + b"[" * 1_000_000, "nested"),
    "a deep closed option": (JSON, b'{"points": [], "up": ' + b"[" * 10_000 + b"]" * 10_000 + b"}", "nested"),
    "a multiple of 4 but not of 12": (OCTETS, bytes(16), "multiple of 12"),
    "one byte": (OCTETS, b"x", "multiple of 12"),
    "no npy": (NPY, b"PK\x03\x04 this is a zip", "npy"),
    "npy without header": (NPY, b"\x93NUMPY", "npy"),
    "npy of an unknown version": (NPY, npy_header("{}", b"\x09\x00"), "npy"),
    "npy header that is code": (NPY, npy_header("__import__('os').abort()"), "npy"),
    "npy header of brackets": (NPY, npy_header("(" * 9000), "npy"),
    "npy header that claims 4 GB": (NPY, b"\x93NUMPY\x02\x00\xff\xff\xff\xff{}", "npy"),
    "npy cut off": (NPY, npy(np.zeros((10, 3)))[:-1], "cut off"),
    "npy with more data than its header says": (NPY, npy(np.zeros((10, 3))) + b"x", "cut off"),
    "npy of a negative size": (
        NPY,
        npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 3)}"),
        "negative",
    ),
    "pickled object in npy": (NPY, npy(np.array([[Bomb(), 1, 2]], dtype=object), allow_pickle=True), "pickled"),
    "pickle named npy": (NPY, pickle.dumps(Bomb()), "npy"),
}


@pytest.mark.parametrize("case", UNDECODABLE)
def test_what_cannot_be_decoded_is_a_400(http: httpx.Client, case: str) -> None:
    headers, body, word = UNDECODABLE[case]
    problem_of(http.post("/grasps", content=body, headers=headers), 400, word)
    assert not os.path.exists("/tmp/unpickled-by-the-service")  # noqa: PTH110 - beside os.mkdir in Bomb


INVALID_POINTS = {
    "missing": (b'{"seed": 1}', "missing"),
    "null": (b'{"points": null}', "array"),
    "a number": (b'{"points": 3}', "array"),
    "a string": (b'{"points": "[[0, 0, 1]]"}', "array"),
    "an object": (b'{"points": {"0": [0, 0, 1]}}', "array"),
    "a flat list": (b'{"points": [0, 0, 1]}', "point 0"),
    "pairs": (b'{"points": [[0, 0, 1], [0, 0]]}', "point 1"),
    "quadruples": (b'{"points": [[0, 0, 1, 1]]}', "point 0"),
    "strings as coordinates": (b'{"points": [[0, 0, "1"]]}', "point 0"),
    "booleans as coordinates": (b'{"points": [[0, 0, true]]}', "point 0"),
    "nulls as coordinates": (b'{"points": [[0, 0, 1], [0, null, 1]]}', "point 1"),
    "lists as coordinates": (b'{"points": [[0, 0, [1]]]}', "point 0"),
    "NaN": (b'{"points": [[0, 0, NaN]]}', "NaN"),
    "NaN first": (b'{"points": [[NaN,0,0]]}', "NaN"),
    "NaN far behind": (b'{"points": [' + b"[0,0,1], " * 50_000 + b"[0,0,NaN]]}", "NaN"),
    "Infinity": (b'{"points": [[0, 0, 1], [Infinity, 0, 0]]}', "infinity"),
    "-Infinity": (b'{"points": [[0, -Infinity, 0]]}', "infinity"),
    "more than a double holds": (b'{"points": [[1e400, 0, 0]]}', "point 0"),
    "more digits than a double holds": (b'{"points": [[' + b"9" * 400 + b", 0, 0]]}", "point 0"),
    "more than a float holds": (b'{"points": [[1e300, 0, 0]]}', "infinite"),
    "a list for the document": (b"[[0, 0, 1]]", "object"),
    "null for the document": (b"null", "object"),
    "twenty million empty lists": (b'{"points": [' + b"[]," * 20_000_000 + b"[]]}", "point 0"),
}


@pytest.mark.parametrize("case", INVALID_POINTS)
def test_json_points_that_are_no_triples_of_finite_numbers_are_a_422(http: httpx.Client, case: str) -> None:
    body, word = INVALID_POINTS[case]
    problem = problem_of(http.post("/grasps", content=body, headers=JSON), 422, word)
    assert problem.field in ("points", "body")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_binary_points_that_are_not_finite_are_no_points(http: httpx.Client, bad: float, dtype: str) -> None:
    points = np.array([*TRIANGLE, [bad, 0, 0]])
    nothing = np.full((4, 3), bad)
    for array in (points, points.reshape(2, -1, 3)):
        answer = http.post("/grasps", content=npy(array.astype(dtype)), headers=NPY)
        assert answer.status_code == 200, answer.text
        assert answer.json()["counts"]["ignored_points"] == 1
        assert answer.json()["counts"]["points"] == len(TRIANGLE)
    as_octets = http.post("/grasps", content=points.astype("<f4").tobytes(), headers=OCTETS)
    assert as_octets.json()["counts"]["ignored_points"] == 1
    for answer in (
        http.post("/grasps", content=npy(nothing.astype(dtype)), headers=NPY),
        http.post("/grasps", content=nothing.astype("<f4").tobytes(), headers=OCTETS),
    ):
        assert problem_of(answer, 422, "4, all of them NaN or infinite").field == "points"


@pytest.mark.parametrize(
    ("array", "word"),
    [
        (np.zeros((4, 2), np.float32), "(4, 2)"),
        (np.zeros((3, 4), np.float32), "(3, 4)"),
        (np.zeros(12, np.float32), "(12,)"),
        (np.zeros((1, 2, 2, 3), np.float32), "(1, 2, 2, 3)"),
        (np.zeros((4, 3), np.float16), "float16"),
        (np.zeros((4, 3), np.int32), "int32"),
        (np.zeros((4, 3), np.bool_), "bool"),
        (np.zeros((4, 3), np.complex64), "complex64"),
        (np.zeros((4, 3), "U4"), "U4"),
        (np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4")]), "x"),
    ],
)
def test_npy_of_another_shape_or_type_is_a_422(http: httpx.Client, array: NDArray[Any], word: str) -> None:
    assert problem_of(http.post("/grasps", content=npy(array), headers=NPY), 422, word).field == "points"


def test_millimetres_are_a_422_that_names_the_limit_and_the_remedy(
    http: httpx.Client, cloud: NDArray[np.float32]
) -> None:
    answer = http.post("/grasps", content=(1000 * cloud).tobytes(), headers=OCTETS)
    problem_of(answer, 422, "20", "metres", "1000")


INVALID_OPTIONS: dict[str, tuple[str, Any, str]] = {
    "max_grasps of no grasps": ("max_grasps", 0, "1"),
    "max_grasps above the limit": ("max_grasps", 1001, "1000"),
    "max_grasps as a string": ("max_grasps", "10", "integer"),
    "max_grasps as a fraction": ("max_grasps", 2.5, "integer"),
    "max_grasps as a boolean": ("max_grasps", True, "integer"),
    "min_score above one": ("min_score", 1.5, "1"),
    "min_score as a string": ("min_score", "high", "number"),
    "negative seed": ("seed", -1, "0"),
    "seed beyond 63 bits": ("seed", 2**63, "2^63"),
    "viewpoint of two numbers": ("viewpoint", [0, 1], "viewpoint"),
    "viewpoint of no positions": ("viewpoint", [], "viewpoint"),
    "too many viewpoints": ("viewpoint", [[0, 0, 1]] * 65, "64"),
    "up of another word": ("up", "down", "auto"),
    "up of no length": ("up", [0, 0, 0], "length"),
    "up of four numbers": ("up", [0, 0, 1, 0], "up"),
    "workspace inside out": ("workspace", {"min": [0, 0, 0], "max": [1, 1, -1]}, "min"),
    "workspace without max": ("workspace", {"min": [0, 0, 0]}, "max"),
    "workspace with another name": ("workspace", {"min": [0, 0, 0], "max": [1, 1, 1], "mid": 0}, "mid"),
    "support_height without up": ("support_height", 0.1, "up"),
    "support_height auto without up": ("support_height", "auto", "up"),
    "support_height of another word": ("support_height", "low", "auto"),
    "approach cone beyond the sphere": ("approach", {"direction": [0, 0, -1], "max_angle_deg": 181}, "180"),
    "approach without an angle": ("approach", {"direction": [0, 0, -1]}, "max_angle_deg"),
    "approach in no direction": ("approach", {"direction": [0, 0, 0], "max_angle_deg": 10}, "length"),
    "min_separation below zero": ("min_separation", {"translation": -1}, "translation"),
    "too many approach points": ("num_approach_points", 1025, "1024"),
    "too many candidates": ("max_candidates", 20001, "20000"),
    "width neither fitted nor full": ("width", "wide", "fitted"),
    "unseen neither free nor occupied": ("unseen", "maybe", "occupied"),
    "calibrate neither true nor false": ("calibrate", "often", "boolean"),
    "pregrasp_distance of two metres": ("pregrasp_distance", 2, "1"),
    "frame_convention unknown": ("frame_convention", "ros", "contact_graspnet"),
    "model that is not loaded": ("model", "edgegrasp", "tesnet"),
    "target of nothing": ("target", {}, "box"),
    "target of two kinds": ("target", {"box": {"min": [0, 0, 0], "max": [1, 1, 1]}, "indices": [0]}, "either"),
    "target of another kind": ("target", {"mask": [0]}, "mask"),
    "target box inside out": ("target", {"box": {"min": [0, 0, 0], "max": [1, -1, 1]}}, "min"),
    "target index beyond the cloud": ("target", {"indices": [0, 3]}, "index 3, but 3 points"),
    "target index below zero": ("target", {"indices": [-1]}, "greater than or equal to 0"),
    "target index of half a point": ("target", {"indices": [0.5]}, "integer"),
    "target index that is true": ("target", {"indices": [True]}, "integer"),
    "target index beyond 64 bits": ("target", {"indices": [2**70]}, "target"),
    "gripper that opens too wide": ("gripper", {"max_width": 0.161}, "0.16"),
    "gripper that nobody knows": ("gripper", "robotiq_2f80", "robotiq_2f85"),
    "gripper like one that nobody knows": ("gripper", {"name": "robotiq"}, "hand_e"),
    "gripper whose cranks are too short": ("gripper", {"name": "rg2", "linkage_length": 0.03}, "linkage_length"),
    "gripper that does not open": ("gripper", {"max_width": 0}, "0.005"),
    "gripper without fingers": ("gripper", {"finger_depth": 0.01}, "0.015"),
    "gripper broader at its tip": ("gripper", {"finger_thickness": 0.01, "finger_tip_thickness": 0.02}, "finger_tip"),
    "gripper with another name": ("gripper", {"width": 0.05}, "width"),
    "intrinsics without a depth image": ("intrinsics", {"fx": 1}, "depth"),
    "unknown": ("max_graps", 3, "max_grasps"),
    "unknown and far from all": ("zzz", 3, "viewpoint"),
    "long": ("model", "m" * 100_000, "too long"),
}


@pytest.mark.parametrize("case", INVALID_OPTIONS)
def test_an_invalid_option_is_a_422_that_names_it_in_body_and_query_string(http: httpx.Client, case: str) -> None:
    name, value, word = INVALID_OPTIONS[case]
    in_body = problem_of(http.post("/grasps", json={"points": TRIANGLE, name: value}), 422, name, word)
    assert in_body.field == name
    text = urllib.parse.quote(json.dumps(value))
    if len(text) < 8000:
        answer = http.post(f"/grasps?{name}={text}", content=np.array(TRIANGLE, np.float32).tobytes(), headers=OCTETS)
        assert problem_of(answer, 422, word).field == name


@pytest.mark.parametrize(
    ("query", "field", "word"),
    [
        ("seed=1&seed=2", "seed", "twice"),
        ("seed=1&se%65d=1", "seed", "twice"),
        ("viewpoint=[0,0", "viewpoint", "JSON"),
        ("viewpoint=0,0,1", "viewpoint", "JSON"),
        ("seed=", "seed", "empty"),
        ("seed", "seed", "empty"),
        ("min_score=NaN", "min_score", "number"),
        ("min_score=1e999", "min_score", "finite"),
        ("up=[0,0,Infinity]", "up", "JSON"),
        ("unseen=%FF", "unseen", "JSON"),
        ("unseen=%22%FF%22", "unseen", "JSON"),
        ("model=%22%5Cud800%22", "model", "model"),
        ("points=[[0,0,1]]", "points", "body"),
        ("up=" + "[" * 3000 + "]" * 3000, "up", "up"),
        ("%00=1", "?", "no option"),
        ("=1", "", "no option"),
    ],
)
def test_a_bad_query_string_is_a_422(http: httpx.Client, query: str, field: str, word: str) -> None:
    answer = http.post(f"/grasps?{query}", content=np.array(TRIANGLE, np.float32).tobytes(), headers=OCTETS)
    assert problem_of(answer, 422, word).field == field


@pytest.mark.parametrize(
    ("option", "field"),
    [
        (b'"max_grasps": NaN', "max_grasps"),
        (b'"up": [0, 0, -Infinity]', "up"),
        (b'"target": {"indices": [NaN]}', "target"),
        (b'"target": {"indices": [' + b"0," * 9000 + b"NaN]}", "target"),
    ],
    ids=["a number", "in an array", "an index", "one of many indices"],
)
def test_nan_in_an_option_is_a_422_that_names_the_option(http: httpx.Client, option: bytes, field: str) -> None:
    for body in (b'{"points": [[0, 0, 1]], %b}' % option, b'{%b, "points": [[0, 0, 1]]}' % option):
        assert problem_of(http.post("/grasps", content=body, headers=JSON), 422, "NaN").field == field


def test_an_option_that_is_given_twice_in_json_is_a_422(http: httpx.Client) -> None:
    answer = http.post("/grasps", content=b'{"seed": 1, "points": [[0, 0, 1]], "seed": 2}', headers=JSON)
    assert problem_of(answer, 422, "twice").field == "seed"


def test_an_option_in_both_places_is_a_422(http: httpx.Client) -> None:
    answer = http.post("/grasps?seed=1", json={"points": TRIANGLE, "seed": 1})
    assert problem_of(answer, 422, "give it once").field == "seed"


def test_a_wrong_option_is_refused_before_the_body_is_read(service_url: str) -> None:
    with post_head(service_url, "/grasps?sed=1", headers="Content-Length: 60000000") as connection:
        assert status_of(connection) == 422


@pytest.mark.parametrize(
    "given", ["0", "-1", "nan", "inf", "soon", "3601", "", "1_0", "+1", "0x1", "1e", "1 2", "1,5", "9" * 4300]
)
def test_a_timeout_that_is_no_number_of_seconds_is_a_422(http: httpx.Client, given: str) -> None:
    answer = http.post("/grasps", json={"points": TRIANGLE}, headers={"X-Request-Timeout": given})
    assert problem_of(answer, 422, "3600").field == "X-Request-Timeout"


@pytest.mark.parametrize("given", ["9", "9.", "9.5", ".5", "5e1", "1E-1", "0000009"])
def test_a_timeout_may_be_any_plain_number(http: httpx.Client, given: str) -> None:
    answer = http.post("/grasps", json={"points": TRIANGLE}, headers={"X-Request-Timeout": given})
    assert answer.status_code in (200, 504)


DIGITS = b"7" * 4300
"""As many as Python makes a number of; `wire.problem_of` sees that no message repeats them."""


@pytest.mark.parametrize("number", [DIGITS, DIGITS + b"7", b"-" + DIGITS, b"1e" + DIGITS, DIGITS + b"." + DIGITS])
@pytest.mark.parametrize("option", ["seed", "max_grasps", "support_height", "viewpoint", "target"])
def test_a_number_of_thousands_of_digits_is_refused_in_few_words(
    http: httpx.Client, option: str, number: bytes
) -> None:
    value = {"viewpoint": b"[0, 0, %b]", "target": b'{"indices": [%b]}'}.get(option, b"%b") % number
    body = b'{"%b": %b, "points": [[0, 0, 1]], "up": [0, 0, 1]}' % (option.encode(), value)
    in_body = http.post("/grasps", content=body, headers={"Content-Type": "application/json"})
    assert problem_of(in_body, 422).field == option
    in_url = http.post(f"/grasps?{option}={urllib.parse.quote(value)}", json={"points": TRIANGLE})
    assert problem_of(in_url, 422).field == option


@pytest.mark.parametrize("number", [b"0." + b"0" * 2000 + b"1", b"1" + b"0" * 1200 + b"e-1200", b"1." + b"3" * 5000])
def test_a_long_number_is_a_number(http: httpx.Client, number: bytes) -> None:
    body = b'{"points": [[0, 0, %b], [0, 0, 1]], "viewpoint": [0, 0, %b], "min_score": 1}' % (number, number)
    answer = http.post("/grasps", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 200, answer.text
    assert answer.json()["counts"]["points"] == 2


@pytest.mark.parametrize("content_type", ["text/plain", "multipart/mixed; boundary=x", "application/x-npz", "", "/"])
def test_an_unknown_content_type_is_a_415_that_names_the_known(http: httpx.Client, content_type: str) -> None:
    answer = http.post("/grasps", content=b"x", headers={"Content-Type": content_type})
    problem_of(answer, 415, "application/json", "application/octet-stream", "application/x-npy")


def test_no_content_type_is_a_415(http: httpx.Client) -> None:
    problem_of(http.post("/grasps", content=bytes(12)), 415, "missing")


def test_a_compressed_body_is_a_415(http: httpx.Client) -> None:
    problem_of(http.post("/grasps", content=b"x", headers={**JSON, "Content-Encoding": "gzip"}), 415, "gzip")


def test_content_type_parameters_and_case_do_not_matter(http: httpx.Client) -> None:
    body = json.dumps({"points": TRIANGLE})
    answer = http.post("/grasps", content=body, headers={"Content-Type": "Application/JSON; charset=utf-8"})
    assert answer.status_code == 200


@pytest.mark.parametrize("accept", ["text/html", "image/*;q=0.5, text/plain", "*/*;q=0", "json"])
def test_an_answer_in_no_format_that_there_is_is_a_406(http: httpx.Client, accept: str) -> None:
    answer = http.post("/grasps", json={"points": TRIANGLE}, headers={"Accept": accept})
    problem_of(answer, 406, "application/json", "application/x-npz")


def test_one_point_too_many_is_a_413_in_every_content_type(http: httpx.Client) -> None:
    points = np.zeros((1_000_001, 3), np.float32)
    text = b'{"points": [' + b"[0,0,0]," * 1_000_000 + b"[0,0,0]]}"
    for body, headers in ((points.tobytes(), OCTETS), (npy(points), NPY), (text, JSON)):
        problem_of(http.post("/grasps", content=body, headers=headers), 413, "1000000")


def test_a_npy_that_only_claims_to_be_huge_is_a_413(http: httpx.Client) -> None:
    body = npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (10000000000000, 3)}")
    problem_of(http.post("/grasps", content=body, headers=NPY), 413, "1000000")


def test_no_problem_says_anything_of_the_cloud(http: httpx.Client) -> None:
    body = b'{"points": [[0.123456, 0.2, 0.3], [0.123456, 0.2, "0.123456"]]}'
    assert "0.123456" not in http.post("/grasps", content=body, headers=JSON).text
    far = np.array([[123456.0, 0, 0], [0, 123456.0, 0]], np.float32)
    assert "123456.0" not in http.post("/grasps", content=far.tobytes(), headers=OCTETS).text


def test_the_service_is_well_after_all_this(http: httpx.Client) -> None:
    assert http.get("/health/ready").status_code == 200
    assert 'status="500"' not in http.get("/metrics").text
