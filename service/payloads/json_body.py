"""`application/json`: `{"points": [[x, y, z], ...], ...options}`, decoded piece by piece."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid, ServiceError, Undecodable, shortened
from service.payloads.options import NOT_UTF8, is_json, option_texts, raw_object, raw_values, unknown_option
from service.payloads.payload import Payload, Points, as_float32, refuse_empty
from service.schemas import GraspOptions
from tesnet.errors import TooManyPoints

_BODY = raw_object(("points", *GraspOptions.model_fields))


def decode_json(body: bytearray, max_points: int) -> Payload:
    """`{"points": [[x, y, z], ...], ...options}`."""
    refuse_empty(body)
    try:
        values = raw_values(_BODY.decode(body))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise object_error(body, error, '{"points": [[x, y, z], ...]}') from None
    points = values.pop("points", None)
    options = option_texts(values)
    if points is None:
        raise Invalid("points", "is missing; give [[x, y, z], ...] in metres")
    return Payload(points_of_json(points, max_points), options)


def object_error(body: bytes | bytearray, error: Exception, expected: str, name: str = "body") -> ServiceError:
    """The problem with text that is no JSON object of known names: a body, or the part `options` of a form."""
    message = str(error)
    if isinstance(error, RecursionError):
        return Undecodable("The JSON is nested too deeply; a point cloud is an array of arrays of numbers.")
    if isinstance(error, UnicodeDecodeError):
        return Undecodable(NOT_UTF8)
    if isinstance(error, msgspec.ValidationError):
        if not is_json(bytes(body)):
            return Undecodable(f"The {name} is not valid JSON; it was cut off or damaged.")
        unknown = re.match(r"Object contains unknown field `(.*)`", message, re.DOTALL)
        if unknown:
            return unknown_option(unknown[1])
        return Invalid(name, f"is not a JSON object ({shortened(message)}); send {expected}")
    position = re.search(r"\(byte (\d+)\)", message)
    if position and re.match(
        rb"-?(NaN|Infinity|nan|inf)", bytes(body[max(0, int(position[1]) - 1) : int(position[1]) + 9]).lstrip(b" ,[:-")
    ):
        return Invalid(
            "points", f"hold NaN or an infinity (at byte {position[1]}), which JSON does not know; remove such points"
        )
    return Undecodable(f"The JSON of the {name} cannot be read: {shortened(message)}.")


_CHUNK = 1 << 17
"""Bytes of points decoded in one go: some 3 ms and a few MB, whatever the size of the cloud."""


def points_of_json(text: memoryview, max_points: int) -> Points:
    """(N, 3) float32 of the text of an array of triples, which is known to be JSON."""
    parts: list[Points] = []
    count = 0
    for chunk in _chunks(bytes(text)):
        try:
            triples = _triples(chunk)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise _points_error(error, count) from None
        count += len(triples)
        if count > max_points:
            raise TooManyPoints(f"more than {max_points}", max_points)
        parts.append(as_float32(triples))
    return np.concatenate(parts)


def _triples(text: bytes) -> NDArray[np.float64]:
    """(N, 3) of the text of an array of triples.

    Where nothing but brackets and commas is left without the characters of numbers, and these are those of N triples,
    the numbers are decoded as one flat list: half the time, and no object for a point.

    Raises:
        msgspec.DecodeError, RecursionError: it is something else; the message names the first bad element.
    """
    brackets = text.translate(None, b"0123456789+-.eE \t\r\n")
    count = len(brackets) // len(b"[,,],")
    if count and brackets == b"[" + b",".join([b"[,,]"] * count) + b"]":
        with contextlib.suppress(msgspec.ValidationError):  # a number out of range: the other decoder says which
            numbers = _NUMBERS.decode(b"[" + text.translate(None, b"[] \t\r\n") + b"]")
            return np.fromiter(numbers, np.float64, 3 * count).reshape(-1, 3)
    return np.array(_TRIPLES.decode(text), np.float64).reshape(-1, 3)


_NUMBERS = msgspec.json.Decoder(list[float])
_TRIPLES = msgspec.json.Decoder(list[tuple[float, float, float]])
"""Stops at the first element that is not three numbers, so hostile text costs no memory."""


def _chunks(text: bytes) -> Iterator[bytes]:
    """A JSON array of arrays as several such arrays, cut where one of a point ends.

    Text of another form is cut where it means something else, or not at all; decoding refuses it then.
    """
    start = 0
    while (end := text.find(b"]", start + _CHUNK)) >= 0 and (comma := _NEXT_COMMA.match(text, end + 1)):
        piece = text[start : end + 1]
        yield (b"[" if start else b"") + piece + b"]"
        start = comma.end()
    yield (b"[" if start else b"") + text[start:]


_NEXT_COMMA = re.compile(rb"[ \t\r\n]*,")


def _points_error(error: Exception, offset: int) -> ServiceError:
    """The problem with points that are not triples of numbers; `offset` points were decoded before."""
    where = re.search(r"\$\[(\d+)\]", str(error))
    place = f"point {offset + int(where[1])}" if where else "the points"
    what = (
        re.sub(r" - at `.*`$", "", str(error))
        if isinstance(error, msgspec.ValidationError)
        else "not an array of arrays"
    )
    return Invalid("points", f"must be an array of [x, y, z] of finite numbers in metres; {place}: {shortened(what)}")
