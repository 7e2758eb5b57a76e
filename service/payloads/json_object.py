"""JSON objects -> the text of each member, without building what it says. Knows no options and no points.

A parser that goes over a body of 60 MB in one call keeps the interpreter's lock for as long, so everything here goes in
steps of a few milliseconds, and nothing large is copied. What a member's text says is the business of who decodes it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import msgspec

from service.errors import Invalid, ServiceError, Undecodable, shortened

MAX_MARKS = 1 << 17
"""Names, strings and braces of one member: many more than all options together may have."""

CHUNK = 1 << 17
"""Bytes of an array decoded in one go: some 3 ms and a few MB, whatever the size of the array."""

MAX_DEPTH = 1000
"""Brackets and braces in one another, beyond which the decoders do not go either."""

_STEP = 1 << 22
"""Bytes searched in one go, a few milliseconds."""

NOT_UTF8 = "The JSON is not UTF-8; encode it so."

_SPACE = re.compile(rb"[ \t\r\n]*")
_NAME = re.compile(rb'"(?:[^"\\]|\\.){0,400}"', re.DOTALL)
_SCALAR = re.compile(rb'[^ \t\r\n,:"{}\[\]]{1,65536}')
_COMMA = re.compile(rb",(?=[ \t\r\n]*[^ \t\r\n\]])")
_ROW_END = re.compile(rb"\][ \t\r\n]*,(?=[ \t\r\n]*[^ \t\r\n\]])")
"""Where an array may be cut: at a comma that something follows."""
_NO_NUMBER = re.compile(rb"-?(NaN|Infinity|nan|inf)")


@dataclass(frozen=True, slots=True)
class Span:
    """A part of a text, without a copy of it: from byte `start` to before byte `end`."""

    text: bytes | bytearray
    start: int
    end: int

    @classmethod
    def of(cls, text: bytes | bytearray) -> Span:
        """The whole of a text."""
        return cls(text, 0, len(text))

    def __len__(self) -> int:
        return self.end - self.start

    def __bytes__(self) -> bytes:
        return bytes(self.view)

    @property
    def view(self) -> memoryview:
        """The bytes, where they lie."""
        return memoryview(self.text)[self.start : self.end]

    def count(self, byte: bytes) -> int:
        """How often a byte occurs."""
        steps = range(self.start, self.end, _STEP)
        return sum(self.text.count(byte, step, min(step + _STEP, self.end)) for step in steps)


def members(span: Span, what: str, known: Collection[str], unknown: Callable[[str], ServiceError]) -> dict[str, Span]:
    """The text of each member of an object.

    Args:
        span: the object's text.
        what: it is, for messages.
        known: the names that may occur, each once.
        unknown: the problem with another name.

    Raises:
        Undecodable: no JSON, as far as that shows outside of the members.
        Invalid: no object, a name that occurs twice, a member of too many parts.
    """
    text, end = span.text, span.end
    at = _after_space(text, span.start, end)
    if _byte(text, at, end) != b"{":
        stop = _value_end(text, at, end, what)
        if _after_space(text, stop, end) < end or not (_byte(text, at, end) == b"[" or is_json(bytes(text[at:stop]))):
            raise _broken(what, stop, end)
        raise Invalid(what, f"is no JSON object; send one with names among {', '.join(known)}")
    found: dict[str, Span] = {}
    at = _after_space(text, at + 1, end)
    while found or _byte(text, at, end) != b"}":
        name, at = _name(text, at, end, what)
        if name in found:
            raise Invalid(shortened(name), f"is given twice in the {what}; give it once")
        if name not in known:
            raise unknown(name)
        found[name] = Span(text, at, _value_end(text, at, end, what))
        at = _after_space(text, found[name].end, end)
        if _byte(text, at, end) == b"}":
            break
        if _byte(text, at, end) != b",":
            raise _broken(what, at, end)
        at = _after_space(text, at + 1, end)
    if _after_space(text, at + 1, end) < end:
        raise _broken(what, at + 1, end)
    return found


def objects(span: Span, what: str, most: int) -> list[Span]:
    """The texts of the objects that an array holds: 1 to `most` of them.

    Raises:
        Undecodable: no JSON.
        Invalid: an array of something else, or of another number.
    """
    text, end = span.text, span.end
    found: list[Span] = []
    at = _after_space(text, span.start + 1, end)
    while _byte(text, span.start, end) == b"[" and _byte(text, at, end) == b"{" and len(found) < most:
        found.append(Span(text, at, _value_end(text, at, end, what)))
        at = _after_space(text, found[-1].end, end)
        if text[at:end] == b"]":
            return found
        if _byte(text, at, end) == b",":
            at = _after_space(text, at + 1, end)
    check_json(what, bytes(span))
    raise Invalid(what, f"cannot be used: they must be an array of 1 to {most} objects")


def number_chunks(array: Span) -> Iterator[bytes | memoryview]:
    """An array of numbers as several. Text of another form is cut where it means something else, and refused then."""
    return _chunks(array, _COMMA, 0)


def row_chunks(array: Span) -> Iterator[bytes | memoryview]:
    """An array of arrays as several, cut where one of a row ends; as `number_chunks`."""
    return _chunks(array, _ROW_END, 1)


def _chunks(array: Span, cut: re.Pattern[bytes], kept: int) -> Iterator[bytes | memoryview]:
    view, start = memoryview(array.text), array.start
    while found := cut.search(array.text, start + CHUNK, array.end):
        yield (b"[" if start > array.start else b"") + view[start : found.start() + kept] + b"]"
        start = found.end()
    yield b"[" + view[start : array.end] if start > array.start else array.view


def check_json(name: str, text: bytes) -> None:
    """Whether a small member's text is JSON in UTF-8.

    Raises:
        Undecodable: it is not.
        Invalid: it would be but for NaN or an infinity.
    """
    try:
        msgspec.json.decode(text, type=msgspec.Raw)
        text.decode("utf-8")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise undecodable(name, text, error) from None


def undecodable(name: str, text: bytes | memoryview, error: Exception) -> ServiceError:
    """The problem with a member's text, or with a piece of it, that msgspec cannot decode."""
    if isinstance(error, RecursionError):
        return _too_deep(name)
    if isinstance(error, UnicodeDecodeError):
        return Undecodable(NOT_UTF8)
    position = re.search(r"\(byte (\d+)\)", str(error))
    start = max(0, int(position[1]) - 1) if position else 0
    if position and _NO_NUMBER.match(bytes(text[start : start + 12]).lstrip(b" ,[:-")):
        return Invalid(name, "holds NaN or an infinity, which JSON does not know; leave such values out")
    return Undecodable(f"The JSON of `{name}` cannot be read: {shortened(str(error))}.")


