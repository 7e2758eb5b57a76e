"""PLY (Stanford polygon files): ascii and binary of either byte order -> the points of their element `vertex`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import UnreadableFile
from tesnet.formats.header import Content, check_bytes, check_count, header_lines, whole_number
from tesnet.formats.text import read_rows

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


@dataclass(slots=True)
class _Element:
    """A table of the file: its name, its rows, and its columns in order; a list has the type None."""

    name: str
    count: int
    properties: list[tuple[str, str | None]] = field(default_factory=list)


def is_ply(content: Content) -> bool:
    """Whether this begins like a PLY file."""
    return bytes(content[:4]) in (b"ply\n", b"ply\r")


def read_ply(content: Content, max_points: int | None = None) -> NDArray[Any]:
    """Points (N, 3) in numbers of the file's own type; text gives float64.

    Raises:
        UnreadableFile: another format, cut off, damaged, or without x, y and z in an element `vertex`.
        TooManyPoints: more than `max_points`.
    """
    if not is_ply(content):
        raise UnreadableFile("The file does not begin with the line `ply`; send a PLY file.")
    lines, start = header_lines(content, "end_header", "PLY")
    byte_order, elements = _layout(lines)
    before: list[_Element] = []
    for element in elements:
        if element.name == "vertex":
            check_count(element.count, max_points)
            names = [name for name, _ in element.properties]
            missing = [axis for axis in "xyz" if axis not in names]
            if missing:
                raise UnreadableFile(f"The PLY's element `vertex` has no property {', '.join(missing)}; save x, y, z.")
            if byte_order == "":
                return _text_points(content, start, before, element)
            return _binary_points(content, start, before, element, byte_order)
        before.append(element)
    raise UnreadableFile("The PLY has no element `vertex`, which would hold the points.")


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
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, None))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case ["ply"] | ["end_header"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UnreadableFile(f"The PLY header has a line {' '.join(words)[:40]!a}, which means nothing there.")
    if byte_order is None:
        raise UnreadableFile(f"The PLY header has no line `format`; valid: {', '.join(_BYTE_ORDERS)}.")
    return byte_order, elements


def _text_points(content: Content, start: int, before: list[_Element], vertex: _Element) -> NDArray[Any]:
    columns = [_column(vertex, axis) for axis in "xyz"]
    skip = sum(element.count for element in before)
    return read_rows(content, start, skip, vertex.count, columns, "PLY")


def _binary_points(
    content: Content, start: int, before: list[_Element], vertex: _Element, byte_order: str
) -> NDArray[Any]:
    for element in before:
        start += element.count * _row_bytes(element)
    row_bytes = _row_bytes(vertex)
    check_bytes(start + vertex.count * row_bytes, len(content), "PLY")
    columns = [_column(vertex, axis) for axis in "xyz"]
    kinds = [kind or "" for _, kind in vertex.properties]
    dtype = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [byte_order + kinds[column] for column in columns],
            "offsets": [sum(int(kind[1:]) for kind in kinds[:column]) for column in columns],
            "itemsize": row_bytes,
        }
    )
    table = np.frombuffer(content, dtype, vertex.count, start) if vertex.count else np.empty(0, dtype)
    return np.stack([table[axis] for axis in "xyz"], axis=1)


def _column(element: _Element, name: str) -> int:
    """Where a property stands in a row; lists before it would move it from row to row."""
    names = [given for given, _ in element.properties]
    column = names.index(name)
    if any(kind is None for _, kind in element.properties[: column + 1]):
        raise UnreadableFile(f"The PLY's property {name} is a list or stands behind one; save x, y, z first.")
    return column


def _row_bytes(element: _Element) -> int:
    size = 0
    for name, kind in element.properties:
        if kind is None:
            raise UnreadableFile(
                f"The PLY's element {element.name[:40]!a} has a list {name[:40]!a}, so its rows differ in length; "
                "save the points alone, or before everything else."
            )
        size += int(kind[1:])
    return size
