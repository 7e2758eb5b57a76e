"""Options, from the text of query strings, JSON bodies and forms to checked values."""

from __future__ import annotations

import array
import difflib
import re
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import unquote_to_bytes

import msgspec
from pydantic import BaseModel, ValidationError

from service.errors import Invalid, shortened
from service.payloads.json_object import Span, broken_chunk, check_json, is_json, members, number_chunks, refuse_twice
from service.payloads.payload import RawOptions
from service.schemas import DepthCamera, GraspOptions, Target

if TYPE_CHECKING:
    from collections.abc import Mapping

Model = TypeVar("Model", bound=BaseModel)

BESIDE_POINTS = ("view_index", "normals")
"""What comes with the points, one entry for each, and is no option."""

MAX_OPTIONS_BYTES = 65_536
"""JSON text of all options together, but for a target's indices."""

_LONG_TARGET = 1 << 13
"""Bytes of a target that pydantic decodes in one go: a few milliseconds."""


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
        options[name] = json_text(name, unquote_to_bytes(raw_value))
    return options


def merged(first: RawOptions, second: RawOptions) -> RawOptions:
    """Options of query string and body together.

    Raises:
        Invalid: one given in both.
    """
    for name in first.keys() & second.keys():
        raise Invalid(name, "is given in the query string and in the body, or twice there; give it once")
    return {**first, **second}


def parse_options(raw: RawOptions, max_indices: int | None = None) -> GraspOptions:
    """Checked options. A null counts as not given.

    Args:
        raw: their JSON text.
        max_indices: how many indices a target may have; None: as many as fit into the bytes that all options may have.

    Raises:
        Invalid: an unknown name, a value of the wrong type or out of range; the message says what is expected.
    """
    for name in raw:
        if name not in GraspOptions.model_fields:
            raise unknown_option(name)
    if max_indices is None or not _is_long_target("target", raw.get("target", b"")):
        return checked(GraspOptions, raw)
    options = checked(GraspOptions, {name: value for name, value in raw.items() if name != "target"})
    return options.model_copy(update={"target": _many_indices(raw["target"], max_indices)})


def checked(model: type[Model], raw: RawOptions) -> Model:
    """A model of options from their JSON text, whose names it is known to have. A null counts as not given.

    Raises:
        Invalid: names the option and says what is expected.
    """
    given = {name: value for name, value in raw.items() if value != b"null"}
    size = sum(map(len, given.values()))
    if size > MAX_OPTIONS_BYTES:
        largest = max(given, key=lambda name: len(given[name]))
        raise Invalid(largest, f"is too long: the options have {size} bytes (limit {MAX_OPTIONS_BYTES}); shorten them")
    text = b"{" + b",".join(b'"%b":%b' % (name.encode(), value) for name, value in given.items()) + b"}"
    try:
        options = model.model_validate_json(text)
    except ValidationError as error:
        raise _invalid_option(model, error, given) from None
    refuse_twice(text)
    return options


def option_texts(values: Mapping[str, Span], max_indices: int) -> dict[str, bytes]:
    """The options' JSON text.

    Raises:
        Undecodable: no JSON.
        Invalid: too long; NaN or an infinity.
    """
    texts = {}
    for name, value in values.items():
        check_length(name, value, max_indices)
        texts[name] = bytes(value)
        if not _is_long_target(name, texts[name]):
            check_json(name, texts[name])
    return texts


def check_length(name: str, value: Span, max_indices: int) -> None:
    """Raise `Invalid` for an option that is too long, before it is copied. A target's indices may be many."""
    if name == "target":
        _check_indices(value.count(b","), max_indices)
    elif len(value) > MAX_OPTIONS_BYTES:
        raise Invalid(name, f"is too long: it has {len(value)} bytes (limit {MAX_OPTIONS_BYTES}); shorten it")