def broken_chunk(name: str, array: Span, chunk: bytes | memoryview, error: Exception) -> ServiceError | None:
    """The problem with the text of a chunk that cannot be decoded; None where the array is JSON, of something else."""
    if isinstance(error, msgspec.ValidationError):
        return None
    problem = undecodable(name, chunk, error)
    return problem if isinstance(problem, Invalid) or not is_json(bytes(array)) else None


def is_json(text: bytes) -> bool:
    """Whether this is a JSON document in UTF-8."""
    try:
        check_json("", text)
    except ServiceError:
        return False
    return True


def refuse_twice(text: bytes) -> None:
    """Raise `Invalid` where an object of a small JSON document has a name twice, at any depth."""

    def unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
        given = dict(pairs)
        if len(given) < len(pairs):
            names = [name for name, _ in pairs]
            raise Invalid(
                shortened(next(filter(lambda name: names.count(name) > 1, names))),
                "is given twice in an object; give it once",
            )
        return given

    json.loads(text, object_pairs_hook=unique, parse_int=str, parse_float=str)


def _name(text: bytes | bytearray, at: int, end: int, what: str) -> tuple[str, int]:
    """The name that stands here, and where its value begins."""
    match = _NAME.match(text, at, end)
    if match is None:
        raise _broken(what, at, end)
    try:
        name = msgspec.json.decode(match[0], type=str)
    except UnicodeDecodeError:
        raise Undecodable(NOT_UTF8) from None
    except msgspec.DecodeError:
        raise _broken(what, at, end) from None
    at = _after_space(text, match.end(), end)
    if _byte(text, at, end) != b":":
        raise _broken(what, at, end)
    return name, _after_space(text, at + 1, end)


