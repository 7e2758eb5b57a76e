"""The bodies of `infer` -> what they ask: JSON, or JSON with the tensor's bytes behind it. Knows no routes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid, Undecodable, shortened
from service.inference_protocol.tensors import BINARY_OUTPUT, HEADER_LENGTH, INPUT, INPUTS, OUTPUTS
from service.payloads import Payload, parse_options
from service.payloads.json_object import (
    Span,
    broken_chunk,
    members,
    number_chunks,
    objects,
    refuse_twice,
    undecodable,
)
from service.payloads.json_points import points_of_json
from service.payloads.options import json_text, option_texts, unknown_option
from service.payloads.payload import BesidePoints, check_count, cloud_payload, kept, most_rows, refuse_empty
from service.payloads.per_point import known_normals
from service.schemas import GraspOptions

_FIELDS = ("id", "parameters", "inputs", "outputs")
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
    shape: tuple[int, ...]
    datatype: str
    parameters: _InputParameters | None = None


class _OutputParameters(msgspec.Struct, forbid_unknown_fields=True):
    binary_data: bool | None = None


class _Output(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    parameters: _OutputParameters | None = None


_PARAMETERS = (*GraspOptions.model_fields, BINARY_OUTPUT, _TIMEOUT, *_UNSUPPORTED)
_NESTED = re.compile(rb"\[\s*\[")
_NUMBERS = msgspec.json.Decoder(list[float])
_WHOLE_NUMBERS = msgspec.json.Decoder(list[int])
_WHOLE: Mapping[str, str] = {
    f"{sign}INT{8 * size}": f"<{sign.lower() or 'i'}{size}" for sign in ("", "U") for size in (1, 2, 4, 8)
}
"""The protocol's names of whole numbers, and numpy's."""
_EXPECTED = ", ".join(f"{tensor.name} {tensor.datatype} {tensor.shape}" for tensor in INPUTS) + " (the first at least)"


@dataclass(frozen=True, eq=False, slots=True)
class InferRequest:
    """A decoded body.

    Args:
        payload: the points.
        options: checked.
        outputs: the wanted ones, each with whether it is to be binary.
        identity: what the client calls the request; empty where it does not.
        timeout: seconds that the request may wait for its turn.
    """

    payload: Payload
    options: GraspOptions
    outputs: Mapping[str, bool]
    identity: str
    timeout: float


def decode(body: bytearray, head_length: int | None, max_points: int) -> InferRequest:
    """What a body asks.

    Args:
        body: JSON, and perhaps the bytes of a tensor behind it.
        head_length: bytes of the JSON; None is all of them.
        max_points: the limit.

    Raises:
        Undecodable, TooManyPoints, Invalid: as the table in `service.errors` has them.
    """
    refuse_empty(body)
    head = len(body) if head_length is None else head_length
    if head > len(body):
        raise Undecodable(f"{HEADER_LENGTH} is {head}, but the body has {len(body)} bytes; it was cut off.")
    fields = _given(members(Span(body, 0, head), "inference request", _FIELDS, _unknown_field))
    parameters = _parameters(fields.get("parameters"), max_points)
    all_binary = parameters.pop(BINARY_OUTPUT, b"false")
    if all_binary not in (b"true", b"false"):
        raise Invalid(BINARY_OUTPUT, f"is {shortened(all_binary.decode())}; give true or false")
    timeout = _timeout(parameters.pop(_TIMEOUT, None))
    outputs = _outputs(fields.get("outputs"), all_binary == b"true")
    identity = _bounded(fields["id"], "id", str) if "id" in fields else ""
    arrays = _arrays(fields.get("inputs"), memoryview(body)[head:], max_points)
    return InferRequest(
        _payload(arrays, is_binary=head < len(body)), parse_options(parameters, max_points), outputs, identity, timeout
    )


def _given(values: Mapping[str, Span]) -> dict[str, Span]:
    """The values but for nulls, which are as good as left out."""
    return {name: text for name, text in values.items() if bytes(text.view[:5]) != b"null"}


def _unknown_field(name: str) -> Invalid:
    return Invalid("body", f"has a field {shortened(name)}, which there is not; fields: {', '.join(_FIELDS)}")


def _no_part_of_input(name: str) -> Invalid:
    return Invalid("inputs", f"have a field {shortened(name)}; give {_EXPECTED}")


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


def _arrays(inputs: Span | None, tail: memoryview, max_points: int) -> dict[str, NDArray[Any]]:
    """The input tensors by name, from the JSON or from the bytes behind it, where they follow each other."""
    if inputs is None:
        raise Invalid("inputs", f"are missing; give {_EXPECTED}")
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    for text in objects(inputs, "inputs", len(INPUTS)):
        fields = members(text, "inputs", (*_Input.__struct_fields__, "data"), _no_part_of_input)
        data = fields.pop("data", None)
        rest = msgspec.json.encode({name: msgspec.Raw(span.view) for name, span in fields.items()})
        given: _Input = _bounded(Span.of(rest), "inputs", _Input)
        _check(given, arrays, max_points)
        size = given.parameters.binary_data_size if given.parameters else None
        if (size is None) == (data is None):
            raise Invalid("inputs", "need either data or the parameter binary_data_size")
        if data is None:
            arrays[given.name] = _of_bytes(given, tail[at : at + (size or 0)], size or 0)
            at += size or 0
        else:
            arrays[given.name] = _of_json(given, data, max_points)
    if at < len(tail):
        raise Undecodable(f"{len(tail) - at} bytes follow the JSON and the binary tensors that it announces.")
    if INPUT.name not in arrays:
        raise Invalid("inputs", f"hold no {INPUT.name}; give {_EXPECTED}")
    return arrays


def _check(given: _Input, arrays: Mapping[str, NDArray[Any]], max_points: int) -> None:
    """Raise where a tensor is none of those that are known, or of a shape that none of them has."""
    known = next((tensor for tensor in INPUTS if tensor.name == given.name), None)
    types = _WHOLE if known and known.datatype == "INT32" else {"FP32": "<f4"}
    if known is None or given.datatype not in types:
        what = shortened(f"{given.name} of {given.datatype}")
        raise Invalid("inputs", f"hold {what}; give {_EXPECTED}")
    if given.name in arrays:
        raise Invalid("inputs", f"hold {given.name} twice; give it once")
    count, *width = given.shape or [-1]
    if count < 0 or width != known.shape[1:]:
        what = shortened(f"{list(given.shape)} of {given.name}")
        wanted = str(known.shape).replace("-1", "N")
        raise Invalid("inputs", f"have shape {what}, of another length; give {wanted}")
    check_count(count, most_rows(max_points))


def _of_bytes(given: _Input, tail: memoryview, size: int) -> NDArray[Any]:
    dtype = np.dtype(_WHOLE.get(given.datatype, "<f4"))
    wanted = dtype.itemsize * math.prod(given.shape)
    if not size == len(tail) == wanted:
        raise Undecodable(
            f"binary_data_size of {given.name} is {shortened(str(size))}, {len(tail)} bytes follow for it, and shape "
            f"{list(given.shape)} of {given.datatype} needs {wanted}; the three must agree."
        )
    return np.frombuffer(tail, dtype).reshape(given.shape)


def _of_json(given: _Input, data: Span, max_points: int) -> NDArray[Any]:
    """An array of triples, or its numbers in a row."""
    rows = most_rows(max_points)
    if _NESTED.match(data.text, data.start, data.end) and len(given.shape) > 1:
        array: NDArray[Any] = points_of_json(data, rows, given.name)
    else:
        array = _flat(given, data, rows)
    if len(array) != given.shape[0]:
        check_count(given.shape[0], max_points)
        raise Invalid("inputs", f"have {len(array)} points of data; the shape says {given.shape[0]}")
    return array


def _flat(given: _Input, data: Span, rows: int) -> NDArray[Any]:
    width = math.prod(given.shape[1:])
    check_count(math.ceil(data.count(b",") / width), rows)
    is_whole = given.datatype in _WHOLE
    decoder = _WHOLE_NUMBERS if is_whole else _NUMBERS
    parts = []
    try:
        for chunk in number_chunks(data):
            parts.append(np.array(decoder.decode(chunk), np.int64 if is_whole else np.float64))
    except (msgspec.DecodeError, OverflowError, UnicodeDecodeError, RecursionError) as error:
        raise broken_chunk("inputs", data, chunk, error) or Invalid(
            "inputs", f"have data that are no numbers: {shortened(str(error))}"
        ) from None
    numbers = np.concatenate(parts)
    if len(numbers) % width:
        raise Invalid("inputs", f"have {len(numbers)} numbers of data, not a multiple of 3; give x, y, z of each point")
    return numbers if is_whole else kept(numbers.reshape(-1, width))


def _payload(arrays: Mapping[str, NDArray[Any]], is_binary: bool) -> Payload:
    """Points that are not finite are left out where they came as bytes; JSON cannot say them."""
    beside: BesidePoints = {}
    if "view_index" in arrays:
        beside["view_index"] = arrays["view_index"]
    if "normals" in arrays:
        beside["normals"] = known_normals(arrays["normals"])
    points = arrays[INPUT.name]
    return cloud_payload(points, beside=beside) if is_binary else Payload(points, **beside)
