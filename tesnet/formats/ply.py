"""PLY (Stanford polygon files): text and binary of either byte order, read by elements as the format defines them.

An element is a table whose rows may hold lists, so that they differ in length. Elements stand in any order, and in text
a row may stand on any number of lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import UnreadableFile
from tesnet.formats.cloud_file import CloudFile, given_normals, given_viewpoint
from tesnet.formats.header import (
    Content,
    beginning,
    check_bytes,
    check_count,
    header_lines,
    unmarked,
    whole_number,
)
from tesnet.formats.text import TextNumbers, read_rows

_TYPES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("char", "int8"), "i1"),
        **dict.fromkeys(("uchar", "uint8"), "u1"),
        **dict.fromkeys(("short", "int16"), "i2"),
        **dict.fromkeys(("ushort", "uint16"), "u2"),
        **dict.fromkeys(("int", "int32"), "i4"),
        **dict.fromkeys(("uint", "uint32"), "u4"),
        **dict.fromkeys(("float", "float32"), "f4"),
        **dict.fromkeys(("double", "float64"), "f8"),
    }
)
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POINT, _NORMAL, _CAMERA = ("x", "y", "z"), ("nx", "ny", "nz"), ("view_px", "view_py", "view_pz")

_BATCH = 1 << 14
"""Rows read in one go."""

MAX_LENGTH_CHANGES = 100_000
"""How often the rows of an element may change their length: each time costs some 10 us."""


@dataclass(frozen=True, slots=True)
class _Property:
    """A column: its name, the type of its numbers and, for a list, the type of its length."""

    name: str
    kind: str
    length_kind: str | None = None


@dataclass(slots=True)
class _Element:
    """A table of the file: its name, its number of rows, and its columns in order."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def has(self, names: Sequence[str]) -> bool:
        """Whether each of these is a column of single numbers."""
        return set(names) <= {column.name for column in self.properties if column.length_kind is None}

    @property
    def has_lists(self) -> bool:
        return any(column.length_kind is not None for column in self.properties)


class _Numbers(Protocol):
    """The data of a file from some place on; sizes are in units of its own: bytes, or numbers of text."""

    def size(self, kind: str, /) -> int: ...

    def ahead(self, wanted: int, /) -> int: ...

    def column(self, kind: str, offset: int, stride: int, rows: int, /) -> NDArray[Any]: ...

    def advance(self, size: int, /) -> None: ...


@dataclass(frozen=True, slots=True)
class _Row:
    """Where the columns of a row begin, its size, and its lists: type of the length, where that stands, its value."""

    offsets: Mapping[str, int]
    size: int
    lists: tuple[tuple[str, int, int], ...]


def is_ply(content: Content) -> bool:
    """Whether this begins like a PLY file."""
    start = beginning(content, 256)
    return start[:3] == b"ply" and start[3:4] in (b"\n", b"\r", b" ", b"\t")


def read_ply(content: Content, max_points: int | None = None) -> CloudFile:
    """Points in numbers of the file's own type (text gives float64), normals, and the viewpoint that PCL writes.

    Raises:
        UnreadableFile: another format, cut off, damaged, or without x, y and z in an element `vertex`.
        TooManyPoints: more than `max_points`.
    """
    if not is_ply(content):
        raise UnreadableFile("The file does not begin with the line `ply`; send a PLY file.")
    content = unmarked(content)
    lines, start = header_lines(content, "end_header", "PLY")
    byte_order, elements = _layout(lines)
    vertex = _vertex(elements)
    check_count(vertex.count, max_points)
    names = [*_POINT, *(_NORMAL if vertex.has(_NORMAL) else ())]
    if byte_order == "" and _has_further_columns(content, start, elements, vertex):
        columns = [[column.name for column in vertex.properties].index(name) for name in names]
        skipped = sum(element.count for element in elements[: elements.index(vertex)])
        return _cloud(read_rows(content, start, skipped, vertex.count, columns, "PLY"), None)
    numbers = TextNumbers(content, start, "PLY") if byte_order == "" else _BinaryNumbers(content, start, byte_order)
    least = sum(_least_size(element, numbers) * element.count for element in elements[: elements.index(vertex) + 1])
    check_bytes(2 * least - 1 if byte_order == "" else least, len(content) - start, "PLY")
    return _read_elements(numbers, elements, vertex, names)


def _read_elements(
    numbers: _Numbers, elements: Sequence[_Element], vertex: _Element, names: Sequence[str]
) -> CloudFile:
    """The wanted columns of `vertex`, and the viewpoint of a camera where there is one."""
    table: NDArray[Any] | None = None
    camera = next((element for element in elements if element.name == "camera" and element.has(_CAMERA)), None)
    viewpoint = None
    last = max(elements.index(element) for element in (vertex, camera) if element is not None)
    for element in elements[: last + 1]:
        if element is vertex:
            table = _columns(numbers, element, names)
        elif element is camera:
            rows = _columns(numbers, element, _CAMERA)
            viewpoint = given_viewpoint(rows[0]) if len(rows) == 1 else None
        else:
            _columns(numbers, element, ())
    assert table is not None
    return _cloud(table, viewpoint)


def _cloud(table: NDArray[Any], viewpoint: NDArray[np.float64] | None) -> CloudFile:
    return CloudFile(table[:, :3], given_normals(table[:, 3:]) if table.shape[1] > 3 else None, viewpoint)


# -------------------------------------------------------------------------------------------------------------- header


