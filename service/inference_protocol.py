"""The Open Inference Protocol v2 over HTTP, as KServe and Triton clients speak it, in front of the same endpoint.

One input, `points` FP32 [-1, 3]; options in `parameters`, each as JSON or as a string that holds JSON or a plain word;
outputs named as in the .npz. Tensors travel as JSON or, by the binary tensor extension, as raw little-endian bytes
behind the JSON, whose length `Inference-Header-Content-Length` tells.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
from fastapi import APIRouter, Depends, Request, Response
from numpy.typing import NDArray

from service import schemas
from service.answers import answer_arrays, answer_meta
from service.batching import PredictionWorker
from service.errors import (
    INFERENCE_PROTOCOL,
    DeadlineExceeded,
    Invalid,
    NotReady,
    QueueFull,
    TooLarge,
    Unauthorized,
    Undecodable,
    UnknownContentType,
    UnknownModel,
    shortened,
)
from service.grasps import Asked, GraspEndpoint, Reader, check_model, refuse_compressed
from service.openapi import problems
from service.payloads import JSON, OCTET_STREAM, Payload, build_query, media_type, parse_options
from service.payloads.json_body import points_of_json
from service.payloads.json_object import (
    Span,
    broken_chunk,
    members,
    number_chunks,
    only_element,
    refuse_twice,
    undecodable,
)
from service.payloads.options import json_text, option_texts, unknown_option
from service.payloads.payload import Points, as_float32, check_count, refuse_empty
from service.schemas import GraspOptions
from service.settings import Settings, service_version
from tesnet.result import GraspResult

HEADER_LENGTH = "Inference-Header-Content-Length"
INPUT = schemas.TensorMetadata(name="points", datatype="FP32", shape=[-1, 3])
OUTPUTS = [
    schemas.TensorMetadata(name=name, datatype=datatype, shape=shape)
    for name, datatype, shape in (
        ("scores", "FP64", [-1]),
        ("poses", "FP64", [-1, 4, 4]),
        ("hand_poses", "FP64", [-1, 4, 4]),
        ("pregrasps", "FP64", [-1, 4, 4]),
        ("widths", "FP64", [-1]),
        ("approach_points", "FP64", [-1, 3]),
        ("contact_points", "FP64", [-1, 3]),
        ("meta", "BYTES", [1]),
    )
]

_FIELDS = ("id", "parameters", "inputs", "outputs")
_BINARY_OUTPUT = "binary_data_output"
_TIMEOUT = "timeout"
"""Microseconds that a request may wait for its turn: Triton's extension for schedulers."""
_UNSUPPORTED = ("priority", "sequence_id", "sequence_start", "sequence_end")
"""What else Triton's clients can send for its schedulers."""
_MAX_FIELD_BYTES = 65_536
"""JSON text of `id` and of `outputs`."""


class _InputParameters(msgspec.Struct, forbid_unknown_fields=True):
    binary_data_size: int | None = None


class _Input(msgspec.Struct, forbid_unknown_fields=True):
    """An input, but for its data."""

    name: str
    shape: tuple[int, int]
    datatype: str
    parameters: _InputParameters | None = None


class _OutputParameters(msgspec.Struct, forbid_unknown_fields=True):
    binary_data: bool | None = None


class _Output(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    parameters: _OutputParameters | None = None


_PARAMETERS = (*GraspOptions.model_fields, _BINARY_OUTPUT, _TIMEOUT, *_UNSUPPORTED)
_NESTED = re.compile(rb"\[\s*\[")
_NUMBERS = msgspec.json.Decoder(list[float])


_TENSORS = {"type": "array", "items": {"type": "object"}}
_INFER_REQUEST: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            JSON: {
                "schema": {
                    "type": "object",
                    "required": ["inputs"],
                    "properties": {
                        "id": {"type": "string", "description": "Comes back in the answer."},
                        "parameters": {
                            "type": "object",
                            "description": "Options, as in `POST /grasps`; a string holds JSON or a plain word. "
                            f"`{_BINARY_OUTPUT}`: send every output as bytes.",
                        },
                        "inputs": {**_TENSORS, "description": "One: points FP32 [-1, 3]."},
                        "outputs": {**_TENSORS, "description": "The wanted ones; all where none is named."},
                    },
                },
                "example": {
                    "parameters": {"up": "[0, 0, 1]"},
                    "inputs": [{"name": "points", "datatype": "FP32", "shape": [1, 3], "data": [0.01, 0.02, 0.51]}],
                },
            },
            OCTET_STREAM: {
                "schema": {
                    "type": "string",
                    "format": "binary",
                    "description": f"The JSON, of `{HEADER_LENGTH}` bytes, and the input's bytes behind it.",
                }
            },
        },
    }
}
_INFER_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The outputs, as JSON or with bytes behind it.",
        "content": {JSON: {"schema": {"type": "object"}}, OCTET_STREAM: {"schema": {"type": "string"}}},
    }
}
_INFER_PROBLEMS = (
    Undecodable,
    Unauthorized,
    UnknownModel,
    TooLarge,
    UnknownContentType,
    Invalid,
    QueueFull,
    NotReady,
    DeadlineExceeded,
)


