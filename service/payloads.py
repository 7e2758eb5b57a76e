"""Request bodies and query strings -> points and options. One decoder a format; knows no routes.

Nothing is allocated before its size is checked. Decoders run off the event loop; those for big bodies give the
interpreter's lock back every few milliseconds.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from urllib.parse import unquote_to_bytes

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from pydantic import ValidationError

from service.errors import Invalid, ServiceError, TooLarge, Undecodable, shortened
from service.schemas import GraspOptions
from tesnet.query import ApproachCone, Box, GraspQuery

OCTET_STREAM = "application/octet-stream"
NPY = "application/x-npy"
JSON = "application/json"

MAX_OPTIONS_BYTES = 65_536
"""JSON text of all options together."""

NOT_YET = {
    "target": "this version grasps anything in the cloud; crop with `workspace` instead",
    "gripper": "this version plans for the Panda hand only",
}
"""Options of the interface that later versions take."""

Points = NDArray[np.float32]
RawOptions = Mapping[str, bytes]
"""Option name -> its value as JSON text."""


@dataclass(frozen=True, eq=False, slots=True)
class Payload:
    """A decoded body: points (N, 3) float32 in the cloud frame, not yet checked, and options that came with them."""

    points: Points
    options: RawOptions


Decoder = Callable[[bytearray, int], Payload]
"""body, most points -> payload. Raises Undecodable (400), TooLarge (413) or Invalid (422)."""


def build_query(points: Points, options: GraspOptions) -> GraspQuery:
    """Points and checked options as the predictor's query.

    Raises:
        InvalidQuery: what only the library can judge: NaN, not metres, empty boxes.
    """
    workspace = options.workspace
    approach = options.approach
    return GraspQuery(
        points=points,
        viewpoints=None if options.viewpoint is None else np.array(options.viewpoint, dtype=np.float64).reshape(-1, 3),
        up=None if options.up is None else np.array(options.up),
        workspace=None if workspace is None else Box(np.array(workspace.min), np.array(workspace.max)),
        support_height=options.support_height,
        approach=None if approach is None else ApproachCone(np.array(approach.direction), approach.max_angle_deg),
        max_grasps=options.max_grasps,
        min_score=options.min_score,
        separation_translation=options.min_separation.translation,
        separation_rotation_deg=options.min_separation.rotation_deg,
        num_approach_points=options.num_approach_points,
        max_candidates=options.max_candidates,
        unseen=options.unseen,
        seed=options.seed,
    )


# ------------------------------------------------------------------------------------------------------------- options


def parse_query_string(query_string: bytes) -> RawOptions:
    """Options of a URL: each value is URL-encoded JSON, a plain word needs no quotes.

    Raises:
        Invalid: a name that occurs twice, a value that is neither JSON nor a plain word.
    """
    options: dict[str, bytes] = {}
    for pair in filter(None, query_string.split(b"&")):
        raw_name, _, raw_value = pair.replace(b"+", b" ").partition(b"=")
        name = unquote_to_bytes(raw_name).decode("utf-8", "replace")
        if name in options:
            raise Invalid(shortened(name), "is given twice in the query string; give it once")
        if name == "points":
            raise Invalid(name, "is no option of the query string; points are the body")
        options[name] = _json_text(name, unquote_to_bytes(raw_value))
    return options


def merged(first: RawOptions, second: RawOptions) -> RawOptions:
    """Options of query string and body together.

    Raises:
        Invalid: one given in both.
    """
    for name in first.keys() & second.keys():
        raise Invalid(name, "is given in the query string and in the body; give it once")
    return {**first, **second}


def parse_options(raw: RawOptions) -> GraspOptions:
    """Checked options. A null counts as not given.

    Raises:
        Invalid: an unknown name, a value of the wrong type or out of range; the message says what is expected.
    """
    for name in raw:
        if name not in GraspOptions.model_fields:
            raise _unknown_option(name)
    given = {name: value for name, value in raw.items() if value != b"null"}
    size = sum(map(len, given.values()))
    if size > MAX_OPTIONS_BYTES:
        largest = max(given, key=lambda name: len(given[name]))
        raise Invalid(largest, f"is too long: the options have {size} bytes (limit {MAX_OPTIONS_BYTES}); shorten them")
    text = b"{" + b",".join(b'"%b":%b' % (name.encode(), value) for name, value in given.items()) + b"}"
    try:
        return GraspOptions.model_validate_json(text)
    except ValidationError as error:
        raise _invalid_option(error, given) from None


def _json_text(name: str, value: bytes) -> bytes:
    if _is_json(value):
        return value.strip()
    if re.fullmatch(rb"[A-Za-z][\w.-]*", value):
        return b'"%b"' % value
    text = shortened(value.decode("utf-8", "replace")) or "empty"
    raise Invalid(
        shortened(name), f"is {text}, neither JSON nor a plain word; URL-encode JSON, for example [0.3,0,0.6]"
    )


def _is_json(text: bytes) -> bool:
    try:
        msgspec.json.decode(text, type=msgspec.Raw)
    except (msgspec.DecodeError, RecursionError):
        return False
    return _is_utf8(text)


def _is_utf8(text: bytes) -> bool:
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _unknown_option(name: str) -> Invalid:
    if name in NOT_YET:
        return Invalid(name, f"is not supported yet: {NOT_YET[name]}")
    known = list(GraspOptions.model_fields)
    close = difflib.get_close_matches(name[:64], known, 1)
    hint = f"did you mean {close[0]}? " if close else ""
    return Invalid(shortened(name), f"is no option; {hint}valid: {', '.join(known)}")


def _invalid_option(error: ValidationError, given: RawOptions) -> Invalid:
    first = error.errors(include_url=False, include_input=False)[0]
    if not first["loc"]:
        return Invalid(next(iter(given)), f"or another option cannot be read: {shortened(first['msg'])}")
    name, *inside = first["loc"]
    field = str(name)
    value = shortened(given[field].decode("utf-8", "replace"))
    if field == "support_height" and value == '"auto"':
        return Invalid(field, "is auto, which is not supported yet; give the height of the support plane in metres")
    path = [str(part) for part in inside if field != "viewpoint"]  # there, pydantic names branches of a union
    where = f" (at {'.'.join(path)})" if path else ""
    what = first["msg"][:1].lower() + first["msg"][1:]
    if first["type"] == "extra_forbidden":
        what = "there is no such name"
    return Invalid(field, f"is {value}: {what}{where}. Expected: {GraspOptions.model_fields[field].description}")


# -------------------------------------------------------------------------------------------------------------- bodies


def decode_octet_stream(body: bytearray, max_points: int) -> Payload:
    """Little-endian float32 x, y, z triples."""
    _refuse_empty(body)
    if len(body) % 12:
        raise Undecodable(
            f"The body has {len(body)} bytes, not a multiple of 12; send x, y, z of a point as little-endian float32."
        )
    _check_count(len(body) // 12, max_points)
    return Payload(np.frombuffer(body, "<f4").reshape(-1, 3), {})


def decode_npy(body: bytearray, max_points: int) -> Payload:
    """A .npy array (N, 3) of float32 or float64. Its header is parsed by numpy; nothing is ever unpickled."""
    _refuse_empty(body)
    shape, fortran_order, dtype, start = _npy_header(body)
    if dtype.hasobject:
        raise Undecodable(
            "The .npy holds pickled objects, which are never loaded; save an array of float32 or float64."
        )
    if dtype.kind != "f" or dtype.itemsize not in (4, 8):
        raise Invalid("points", f"are an array of {shortened(str(dtype))}; save float32 or float64")
    if len(shape) != 2 or shape[1] != 3:
        raise Invalid("points", f"have shape {shortened(str(shape))}; save an array of shape (N, 3)")
    _check_count(shape[0], max_points)
    expected = shape[0] * 3 * dtype.itemsize
    if len(body) - start != expected:
        raise Undecodable(
            f"The .npy has {len(body) - start} bytes of data, its header says {expected}; it was cut off or damaged."
        )
    flat = np.frombuffer(body, dtype, offset=start)
    array = flat.reshape(3, -1).T if fortran_order else flat.reshape(-1, 3)
    return Payload(_as_float32(array), {})


def decode_json(body: bytearray, max_points: int) -> Payload:
    """`{"points": [[x, y, z], ...], ...options}`."""
    _refuse_empty(body)
    try:
        fields = msgspec.structs.asdict(_JSON_BODY.decode(body))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _json_error(body, error) from None
    values = {
        name: bytes(memoryview(raw)) for name, raw in fields.items() if raw is not msgspec.UNSET and name != "points"
    }
    if not all(map(_is_utf8, values.values())):
        raise Undecodable(_NOT_UTF8)
    if fields["points"] is msgspec.UNSET:
        raise Invalid("points", "is missing; give [[x, y, z], ...] in metres")
    return Payload(_points_of_json(memoryview(fields["points"]), max_points), values)


DECODERS: Mapping[str, Decoder] = {JSON: decode_json, OCTET_STREAM: decode_octet_stream, NPY: decode_npy}
"""Content type -> decoder."""


def _refuse_empty(body: bytearray) -> None:
    if not body:
        raise Undecodable("The body is empty; send the points of a cloud.")


def _check_count(count: int, max_points: int) -> None:
    if count > max_points:
        raise TooLarge(f"The cloud has {count} points (limit {max_points}); crop or downsample it.")


def _as_float32(array: NDArray[np.floating]) -> Points:
    with np.errstate(over="ignore"):  # what overflows becomes infinite, and is refused as that
        return np.ascontiguousarray(array, dtype=np.float32)


def _npy_header(body: bytearray) -> tuple[tuple[int, ...], bool, np.dtype[np.generic], int]:
    """Shape, Fortran order, dtype, and where the data starts."""
    file = io.BytesIO(memoryview(body)[:MAX_OPTIONS_BYTES])  # numpy refuses headers over 10,000 bytes anyway
    try:
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, dtype = read_header(file)
    except Exception as error:  # noqa: BLE001 - numpy evaluates the header's text, and hostile text fails in many ways
        raise Undecodable(f"The .npy header cannot be read ({shortened(str(error))}); save the file again.") from None
    if any(size < 0 for size in shape):
        raise Undecodable(f"The .npy header has a negative size: {shortened(str(shape))}; save the file again.")
    return shape, fortran_order, dtype, file.tell()


# ---------------------------------------------------------------------------------------------------------------- JSON

_JSON_BODY = msgspec.json.Decoder(
    msgspec.defstruct(
        "JsonBody",
        [
            (name, msgspec.Raw | msgspec.UnsetType, msgspec.UNSET)
            for name in ("points", *GraspOptions.model_fields, *NOT_YET)
        ],
        forbid_unknown_fields=True,
    )
)
"""Finds the values' extents; it neither builds Python objects for them nor goes on after the first unknown name."""

