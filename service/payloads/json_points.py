"""JSON arrays of triples -> arrays (N, 3), chunk by chunk."""

from __future__ import annotations

import contextlib
import re

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid, ServiceError, shortened
from service.payloads.json_object import CHUNK, Span, broken_chunk, row_chunks
from service.payloads.payload import Points, kept
from tesnet.errors import TooManyPoints


def points_of_json(span: Span, max_points: int, name: str = "points") -> Points:
    """(N, 3) of the text of an array of triples, which is called `name`.

    Raises:
        Undecodable: no JSON.
        Invalid: JSON of something else, NaN or an infinity.
        TooManyPoints: more than the limit.
    """
    parts: list[Points] = []
    count = 0
    for chunk in row_chunks(span):
        try:
            triples = _triples(chunk)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise _points_error(span, chunk, error, count, name) from None
        count += len(triples)
        if count > max_points:
            raise TooManyPoints(f"more than {max_points}", max_points)
        parts.append(kept(triples))
    return np.concatenate(parts)


def _triples(text: bytes | memoryview) -> NDArray[np.float64]:
    """(N, 3) of the text of an array of triples.

    Where nothing but brackets and commas is left without the characters of numbers, and these are those of N triples,
    the numbers are decoded as one flat list: half the time, and no object for a point. Brackets become spaces for it,
    so that what they part stays apart.

    Raises:
        msgspec.DecodeError, RecursionError: it is something else; the message names the first bad element.
    """
    if len(text) > 2 * CHUNK:  # nothing but white space makes a chunk of triples so long
        return np.array(_TRIPLES.decode(text), np.float64).reshape(-1, 3)
    text = bytes(text)
    brackets = text.translate(None, b"0123456789+-.eE \t\r\n")
    count = len(brackets) // len(b"[,,],")
    if count and brackets == b"[" + b",".join([b"[,,]"] * count) + b"]":
        with contextlib.suppress(msgspec.ValidationError):  # a number out of range: the other decoder says which
            numbers = _NUMBERS.decode(b"[" + text.translate(_SPACES_FOR_BRACKETS) + b"]")
            return np.fromiter(numbers, np.float64, 3 * count).reshape(-1, 3)
    return np.array(_TRIPLES.decode(text), np.float64).reshape(-1, 3)


_SPACES_FOR_BRACKETS = bytes.maketrans(b"[]", b"  ")
_NUMBERS = msgspec.json.Decoder(list[float])
_TRIPLES = msgspec.json.Decoder(list[tuple[float, float, float]])
"""Stops at the first element that is not three numbers, so hostile text costs no memory."""


def _points_error(span: Span, chunk: bytes | memoryview, error: Exception, offset: int, name: str) -> ServiceError:
    """The problem with a chunk of points that are not triples of numbers; `offset` points were decoded before."""
    if problem := broken_chunk(name, span, chunk, error):
        return problem
    where = re.search(r"\$\[(\d+)\]", str(error))
    place = f"point {offset + int(where[1])}" if where else "the points"
    what = (
        re.sub(r" - at `.*`$", "", str(error))
        if isinstance(error, msgspec.ValidationError)
        else "not an array of arrays"
    )
    return Invalid(name, f"must be an array of [x, y, z] of finite numbers in metres; {place}: {shortened(what)}")
