"""The bodies of `infer` -> what they ask: JSON, or JSON with the tensor's bytes behind it. Knows no routes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from service.errors import Invalid, Undecodable, shortened
from service.inference_protocol.tensors import BINARY_OUTPUT, HEADER_LENGTH, INPUT, OUTPUTS
from service.payloads import Payload, parse_options
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
    shape: tuple[int, int]
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
    points = _points(fields.get("inputs"), memoryview(body)[head:], max_points)
    return InferRequest(Payload(points), parse_options(parameters, max_points), outputs, identity, timeout)


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
        raise Invalid("inputs", f"have shape {shortened(str([count, width]))}; give [N, 3]")
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
            f"binary_data_size is {shortened(str(size))}, {len(tail)} bytes follow the JSON, and shape [{count}, 3] of "
            f"FP32 needs {12 * count}; the three must agree."
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