def inference_protocol(settings: Settings, worker: PredictionWorker, endpoint: GraspEndpoint) -> APIRouter:
    """The routes under `/v2`.

    Args:
        settings: the limits.
        worker: knows the network.
        endpoint: answers, with the same queue, deadlines and limits as `POST /grasps`.
    """
    router = APIRouter(prefix=INFERENCE_PROTOCOL, tags=["inference protocol"])
    model_problems = problems(NotReady, Unauthorized, UnknownModel)

    def check_path(model: str, version: str | None) -> None:
        loaded = worker.model
        if model != loaded.name or version not in (None, loaded.version):
            what = shortened(model if version is None else f"{model}, version {version}")
            raise UnknownModel(f"{what} is not loaded; loaded: {loaded.name}, version {loaded.version}.")

    @router.get("", summary="Server metadata", responses=problems(Unauthorized))
    async def server() -> schemas.ServerMetadata:
        return schemas.ServerMetadata(name="tes-net", version=service_version(), extensions=["binary_tensor_data"])

    @router.head("/health/live", include_in_schema=False)
    @router.get("/health/live", summary="Does the process work?", responses=problems(NotReady))
    async def live() -> dict[str, bool]:
        worker.check_live()
        return {"live": True}

    @router.head("/health/ready", include_in_schema=False)
    @router.get("/health/ready", summary="Does the service take requests?", responses=problems(NotReady))
    async def ready() -> dict[str, bool]:
        endpoint.check_ready()
        return {"ready": True}

    def add_model(path: str, version_of: Callable[..., str | None]) -> None:
        @router.get(path, summary="Model metadata", responses=model_problems)
        async def describe(model: str, version: str | None = Depends(version_of)) -> schemas.ModelMetadata:
            check_path(model, version)
            return schemas.ModelMetadata(
                name=model, versions=[worker.model.version], platform="pytorch", inputs=[INPUT], outputs=OUTPUTS
            )

        @router.get(f"{path}/ready", summary="Does the model take requests?", responses=model_problems)
        async def model_ready(model: str, version: str | None = Depends(version_of)) -> dict[str, bool]:
            check_path(model, version)
            endpoint.check_ready()
            return {"ready": True}

        @router.post(
            f"{path}/infer",
            summary="Grasps for a point cloud",
            response_class=Response,
            responses=_INFER_RESPONSES | problems(*_INFER_PROBLEMS),
            openapi_extra=_INFER_REQUEST,
        )
        async def infer(request: Request, model: str, version: str | None = Depends(version_of)) -> Response:
            def reader_of(request: Request) -> Reader:
                check_path(model, version)
                return _reader(request, settings, worker)

            return await endpoint.answer(request, reader_of)

    add_model("/models/{model}", _no_version)
    add_model("/models/{model}/versions/{version}", _version_of_path)
    return router


def _no_version() -> None:
    """Any version of the network."""


def _version_of_path(version: str) -> str:
    """The version that the path names."""
    return version


