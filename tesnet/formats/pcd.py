"""PCD (Point Cloud Library): ascii, binary and binary_compressed -> points. The last needs the package `lzf`."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import UnreadableFile
from tesnet.formats.header import Content, check_bytes, check_count, header_lines, whole_number
from tesnet.formats.text import read_rows

MAX_EXPANDED_BYTES = 64
"""Bytes a point to which a compressed file may expand; x, y, z and a colour take 16."""

_MAX_EXPANSION = 100
"""LZF makes at most 264 bytes of 3."""

_MAX_ROW_BYTES = 1 << 20
"""Far beyond any sensor's row, and what numpy's rows may have."""

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


@dataclass(frozen=True, slots=True)
class _Header:
    """Where everything is: the number of points, each field's name, type, elements and offset in a row, in bytes."""

    points: int
    names: tuple[str, ...]
    formats: tuple[str, ...]
    counts: tuple[int, ...]
    data: str

    @property
    def sizes(self) -> list[int]:
        return [int(kind[2:]) * count for kind, count in zip(self.formats, self.counts, strict=True)]

    @property
    def row_bytes(self) -> int:
        return sum(self.sizes)


def is_pcd(content: Content) -> bool:
    """Whether this begins like a PCD file."""
    return bytes(content[:64]).lstrip().startswith((b"# .PCD", b"VERSION", b"FIELDS"))


def seen(points: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask (R,) of the rows (R, 3) of a PCD file that are points.

    An organised cloud has a row for every pixel, and NaN in all three coordinates where there was no depth.
    """
    return np.asarray(~np.isnan(points).all(axis=1))


def read_pcd(content: Content, max_points: int | None = None) -> NDArray[Any]:
    """Rows (R, 3) in numbers of the file's own type; text gives float64. See `seen` for rows without a point.

    Raises:
        UnreadableFile: another format, cut off, damaged, or without fields x, y and z.
        TooManyPoints: more rows than `max_points`.
        ModuleNotFoundError: the file is compressed and `lzf` is not installed.
    """
    lines, start = header_lines(content, "DATA", "PCD")
    header = _parse(lines)
    check_count(header.points, max_points)
    columns = [_field(header, axis) for axis in "xyz"]
    if header.points == 0:
        return np.empty((0, 3))
    if header.data == "ascii":
        before = [sum(header.counts[:column]) for column in columns]
        return read_rows(content, start, 0, header.points, before, "PCD")
    if header.data == "binary":
        return _binary_points(content, start, header, columns)
    return _columns_of(_expanded(content, start, header, max_points), header, columns)


def _parse(lines: list[list[str]]) -> _Header:
    given: dict[str, list[str]] = {words[0]: words[1:] for words in lines if not words[0].startswith("#")}
    names = tuple(_words(given, "FIELDS"))
    sizes = [whole_number(word, "SIZE of a field in the PCD header") for word in _words(given, "SIZE")]
    kinds = _words(given, "TYPE")
    counts = [
        whole_number(word, "COUNT of a field in the PCD header") for word in given.get("COUNT") or ["1"] * len(names)
    ]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise UnreadableFile("The PCD header's FIELDS, SIZE, TYPE and COUNT differ in length; save the file again.")
    for kind, size in zip(kinds, sizes, strict=True):
        if size not in _SIZES.get(kind, ()):
            raise UnreadableFile(
                f"The PCD header has a field of TYPE {kind[:10]!a} and SIZE {size}, which is no number."
            )
    if "POINTS" in given:
        points = whole_number(" ".join(given["POINTS"]), "number of POINTS in the PCD header")
    else:
        width, height = (
            whole_number(" ".join(_words(given, name)), f"{name} of the PCD") for name in ("WIDTH", "HEIGHT")
        )
        points = width * height
    data = " ".join(given["DATA"])
    if data not in ("ascii", "binary", "binary_compressed"):
        raise UnreadableFile(f"The PCD's DATA is {data[:40]!a}; valid: ascii, binary, binary_compressed.")
    formats = tuple(f"<{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True))
    header = _Header(points, names, formats, tuple(counts), data)
    if header.row_bytes > _MAX_ROW_BYTES:
        raise UnreadableFile(
            f"The PCD header gives a point {header.row_bytes} bytes (limit {_MAX_ROW_BYTES}); save x, y and z alone."
        )
    return header


def _words(given: Mapping[str, list[str]], name: str) -> list[str]:
    words = given.get(name)
    if not words:
        raise UnreadableFile(f"The PCD header has no line {name}; the file was cut off or damaged.")
    return words


def _field(header: _Header, axis: str) -> int:
    if axis not in header.names:
        raise UnreadableFile(f"The PCD has no field {axis}; save x, y, z.")
    column = header.names.index(axis)
    if header.counts[column] != 1:
        raise UnreadableFile(f"The PCD's field {axis} has COUNT {header.counts[column]}; save one number a point.")
    return column


def _binary_points(content: Content, start: int, header: _Header, columns: list[int]) -> NDArray[Any]:
    check_bytes(header.points * header.row_bytes, len(content) - start, "PCD")
    dtype = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [header.formats[column] for column in columns],
            "offsets": [sum(header.sizes[:column]) for column in columns],
            "itemsize": header.row_bytes,
        }
    )
    table = np.frombuffer(content, dtype, header.points, start)
    return np.stack([table[axis] for axis in "xyz"], axis=1)


def _expanded(content: Content, start: int, header: _Header, max_points: int | None) -> bytes:
    """The data of a compressed file: two sizes of four bytes each, then LZF."""
    check_bytes(8, len(content) - start, "PCD")
    packed, size = (int.from_bytes(content[at : at + 4], "little") for at in (start, start + 4))
    check_bytes(8 + packed, len(content) - start, "PCD")
    wanted = header.points * header.row_bytes
    if size != wanted or size > _MAX_EXPANSION * packed:
        raise UnreadableFile(
            f"The PCD's {packed} compressed bytes claim to become {size}, its header says {wanted}; it was damaged."
        )
    if max_points is not None and size > MAX_EXPANDED_BYTES * max_points:
        raise UnreadableFile(
            f"The PCD expands to {size} bytes (limit {MAX_EXPANDED_BYTES * max_points}); save x, y and z alone."
        )
    lzf = importlib.import_module("lzf")
    try:
        data = lzf.decompress(bytes(content[start + 8 : start + 8 + packed]), size)
    except ValueError as error:
        raise UnreadableFile("The PCD's compressed data cannot be expanded; it was damaged.") from error
    if data is None or len(data) != size:
        raise UnreadableFile(f"The PCD's compressed data does not become {size} bytes; it was damaged.")
    return bytes(data)


def _columns_of(data: bytes, header: _Header, columns: list[int]) -> NDArray[Any]:
    """Points (N, 3) of expanded data, where each field of all points stands together."""
    starts = [header.points * sum(header.sizes[:column]) for column in columns]
    return np.stack(
        [
            np.frombuffer(data, header.formats[column], header.points, start)
            for column, start in zip(columns, starts, strict=True)
        ],
        axis=1,
    )
