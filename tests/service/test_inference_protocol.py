"""The Open Inference Protocol, asked by Triton's own HTTP client and by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
import tritonclient.http as triton
from numpy.typing import NDArray
from tritonclient.utils import InferenceServerException

from service.answers import answer_arrays
from service.inference_protocol.decoding import decode
from service.inference_protocol.tensors import HEADER_LENGTH, OUTPUTS
from service.schemas import GraspOptions
from tesnet.geometry import GraspSet
from tesnet.result import REJECTIONS, GraspCounts, GraspResult
from tests.conftest import PATIENCE_S

Cloud = NDArray[np.float32]

INFER = "/v2/models/tesnet/infer"
OPTIONS: dict[str, Any] = {"viewpoint": [0.35, 0, 0.5], "up": [0, 0, 1], "max_candidates": 200, "max_grasps": 3}
ARRAYS = [output.name for output in OUTPUTS if output.name != "meta"]


@pytest.fixture(scope="module")
def client(service_url: str) -> Iterator[triton.InferenceServerClient]:
    with triton.InferenceServerClient(service_url.removeprefix("http://"), network_timeout=PATIENCE_S) as client:
        yield client


@pytest.fixture(scope="module")
def expected(http: httpx.Client, cloud: Cloud) -> dict[str, Any]:
    answer = http.post("/grasps", json={"points": cloud.tolist(), **OPTIONS}).json()
    assert len(answer["grasps"]) == 3
    return dict(answer)


def tensor(points: Cloud, binary: bool) -> triton.InferInput:
    given = triton.InferInput("points", list(points.shape), "FP32")
    given.set_data_from_numpy(points, binary_data=binary)
    return given


def body(**changes: Any) -> dict[str, Any]:
    points = {"name": "points", "datatype": "FP32", "shape": [2, 3], "data": [[0, 0, 0.5], [0.01, 0, 0.5]]}
    return {"inputs": [points], **changes}


def point(**changes: Any) -> list[dict[str, Any]]:
    given = {"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [0, 0, 0.5], **changes}
    return [{name: value for name, value in given.items() if value is not None}]


def test_server_and_model_describe_themselves(client: triton.InferenceServerClient, http: httpx.Client) -> None:
    assert client.is_server_live()
    assert client.is_server_ready()
    assert client.is_model_ready("tesnet")
    assert not client.is_model_ready("edgegrasp")
    server = client.get_server_metadata()
    assert (server["name"], server["extensions"]) == ("tes-net", ["binary_tensor_data"])
    model = client.get_model_metadata("tesnet")
    assert model["inputs"] == [{"name": "points", "datatype": "FP32", "shape": [-1, 3]}]
    assert [output["name"] for output in model["outputs"]] == [*ARRAYS, "meta"]
    version = http.get("/model").json()["models"][0]["version"]
    assert model["versions"] == [version]
    assert client.get_model_metadata("tesnet", version) == model
    assert client.is_model_ready("tesnet", version)


@pytest.mark.parametrize("binary_out", [True, False])
@pytest.mark.parametrize("binary_in", [True, False])
def test_tritons_client_gets_what_post_grasps_answers(
    client: triton.InferenceServerClient, cloud: Cloud, expected: dict[str, Any], binary_in: bool, binary_out: bool
) -> None:
    outputs = [triton.InferRequestedOutput(output.name, binary_data=binary_out) for output in OUTPUTS]
    result = client.infer("tesnet", [tensor(cloud, binary_in)], outputs=outputs, request_id="seven", parameters=OPTIONS)
    answer = result.get_response()
    assert (answer["model_name"], answer["id"]) == ("tesnet", "seven")
    grasps = expected["grasps"]
    for name, key in (
        ("scores", "score"),
        ("poses", "matrix"),
        ("widths", "width"),
        ("approach_points", "approach_point"),
        ("contact_points", "contact_point"),
    ):
        np.testing.assert_allclose(result.as_numpy(name), [grasp[key] for grasp in grasps], atol=1e-6)
    for name, key in (("hand_poses", "hand_pose"), ("pregrasps", "pregrasp")):
        positions = result.as_numpy(name)[:, :3, 3]
        np.testing.assert_allclose(positions, [grasp[key]["position"] for grasp in grasps], atol=1e-6)
    (text,) = result.as_numpy("meta")
    meta = json.loads(text)
    assert meta["counts"] == expected["counts"]
    assert meta["warnings"] == expected["warnings"]


def test_without_named_outputs_all_come_as_bytes_and_nothing_found_is_empty_arrays(
    client: triton.InferenceServerClient,
) -> None:
    result = client.infer("tesnet", [tensor(np.zeros((2, 3), np.float32), binary=True)])
    assert [output["name"] for output in result.get_response()["outputs"]] == [*ARRAYS, "meta"]
    assert result.as_numpy("poses").shape == (0, 4, 4)
    assert json.loads(result.as_numpy("meta")[0])["reason"] == "too_few_points"


def test_options_may_be_strings_as_the_protocol_wants_them(http: httpx.Client, cloud: Cloud) -> None:
    texts = {name: json.dumps(value) for name, value in OPTIONS.items()} | {"frame_convention": "graspnet"}
    given = {"name": "points", "datatype": "FP32", "shape": list(cloud.shape), "data": cloud.tolist()}
    wanted = [{"name": "scores"}, {"name": "poses"}]
    strings = http.post(INFER, json={"inputs": [given], "parameters": texts, "outputs": wanted}).json()
    values = OPTIONS | {"frame_convention": "graspnet"}
    assert http.post(INFER, json={"inputs": [given], "parameters": values, "outputs": wanted}).json() == strings
    flat = given | {"data": cloud.ravel().tolist()}
    assert http.post(INFER, json={"inputs": [flat], "parameters": values, "outputs": wanted}).json() == strings
    assert [output["name"] for output in strings["outputs"]] == ["scores", "poses"]


def test_up_is_found_where_it_is_asked_for(client: triton.InferenceServerClient) -> None:
    across, along = np.meshgrid(np.linspace(-0.2, 0.2, 80), np.linspace(-0.2, 0.2, 80))
    table = np.stack([across, along, np.zeros_like(across)], -1).reshape(-1, 3)
    box = np.abs(table[:, :2]).max(axis=1) < 0.02
    points = (table + np.outer(box, [0, 0, 0.05])).astype(np.float32)
    asked = {"viewpoint": "[0.3, 0, 0.5]", "max_candidates": "300"}
    metas = [
        json.loads(client.infer("tesnet", [tensor(points, binary=True)], parameters=asked | up).as_numpy("meta")[0])
        for up in ({"up": "auto"}, {})
    ]
    (note,) = [note for note in metas[0]["warnings"] if note.startswith("up auto: [")]
    assert "the plane at" in note
    assert not any("up auto" in note for note in metas[1]["warnings"])


def test_tritons_client_shows_the_problems_detail(client: triton.InferenceServerClient) -> None:
    points = tensor(np.zeros((2, 3), np.float32), binary=True)
    with pytest.raises(InferenceServerException, match=r"max_grasps: is 0.*1000") as refused:
        client.infer("tesnet", [points], parameters={"max_grasps": 0})
    assert refused.value.status() == "422"
    with pytest.raises(InferenceServerException, match="edgegrasp is not loaded"):
        client.infer("edgegrasp", [points])
    with pytest.raises(InferenceServerException, match="no option"):
        client.infer("tesnet", [points], headers={"X-Request-Timeout": "5"}, parameters={"max_graps": 1})


BAD: dict[str, tuple[Any, int, str]] = {
    "nothing": (b"", 400, "empty"),
    "no JSON": (b"points", 400, "JSON"),
    "cut off": (b'{"inputs": [', 400, "JSON"),
    "a list": ([], 422, "inference request"),
    "an unknown field": (body(input=[]), 422, "input"),
    "no inputs": ({}, 422, "missing"),
    "two inputs": ({"inputs": point() * 2}, 422, "inputs"),
    "an input of another name": ({"inputs": point(name="cloud")}, 422, "cloud"),
    "an input of another type": ({"inputs": point(datatype="FP64")}, 422, "FP64"),
    "another shape": ({"inputs": point(shape=[3])}, 422, "length"),
    "pairs": ({"inputs": point(shape=[1, 2])}, 422, "[1, 2]"),
    "a negative shape": ({"inputs": point(shape=[-1, 3])}, 422, "[-1, 3]"),
    "too many points": ({"inputs": point(shape=[1_000_001, 3])}, 413, "1000000"),
    "fewer data than the shape": ({"inputs": point(shape=[2, 3])}, 422, "1 points"),
    "no triples": ({"inputs": point(data=[1, 2, 3, 4])}, 422, "multiple of 3"),
    "words": ({"inputs": point(data=["a", 1, 2])}, 422, "number"),
    "nested words": ({"inputs": point(data=[["a", 1, 2]])}, 422, "number"),
    "too deep": ({"inputs": point(data=[[[1, 2, 3]]])}, 422, "points"),
    "neither data nor bytes": ({"inputs": point(data=None)}, 422, "binary_data_size"),
    "both": ({"inputs": point(parameters={"binary_data_size": 12})}, 422, "either"),
    "bytes that do not come": ({"inputs": point(data=None, parameters={"binary_data_size": 12})}, 400, "agree"),
    "shared memory": ({"inputs": point(parameters={"shared_memory_region": "x"})}, 422, "shared_memory_region"),
    "an unknown output": (body(outputs=[{"name": "grasps"}]), 422, "hand_poses"),
    "a class count": (body(outputs=[{"name": "scores", "parameters": {"classification": 1}}]), 422, "classification"),
    "many outputs": (body(outputs=[{"name": "scores"}] * 9999), 422, "65536"),
    "a number for an id": (body(id=1), 422, "id"),
    "a priority": (body(parameters={"priority": 1}), 422, "order"),
    "a sequence": (body(parameters={"sequence_id": 3, "sequence_start": True}), 422, "sequence_"),
    "a timeout in seconds": (body(parameters={"timeout": 0.5}), 422, "microseconds"),
    "an unknown option": (body(parameters={"max_graps": 1}), 422, "max_grasps"),
    "an option out of range": (body(parameters={"max_grasps": "0"}), 422, "max_grasps"),
    "another network": (body(parameters={"model": "gpd"}), 422, "gpd"),
    "a flag that is none": (body(parameters={"binary_data_output": 1}), 422, "true or false"),
    "NaN": (b'{"inputs": [{"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [NaN, 0, 0]}]}', 422, "NaN"),
    "NaN in an option": (b'{"inputs": [], "parameters": {"min_score": NaN}}', 422, "min_score"),
    "a name twice": (b'{"inputs": [], "parameters": {"seed": 1, "seed": 2}}', 422, "seed: is given twice"),
    "inputs twice": (b'{"inputs": [], "inputs": []}', 422, "inputs: is given twice"),
    "a broken number": (
        b'{"inputs": [{"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [0, 0, .5]}]}',
        400,
        "JSON",
    ),
    "outputs that are no JSON": (
        json.dumps(body()).encode()[:-1] + b', "outputs": [{"name": "scores"},]}',
        400,
        "JSON",
    ),
    "inputs that are no JSON": (b'{"inputs": [{},]}', 400, "JSON"),
    "more than a float holds": ({"inputs": point(data=[1e300, 0, 0])}, 422, "infinite"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_request_is_a_problem_whose_detail_is_also_the_error(http: httpx.Client, case: str) -> None:
    given, status, word = BAD[case]
    content = given if isinstance(given, bytes) else json.dumps(given).encode()
    answer = http.post(INFER, content=content)
    problem = answer.json()
    assert (answer.status_code, answer.headers["Content-Type"]) == (status, "application/problem+json"), problem
    assert word in problem["detail"]
    assert problem["error"] == problem["detail"]
    assert len(answer.text) < 2000


def test_null_is_as_good_as_left_out(http: httpx.Client) -> None:
    inputs = [{**body()["inputs"][0], "parameters": None}]
    given = {"inputs": inputs, "id": None, "parameters": {"up": None, "timeout": None}, "outputs": None}
    answer = http.post(INFER, json=given)
    assert answer.status_code == 200, answer.text
    assert "id" not in answer.json()
    again = http.post(INFER, json={**given, "parameters": None, "outputs": [{"name": "scores", "parameters": None}]})
    assert [output["name"] for output in again.json()["outputs"]] == ["scores"]


def test_options_in_the_query_string_are_refused(http: httpx.Client) -> None:
    answer = http.post(f"{INFER}?max_grasps=1", json=body())
    assert (answer.status_code, "parameters" in answer.json()["error"]) == (422, True)


@pytest.mark.parametrize(
    ("microseconds", "seconds"),
    [(None, math.inf), (0, math.inf), (1, 1e-6), (2_500_000, 2.5), (10**12 - 1, 999_999.999999)],
)
def test_a_timeout_is_told_in_microseconds_and_zero_is_none(microseconds: int | None, seconds: float) -> None:
    asked = decode(bytearray(json.dumps(body(parameters={"timeout": microseconds})).encode()), None, 1000)
    assert asked.timeout == pytest.approx(seconds)


@pytest.mark.parametrize("of_all", [None, True, False])
@pytest.mark.parametrize("of_one", [None, True, False])
def test_whether_an_output_is_binary_is_its_own_word_before_that_for_all(
    of_all: bool | None, of_one: bool | None
) -> None:
    parameters = {} if of_one is None else {"parameters": {"binary_data": of_one}}
    request = body(
        outputs=[{"name": "scores", **parameters}, {"name": "widths"}], parameters={"binary_data_output": of_all}
    )
    asked = decode(bytearray(json.dumps(request).encode()), None, 1000)
    assert asked.outputs == {"scores": bool(of_all if of_one is None else of_one), "widths": bool(of_all)}


def test_tritons_timeout_is_how_long_a_request_may_wait(client: triton.InferenceServerClient, cloud: Cloud) -> None:
    points = [tensor(cloud, binary=True)]
    assert client.infer("tesnet", points, timeout=3600_000_000).as_numpy("scores") is not None
    with pytest.raises(InferenceServerException, match="deadline") as late:
        client.infer("tesnet", points, timeout=1)
    assert late.value.status() == "504"


def test_the_root_has_the_error_too(http: httpx.Client) -> None:
    assert http.post("/v2").json()["error"].startswith("This path does not take this method")


def test_requests_are_counted_under_the_route_and_not_under_what_the_client_names(http: httpx.Client) -> None:
    http.post(INFER, json=body())
    http.get("/v2/models/whatever")
    counted = http.get("/metrics").text
    assert 'grasp_requests_total{method="POST",route="/v2/models/{model}/infer",status="200"}' in counted
    assert "whatever" not in counted


@pytest.mark.parametrize(
    ("length", "tail", "status"),
    [("0", 24, 400), ("x", 24, 422), ("999999", 24, 400), (None, 24, 400), ("", 23, 400), ("", 25, 400), ("", 24, 200)],
)
def test_the_length_of_the_json_and_of_the_bytes_must_fit(
    http: httpx.Client, length: str | None, tail: int, status: int
) -> None:
    given = {"inputs": point(data=None, shape=[2, 3], parameters={"binary_data_size": 24})}
    head = json.dumps(given).encode()
    headers = {} if length is None else {HEADER_LENGTH: length or str(len(head))}
    answer = http.post(INFER, content=head + bytes(tail), headers=headers)
    assert answer.status_code == status, answer.text


@pytest.mark.parametrize("content_type", ["text/plain", "application/x-npy", "application/jsonl", ""])
def test_a_content_type_that_the_protocol_does_not_know_is_a_415(http: httpx.Client, content_type: str) -> None:
    answer = http.post(INFER, content=json.dumps(body()), headers={"Content-Type": content_type})
    assert (answer.status_code, "application/json or application/octet-stream" in answer.json()["error"]) == (415, True)


def test_a_compressed_body_is_a_415_and_another_version_a_404(http: httpx.Client) -> None:
    compressed = http.post(INFER, content=b"x", headers={"Content-Encoding": "gzip"})
    assert (compressed.status_code, "gzip" in compressed.json()["error"]) == (415, True)
    missing = http.get("/v2/models/tesnet/versions/9")
    assert (missing.status_code, "not loaded" in missing.json()["error"]) == (404, True)


def test_outputs_have_the_shapes_and_types_that_their_metadata_tell() -> None:
    counts = GraspCounts(0, 0, 0, 0, 0, dict.fromkeys(REJECTIONS, 0))
    arrays = answer_arrays(GraspResult(GraspSet.empty(), counts, "no_candidates", (), {}), GraspOptions())
    told = {output.name: (output.datatype, list(output.shape)) for output in OUTPUTS}
    assert told.pop("meta") == ("BYTES", [1])
    assert told == {name: ("FP64", [-1, *array.shape[1:]]) for name, array in arrays.items()}