def json_text(name: str, value: bytes) -> bytes:
    """A value of a URL or of a form as JSON text: it is JSON, or a plain word.

    Raises:
        Invalid: neither.
    """
    if _is_long_target(name, value) or is_json(value):
        return value.strip()
    if re.fullmatch(rb"[A-Za-z][\w.-]*", value):
        return b'"%b"' % value
    text = shortened(value[:400].decode("utf-8", "replace")) or "empty"
    raise Invalid(
        shortened(name), f"is {text}, neither JSON nor a plain word; URL-encode JSON, for example [0.3,0,0.6]"
    )


def unknown_option(name: str) -> Invalid:
    """The problem with a name that no option has."""
    if name in DepthCamera.model_fields:
        return Invalid(
            name, "belongs to a depth image: send a form with a file `depth`, and this in its part `options`"
        )
    if name in BESIDE_POINTS:
        return Invalid(name, "belongs beside the points: in a JSON body with `points`, or in a form as a .npy file")
    known = list(GraspOptions.model_fields)
    close = difflib.get_close_matches(name[:64], known, 1)
    hint = f"did you mean {close[0]}? " if close else ""
    return Invalid(shortened(name), f"is no option; {hint}valid: {', '.join(known)}")


_UNIONS = frozenset({"viewpoint", "up", "support_height"})
"""Options of several types, whose names pydantic puts into an error's location."""

_TYPES = frozenset({"GripperSize", "constrained-str"})
"""Names of types of an option that has parts, too."""


def _invalid_option(model: type[BaseModel], error: ValidationError, given: RawOptions) -> Invalid:
    first = error.errors(include_url=False, include_input=False)[0]
    if not first["loc"]:
        return Invalid(next(iter(given)), f"or another option cannot be read: {shortened(first['msg'])}")
    name, *inside = first["loc"]
    field = str(name)
    path = [str(part) for part in inside if field not in _UNIONS and part not in _TYPES]
    where = f" (at {'.'.join(path)})" if path else ""
    what = first["msg"][:1].lower() + first["msg"][1:]
    expected = model.model_fields[field].description
    if first["type"] == "extra_forbidden":
        what = "there is no such name"
    if field not in given:
        return Invalid(field, f"is missing. Expected: {expected}")
    value = shortened(given[field][:400].decode("utf-8", "replace"))
    return Invalid(field, f"is {value}: {what}{where}. Expected: {expected}")


# ------------------------------------------------------------------------------------------------- a target of indices

_INDICES = msgspec.json.Decoder(list[int])


def _many_indices(text: bytes, max_indices: int) -> Target | None:
    """A target that has so many indices that pydantic would keep the interpreter's lock for long.

    Raises:
        Undecodable: no JSON.
        Invalid: no list of whole numbers from 0 on, or more than the limit.
    """
    values = members(Span.of(text), "target", Target.model_fields, _no_part_of_target)
    written = values.get("indices")
    if len(values) > 1 or written is None or text[written.start : written.start + 1] != b"[":
        check_json("target", text)
        return checked(GraspOptions, {"target": text}).target
    indices = array.array("q")
    try:
        for chunk in number_chunks(written):
            numbers = _INDICES.decode(chunk)
            indices.extend(numbers)
            if min(numbers, default=0) < 0:
                raise Invalid("target", "has a negative index; count the posted points from 0")
            _check_indices(len(indices), max_indices)
    except (msgspec.DecodeError, OverflowError, RecursionError) as error:
        raise broken_chunk("target", written, chunk, error) or Invalid(
            "target", f"has something else than whole numbers after {len(indices)} indices; give numbers of points"
        ) from None
    return Target.model_construct(box=None, label=None, indices=indices)


def _is_long_target(name: str, text: bytes) -> bool:
    """Whether `_many_indices` is to look at this, piece by piece."""
    return name == "target" and len(text) > _LONG_TARGET


def _check_indices(count: int, max_indices: int) -> None:
    if count > max_indices:
        raise Invalid("target", f"has more than {max_indices} indices, which is the limit of points; send fewer")


def _no_part_of_target(name: str) -> Invalid:
    expected = GraspOptions.model_fields["target"].description
    return Invalid("target", f"has a name {shortened(name)}, which there is not. Expected: {expected}")