_CHUNK = 1 << 17
"""Bytes of points decoded in one go: some 3 ms and a few MB, whatever the size of the cloud."""


def _points_of_json(text: memoryview, max_points: int) -> Points:
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
            raise TooLarge(f"The cloud has more than {max_points} points, which is the limit; crop or downsample it.")
        parts.append(_as_float32(triples))
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
_NOT_UTF8 = "The JSON is not UTF-8; encode it so."


def _json_error(body: bytearray, error: Exception) -> ServiceError:
    """The problem with a body that is not the JSON wanted."""
    message = str(error)
    if isinstance(error, RecursionError):
        return Undecodable("The JSON is nested too deeply; a point cloud is an array of arrays of numbers.")
    if isinstance(error, UnicodeDecodeError):
        return Undecodable(_NOT_UTF8)
    if isinstance(error, msgspec.ValidationError):
        if not _is_json(bytes(body)):
            return Undecodable("The body is not valid JSON; it was cut off or damaged.")
        unknown = re.match(r"Object contains unknown field `(.*)`", message, re.DOTALL)
        if unknown:
            return _unknown_option(unknown[1])
        return Invalid("body", f'is not a JSON object ({shortened(message)}); send {{"points": [[x, y, z], ...]}}')
    position = re.search(r"\(byte (\d+)\)", message)
    if position and re.match(
        rb"-?(NaN|Infinity|nan|inf)", bytes(body[max(0, int(position[1]) - 1) : int(position[1]) + 9]).lstrip(b" ,[:-")
    ):
        return Invalid(
            "points", f"hold NaN or an infinity (at byte {position[1]}), which JSON does not know; remove such points"
        )
    return Undecodable(f"The JSON cannot be read: {shortened(message)}.")


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