def _reader(request: Request, settings: Settings, worker: PredictionWorker) -> Reader:
    refuse_compressed(request)
    given = request.headers.get("content-type", JSON)  # which Triton's client leaves out
    if media_type(given) not in (JSON, OCTET_STREAM):
        raise UnknownContentType(f"Content-Type {shortened(given)} is not supported; send {JSON} or {OCTET_STREAM}.")
    if request.scope["query_string"]:
        raise Invalid("query string", "has no meaning here; options go into `parameters` of the body")
    head_length = request.headers.get(HEADER_LENGTH)
    if head_length is not None and not re.fullmatch(r"\d{1,10}", head_length):
        raise Invalid(HEADER_LENGTH, f"is {shortened(head_length)}; give the bytes of the JSON at the body's beginning")
    request_id = request.state.record.request_id

    def read(body: bytearray) -> Asked:
        refuse_empty(body)
        head = len(body) if head_length is None else int(head_length)
        if head > len(body):
            raise Undecodable(f"{HEADER_LENGTH} is {head}, but the body has {len(body)} bytes; it was cut off.")
        fields = _given(members(Span(body, 0, head), "inference request", _FIELDS, _unknown_field))
        parameters = _parameters(fields.get("parameters"), settings.max_points)
        all_binary = parameters.pop(_BINARY_OUTPUT, b"false")
        if all_binary not in (b"true", b"false"):
            raise Invalid(_BINARY_OUTPUT, f"is {shortened(all_binary.decode())}; give true or false")
        timeout = _timeout(parameters.pop(_TIMEOUT, None))
        outputs = _outputs(fields.get("outputs"), all_binary == b"true")
        identity = _bounded(fields["id"], "id", str) if "id" in fields else ""
        points = _points(fields.get("inputs"), memoryview(body)[head:], settings.max_points)
        options = parse_options(parameters, settings.max_points)
        check_model(options, worker.model)

        def write(result: GraspResult, timings_ms: Mapping[str, float]) -> Response:
            arrays = answer_arrays(result, options)
            meta = answer_meta(result, worker.model, timings_ms, request_id)
            head = {"model_name": worker.model.name, "model_version": worker.model.version}
            return _response(head | ({"id": identity} if identity else {}), arrays, meta, outputs)

        return Asked(build_query(Payload(points), options), write, timeout)

    return read


def _given(values: Mapping[str, Span]) -> dict[str, Span]:
    """The values but for nulls, which are as good as left out."""
    return {name: text for name, text in values.items() if bytes(text.view[:5]) != b"null"}


def _unknown_field(name: str) -> Invalid:
    return Invalid("body", f"has a field {shortened(name)}, which there is not; fields: {', '.join(_FIELDS)}")


def _no_part_of_input(name: str) -> Invalid:
    return Invalid("inputs", f"have a field {shortened(name)}; give one of {INPUT.name} {INPUT.datatype} {INPUT.shape}")


def _parameters(text: Span | None, max_indices: int) -> dict[str, bytes]:
    """Options, and `binary_data_output`, as JSON text."""
    values = {} if text is None else _given(members(text, "parameters", _PARAMETERS, unknown_option))
    for name in values:
        if name in _UNSUPPORTED:
            raise Invalid(name, "is not supported: requests are answered in the order in which they come; leave it out")
    texts = option_texts(values, max_indices)
    return {name: _unquoted(name, value) if value[:1] == b'"' else value for name, value in texts.items()}


def _unquoted(name: str, text: bytes) -> bytes:
    """The JSON text that a string holds."""
    try:
        return json_text(name, msgspec.json.decode(text, type=str).encode())
    except (msgspec.DecodeError, UnicodeError) as error:
        raise undecodable(name, text, error) from None


def _timeout(text: bytes | None) -> float:
    """Seconds that the request may wait for its turn; 0 is no limit, as in Triton.

    Raises:
        Invalid: not a whole number of microseconds.
    """
    if text is None:
        return math.inf
    if not re.fullmatch(rb"\d{1,12}", text):
        raise Invalid(_TIMEOUT, f"is {shortened(text[:400].decode())}; give whole microseconds, at most {10**12 - 1}")
    return int(text) / 1e6 or math.inf