def _value_end(text: bytes | bytearray, start: int, end: int, what: str) -> int:
    """Where the value ends that begins here."""
    first = _byte(text, start, end)
    if first == b'"':
        return _string_end(text, start, end, what)
    if first in (b"[", b"{"):
        return _nested_end(text, start, end, what)
    scalar = _SCALAR.match(text, start, end)
    if scalar is None:
        raise _broken(what, start, end)
    return scalar.end()


def _nested_end(text: bytes | bytearray, start: int, end: int, what: str) -> int:
    """Where the array or object ends that begins here.

    Between quotes and braces there is nothing but numbers and brackets, which need only be counted. Whether they are
    of a kind and in order shows when the value is decoded.
    """
    at, depth = start, 0
    next_one = dict.fromkeys(b'"{}', -1)
    for _ in range(MAX_MARKS):
        for mark in next_one:
            if next_one[mark] < at:
                next_one[mark] = found if (found := text.find(mark, at, end)) >= 0 else end
        place = min(next_one.values())
        between = Span(text, at, place)
        depth += between.count(b"[") - between.count(b"]")
        if depth <= 0 and at < place:
            return text.rfind(b"]", at, place) + 1
        if depth > MAX_DEPTH:
            raise _too_deep(what)
        if place == end:
            raise _broken(what, end, end)
        at = place + 1
        if text[place] == ord('"'):
            at = _string_end(text, place, end, what)
        elif text[place] == ord("{"):
            depth += 1
        else:
            depth -= 1
            if depth <= 0:
                return at
    raise Invalid(what, f"has a value of more than {MAX_MARKS} strings and objects; send arrays of numbers")


def _string_end(text: bytes | bytearray, start: int, end: int, what: str) -> int:
    at = start + 1
    for _ in range(MAX_MARKS):
        quote = text.find(b'"', at, end)
        if quote < 0:
            raise _broken(what, end, end)
        escapes = _backslashes(text, at, quote)
        at = quote + 1
        if escapes % 2 == 0:
            return at
    raise Invalid(what, f"has a string of more than {MAX_MARKS} quotes; send arrays of numbers")


def _backslashes(text: bytes | bytearray, start: int, end: int) -> int:
    """How many of them stand right before `end`, none of them before `start`."""
    count, step = 0, 16
    while True:
        part = text[max(start, end - step) : end]
        found = len(part) - len(part.rstrip(b"\\"))
        count += found
        if found < step:
            return count
        end -= step
        step = min(2 * step, _STEP)


def _byte(text: bytes | bytearray, at: int, end: int) -> bytes | bytearray:
    """The byte here; none at the end."""
    return text[at : min(at + 1, end)]


def _after_space(text: bytes | bytearray, at: int, end: int) -> int:
    """Where something else than white space stands, from here on."""
    while at < end and (space := _SPACE.match(text, at, min(at + _STEP, end))) and space.end() > at:
        at = space.end()
    return at


def _too_deep(what: str) -> Undecodable:
    return Undecodable(f"The JSON of the {what} is nested too deeply; a point cloud is an array of arrays of numbers.")


def _broken(what: str, at: int, end: int) -> Undecodable:
    how = f"there is something unexpected at byte {at}" if at < end else "it was truncated, or never closed"
    return Undecodable(f"The JSON of the {what} cannot be read: {how}.")
