"""PCD (Point Cloud Library): ascii, binary and binary_compressed -> points. The last needs the package `lzf`."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
from tesnet.formats.text import read_rows

MAX_EXPANDED_BYTES = 64
"""Bytes a row to which a compressed file may expand; x, y, z and a colour take 16."""

_MAX_EXPANSION = 100
"""LZF makes at most 264 bytes of 3."""

_MAX_ROW_BYTES = 1 << 20
"""Far beyond any sensor's row, and what numpy's rows may have."""

_POINT, _NORMAL = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


@dataclass(frozen=True, slots=True)
class _Header:
    """Where everything is: the number of points, each field's name, type and elements; where the camera stood."""

    points: int
    names: tuple[str, ...]
    formats: tuple[str, ...]
    counts: tuple[int, ...]
    data: str
    viewpoint: NDArray[np.float64] | None

    @property
    def sizes(self) -> list[int]:
        return [int(kind[2:]) * count for kind, count in zip(self.formats, self.counts, strict=True)]

    @property
    def row_bytes(self) -> int:
        return sum(self.sizes)


def is_pcd(content: Content) -> bool:
    """Whether this begins like a PCD file, comments or not."""
    for line in beginning(content).splitlines():
        if line.startswith(b"# .PCD") or line.split()[:1] in ([b"VERSION"], [b"FIELDS"]):
            return True
        if line.strip() and not line.startswith(b"#"):
            break
    return False


def read_pcd(content: Content, max_points: int | None = None) -> CloudFile:
    """Rows in numbers of the file's own type (text gives float64), normals, and where `VIEWPOINT` puts the camera.

    Raises:
        UnreadableFile: another format, cut off, damaged, or without fields x, y and z.
        TooManyPoints: more rows than `max_points`.
        ModuleNotFoundError: the file is compressed and `lzf` is not installed.
    """
    content = unmarked(content)
    lines, start = header_lines(content, "DATA", "PCD")
    header = _parse(lines)
    check_count(header.points, max_points)
    names = [*_POINT, *(_NORMAL if set(_NORMAL) <= set(header.names) else ())]
    columns = [_field(header, name) for name in names]
    if header.points == 0:
        return CloudFile(np.empty((0, 3)))
    if header.data == "ascii":
        before = [sum(header.counts[:column]) for column in columns]
        table = read_rows(content, start, 0, header.points, before, "PCD")
    elif header.data == "binary":
        table = _binary_table(content, start, header, columns)
    else:
        table = _columns_of(_expanded(content, start, header, max_points), header, columns)
    normals = given_normals(table[:, 3:]) if len(names) > len(_POINT) else None
    return CloudFile(table[:, :3], normals, header.viewpoint)


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
    header = _Header(points, names, formats, tuple(counts), data, _viewpoint(given.get("VIEWPOINT", [])))
    if header.row_bytes > _MAX_ROW_BYTES:
        raise UnreadableFile(
            f"The PCD header gives a point {header.row_bytes} bytes (limit {_MAX_ROW_BYTES}); save x, y and z alone."
        )
    return header


def _viewpoint(words: Sequence[str]) -> NDArray[np.float64] | None:
    """The position that a line VIEWPOINT begins with; its quaternion is of no use here.

    Raises:
        UnreadableFile: something else than numbers.
    """
    if not words:
        return None
    try:
        position = np.array([float(word) for word in words[:3]])
    except ValueError:
        position = np.empty(0)
    if len(position) < 3:
        raise UnreadableFile(f"The PCD's VIEWPOINT is {' '.join(words)[:40]!a}; it must begin with x, y, z.")
    return given_viewpoint(position)


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


def _binary_table(content: Content, start: int, header: _Header, columns: list[int]) -> NDArray[Any]:
    """The wanted fields (R, len(columns)) of binary data, where the fields of a point stand together."""
    check_bytes(header.points * header.row_bytes, len(content) - start, "PCD")
    return np.stack(
        [
            np.ndarray(
                (header.points,),
                header.formats[column],
                content,
                start + sum(header.sizes[:column]),
                (header.row_bytes,),
            )
            for column in columns
        ],
        axis=1,
    )


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
    """The wanted fields (R, len(columns)) of expanded data, where each field of all points stands together."""
    starts = [header.points * sum(header.sizes[:column]) for column in columns]
    return np.stack(
        [
            np.frombuffer(data, header.formats[column], header.points, start)
            for column, start in zip(columns, starts, strict=True)
        ],
        axis=1,
    )