def _bounded(text: Span, name: str, kind: Any) -> Any:
    """A small field's value.

    Raises:
        Undecodable: no JSON.
        Invalid: it is large, or of another type.
    """
    if len(text) > _MAX_FIELD_BYTES:
        raise Invalid(name, f"has {len(text)} bytes (limit {_MAX_FIELD_BYTES}); shorten it")
    try:
        value = msgspec.json.decode(text.view, type=kind)
    except msgspec.ValidationError as error:
        raise Invalid(name, f"cannot be used: {shortened(str(error))}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise undecodable(name, text.view, error) from None
    refuse_twice(bytes(text))
    return value


def _outputs(text: Span | None, all_binary: bool) -> dict[str, bool]:
    """The wanted outputs, each with whether it is to be binary; all of them where none is named."""
    asked: list[_Output] = [] if text is None else _bounded(text, "outputs", list[_Output])
    known = [output.name for output in OUTPUTS]
    for output in asked:
        if output.name not in known:
            raise Invalid("outputs", f"name {shortened(output.name)}, which there is not; valid: {', '.join(known)}")
    if not asked:
        return dict.fromkeys(known, all_binary)
    chosen = {output.name: output.parameters.binary_data if output.parameters else None for output in asked}
    return {name: all_binary if binary is None else binary for name, binary in chosen.items()}


def _points(inputs: Span | None, tail: memoryview, max_points: int) -> Points:
    """The input tensor (N, 3), from the JSON or from the bytes behind it."""
    if inputs is None:
        raise Invalid("inputs", f"are missing; give one, {INPUT.name} {INPUT.datatype} {INPUT.shape}")
    fields = members(only_element(inputs, "inputs"), "inputs", (*_Input.__struct_fields__, "data"), _no_part_of_input)
    data = fields.pop("data", None)
    rest = msgspec.json.encode({name: msgspec.Raw(text.view) for name, text in fields.items()})
    given: _Input = _bounded(Span.of(rest), "inputs", _Input)
    if (given.name, given.datatype) != (INPUT.name, INPUT.datatype):
        what = shortened(f"{given.name} of {given.datatype}")
        raise Invalid("inputs", f"hold {what}; give {INPUT.name} of {INPUT.datatype}")
    count, width = given.shape
    if count < 0 or width != 3:
        raise Invalid("inputs", f"have shape [{count}, {width}]; give [N, 3]")
    check_count(count, max_points)
    size = given.parameters.binary_data_size if given.parameters else None
    if size is not None and data is None:
        return _binary_points(tail, count, size)
    if size is not None or data is None:
        raise Invalid("inputs", "need either data or the parameter binary_data_size")
    if len(tail):
        raise Undecodable(f"{len(tail)} bytes follow the JSON, which announces no binary tensor.")
    points = _json_points(data, max_points)
    if len(points) != count:
        raise Invalid("inputs", f"have {len(points)} points of data; the shape says {count}")
    return points


def _binary_points(tail: memoryview, count: int, size: int) -> Points:
    if not size == len(tail) == 12 * count:
        raise Undecodable(
            f"binary_data_size is {size}, {len(tail)} bytes follow the JSON, and shape [{count}, 3] of FP32 needs "
            f"{12 * count}; the three must agree."
        )
    return np.frombuffer(tail, "<f4").reshape(-1, 3)


def _json_points(data: Span, max_points: int) -> Points:
    """(N, 3) of an array of triples, or of their numbers in a row."""
    if _NESTED.match(data.text, data.start, data.end):
        return points_of_json(data, max_points)
    check_count(math.ceil(data.count(b",") / 3), max_points)
    parts = []
    try:
        for chunk in number_chunks(data):
            parts.append(np.array(_NUMBERS.decode(chunk), np.float64))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise broken_chunk("inputs", data, chunk, error) or Invalid(
            "inputs", f"have data that are no numbers: {shortened(str(error))}"
        ) from None
    numbers = np.concatenate(parts)
    if len(numbers) % 3:
        raise Invalid("inputs", f"have {len(numbers)} numbers of data, not a multiple of 3; give x, y, z of each point")
    return as_float32(numbers.reshape(-1, 3))


def _response(
    head: dict[str, str], arrays: Mapping[str, NDArray[np.float64]], meta: bytes, outputs: Mapping[str, bool]
) -> Response:
    """The answer: JSON, and behind it the tensors that were asked for as bytes."""
    tensors: list[dict[str, Any]] = []
    tail: list[bytes] = []
    for described in OUTPUTS:
        if described.name not in outputs:
            continue
        is_text = described.name == "meta"
        array = None if is_text else arrays[described.name]
        tensor: dict[str, Any] = {
            "name": described.name,
            "datatype": described.datatype,
            "shape": [1] if array is None else list(array.shape),
        }
        if outputs[described.name]:
            data = len(meta).to_bytes(4, "little") + meta if array is None else array.astype("<f8").tobytes()
            tensor["parameters"] = {"binary_data_size": len(data)}
            tail.append(data)
        else:
            tensor["data"] = [meta.decode()] if array is None else array.ravel().tolist()
        tensors.append(tensor)
    text = msgspec.json.encode(head | {"outputs": tensors})
    if not tail:
        return Response(text, media_type=JSON)
    return Response(b"".join([text, *tail]), media_type=OCTET_STREAM, headers={HEADER_LENGTH: str(len(text))})