def _layout(lines: list[list[str]]) -> tuple[str, list[_Element]]:
    """Byte order (empty for text) and the elements of a header."""
    byte_order: str | None = None
    elements: list[_Element] = []
    for words in lines:
        match words:
            case ["format", name, _] if name in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[name]
            case ["element", name, count]:
                elements.append(_Element(name, whole_number(count, "number of rows of an element in the PLY header")))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _TYPES.keys():
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["ply"] | ["end_header"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UnreadableFile(f"The PLY header has a line {' '.join(words)[:40]!a}, which means nothing there.")
    if byte_order is None:
        raise UnreadableFile(f"The PLY header has no line `format`; valid: {', '.join(_BYTE_ORDERS)}.")
    return byte_order, elements


def _vertex(elements: Sequence[_Element]) -> _Element:
    """The element that holds the points."""
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise UnreadableFile("The PLY has no element `vertex`, which would hold the points.")
    missing = [axis for axis in _POINT if not vertex.has([axis])]
    if missing:
        raise UnreadableFile(
            f"The PLY's element `vertex` has no property {', '.join(missing)} of a number, not a list; save x, y, z."
        )
    return vertex


def _has_further_columns(content: Content, start: int, elements: Sequence[_Element], vertex: _Element) -> bool:
    """Whether lines of text hold more numbers than the header says, one row a line: then lines tell the rows apart."""
    before = elements[: elements.index(vertex)]
    if before or vertex.has_lists:
        return False
    lines = bytes(memoryview(content)[start : start + (1 << 16)]).splitlines()
    first: list[bytes] = next(filter(None, (line.split() for line in lines)), [])
    if len(first) <= len(vertex.properties):
        return False
    text = bytes(memoryview(content)[start:])
    return max(text.count(b"\n"), text.count(b"\r")) + 1 >= vertex.count


# ---------------------------------------------------------------------------------------------------------------- rows


class _BinaryNumbers:
    """The numbers of binary data from a byte on, where they lie."""

    def __init__(self, content: Content, start: int, byte_order: str) -> None:
        self._content = content
        self._at = start
        self._byte_order = byte_order

    @staticmethod
    def size(kind: str) -> int:
        """Bytes of a number."""
        return int(kind[1:])

    def ahead(self, _: int) -> int:
        """How many bytes are left."""
        return len(self._content) - self._at

    def column(self, kind: str, offset: int, stride: int, rows: int) -> NDArray[Any]:
        """(rows,) numbers, `stride` bytes from each other, the first of them `offset` bytes from here."""
        dtype = np.dtype(self._byte_order + kind)
        return np.ndarray((rows,), dtype, self._content, self._at + offset, (stride,))

    def advance(self, size: int) -> None:
        """Pass over bytes."""
        self._at += size


def _columns(numbers: _Numbers, element: _Element, names: Sequence[str]) -> NDArray[Any]:
    """The wanted columns (count, len(names)) of an element, past which this reads.

    Rows as long as the first of those ahead are taken together.
    """
    kinds = {column.name: column.kind for column in element.properties}
    parts: list[NDArray[Any]] = []
    done, window, changes = 0, 1, 0
    while done < element.count and element.properties:
        row = _next_row(numbers, element, done)
        window = min(window, element.count - done)
        rows = _alike(numbers, row, window)
        if names:
            columns = [numbers.column(kinds[name], row.offsets[name], row.size, rows) for name in names]
            parts.append(np.stack(columns, axis=1))
        numbers.advance(rows * row.size)
        done += rows
        changes += rows < window
        if changes > MAX_LENGTH_CHANGES:
            raise UnreadableFile(
                f"The PLY's element {element.name[:40]!a} has lists whose length changes over {MAX_LENGTH_CHANGES} "
                "times; save the points alone, or before everything else."
            )
        window = min(2 * window, _BATCH) if rows == window else 2 * rows
    return np.concatenate(parts) if parts else np.empty((0, len(names)))


def _next_row(numbers: _Numbers, element: _Element, done: int) -> _Row:
    """The layout of the row that is ahead."""
    offsets: dict[str, int] = {}
    lists: list[tuple[str, int, int]] = []
    at = 0

    def need(size: int) -> None:
        if numbers.ahead(size) < size:
            raise UnreadableFile(
                f"The PLY's data ends behind {done} rows of the element {element.name[:40]!a}, its header says "
                f"{element.count}; it was cut off or damaged."
            )

    for column in element.properties:
        offsets[column.name] = at
        size = numbers.size(column.kind)
        if column.length_kind is not None:
            need(at + numbers.size(column.length_kind))
            length = float(numbers.column(column.length_kind, at, 0, 1)[0])
            if not (length >= 0 and length.is_integer()):
                raise UnreadableFile(f"The PLY has a list of {length:g} numbers; it was damaged.")
            lists.append((column.length_kind, at, int(length)))
            at += numbers.size(column.length_kind)
            size *= int(length)
        at += size
    need(at)
    return _Row(offsets, at, tuple(lists))


def _alike(numbers: _Numbers, row: _Row, most: int) -> int:
    """How many rows ahead, up to `most`, are of this layout: as whole as it, with lists of the same lengths."""
    rows = min(most, numbers.ahead(row.size * most) // row.size)
    for kind, offset, length in row.lists:
        same = numbers.column(kind, offset, row.size, rows) == length
        if not same.all():
            rows = int(same.argmin())
    return rows


def _least_size(element: _Element, numbers: _Numbers) -> int:
    """Of a row whose lists are empty."""
    return sum(numbers.size(column.length_kind or column.kind) for column in element.properties)
