"""Numbers in text, block by block: a whole file of lines as Python strings would take many times its size."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import UnreadableFile
from tesnet.formats.cloud_file import CloudFile
from tesnet.formats.header import Content, beginning, check_bytes, check_count, unmarked

_BLOCK = 1 << 17
"""Bytes decoded in one go: a few milliseconds, whatever the size of the file."""

_BLANK = re.compile(rb"\n\s+")
"""Lines without words, and what stands before the first word of a line: millions of them in a file made to be slow."""

_COMMENT = re.compile(rb"(?:#|//)[^\n]*")
_SEPARATORS = bytes.maketrans(b",;\r", b"  \n")
_SPACE = re.compile(rb"\s")
_NUMBER = re.compile(rb"[+-]?(?:nan|inf|\d+\.?\d*(?:e[+-]?\d+)?|\.\d+(?:e[+-]?\d+)?)", re.IGNORECASE)


# ------------------------------------------------------------------------------------------- a format of its own: text


def is_text(content: Content) -> bool:
    """Whether the first line that is no comment begins with three numbers."""
    return _is_point(next(filter(None, _lines(content)), []))


def line_before_points(content: Content) -> tuple[int, str] | None:
    """Number, from 1, and words of the first line, where it is no point but a later one is, as below names of columns.

    None for other content.
    """
    lines = _lines(content)
    first = next((number for number, words in enumerate(lines) if words), len(lines))
    if not any(map(_is_point, lines[first + 1 :])):
        return None
    words = b" ".join(lines[first]).decode("ascii", "replace")
    return (first + 1, words) if words.isprintable() and "\ufffd" not in words else None


def _lines(content: Content) -> list[list[bytes]]:
    """The words of the first lines, of comments none."""
    return [line.split() for line in _plain(beginning(content).replace(b"\r\n", b"\n")).split(b"\n")]


def _is_point(words: list[bytes]) -> bool:
    return len(words) >= 3 and all(map(_NUMBER.fullmatch, words[:3]))


def read_text(content: Content, max_points: int | None = None) -> CloudFile:
    """Points of text, one a line, as the first three columns.

    Columns are separated by spaces, tabs, commas or semicolons; `#` and `//` begin comments, of any encoding.

    Raises:
        UnreadableFile: a line of something else, or no point at all.
        TooManyPoints: more than `max_points`.
    """
    parts: list[NDArray[np.float64]] = []
    count = 0
    for block in _blocks(unmarked(content), 0, "text"):
        lines = [line for line in _plain(block).split(b"\n") if line.strip()]
        if lines:
            parts.append(_table(lines, (0, 1, 2), count, "text"))
            count += len(lines)
            check_count(count, max_points)
    if not parts:
        raise UnreadableFile("The text has no line of numbers; save x, y, z of a point on each line.")
    return CloudFile(np.concatenate(parts))


def _plain(text: bytes) -> bytes:
    """Lines of words that spaces separate, without comments."""
    return _COMMENT.sub(b"", text.translate(_SEPARATORS))


# ------------------------------------------------------------------------------------------------------ lines of others


def read_rows(
    content: Content, start: int, skip: int, count: int, columns: Sequence[int], kind: str
) -> NDArray[np.float64]:
    """The wanted columns (count, len(columns)) of `count` lines of numbers; lines without words are no lines.

    Args:
        content: of the file.
        start: where its lines begin.
        skip: lines before the wanted ones.
        count: how many.
        columns: which of the numbers of a line, from 0.
        kind: of the file, for messages.

    Raises:
        UnreadableFile: fewer lines, a line with fewer numbers or with something else than numbers.
    """
    shortest = 2 * (max(columns) + 1)  # a digit and a separator for each number
    check_bytes(count * shortest - 1, len(content) - start, kind)
    rows = np.empty((count, len(columns)))
    done = 0
    for block in _blocks(content, start, kind):
        lines = [line for line in block.replace(b"\r", b"\n").split(b"\n") if line.strip()]
        dropped = min(skip, len(lines))
        skip -= dropped
        wanted = lines[dropped : dropped + count - done]
        if wanted:
            rows[done : done + len(wanted)] = _table(wanted, columns, done, kind)
            done += len(wanted)
        if done == count:
            break
    if done < count:
        raise UnreadableFile(f"The {kind} has {done} rows, its header says {count}; it was cut off or damaged.")
    return rows


def _blocks(content: Content, start: int, kind: str, ends: bytes = b"\r\n") -> Iterator[bytes]:
    """The text from `start` on, cut behind one of the bytes `ends`."""
    view = memoryview(content)
    while start < len(view):
        block = bytes(view[start : start + _BLOCK])
        if start + len(block) < len(view):
            end = 1 + max(block.rfind(ends[at : at + 1]) for at in range(len(ends)))
            if end == 0:
                raise UnreadableFile(f"The {kind} has a line of over {_BLOCK} bytes; it was damaged.")
            block = block[:end]
        start += len(block)
        yield _BLANK.sub(b"\n", block)


def _table(lines: list[bytes], columns: Sequence[int], first: int, kind: str) -> NDArray[np.float64]:
    try:
        text = [line.decode("ascii") for line in lines]
        return np.loadtxt(text, dtype=np.float64, comments=None, usecols=tuple(columns), ndmin=2)
    except ValueError:  # numpy's message would repeat the cloud
        raise UnreadableFile(
            f"The {kind} has something else than {max(columns) + 1} or more numbers in a line among rows {first} to "
            f"{first + len(lines) - 1}; save it again."
        ) from None


# ---------------------------------------------------------------------------------------------- numbers without lines


class TextNumbers:
    """The numbers of text one after another, whatever lines they stand on; each has the size 1.

    Args:
        content: of the file.
        start: where the numbers begin.
        kind: of the file, for messages.
    """

    def __init__(self, content: Content, start: int, kind: str) -> None:
        self._blocks = _blocks(content, start, kind, b" \t\r\n")
        self._kind = kind
        self._ahead: NDArray[np.float64] = np.empty(0)
        self._passed = 0

    @staticmethod
    def size(_: str) -> int:
        """Of a number of this type."""
        return 1

    def ahead(self, wanted: int) -> int:
        """How many numbers are at hand: at least as many as wanted, unless the text ends.

        Raises:
            UnreadableFile: a word that is no number.
        """
        parts, there = [self._ahead], len(self._ahead)
        while there < wanted and (block := next(self._blocks, None)) is not None:
            parts.append(self._decoded(block))
            there += len(parts[-1])
        if len(parts) > 1:
            self._ahead = np.concatenate(parts)
        return there

    def column(self, _: str, offset: int, stride: int, rows: int) -> NDArray[Any]:
        """(rows,) numbers, `stride` from each other, the first of them `offset` from here."""
        return self._ahead[offset : offset + stride * (rows - 1) + 1 : max(stride, 1)]

    def advance(self, count: int) -> None:
        """Pass over numbers that are at hand."""
        self._ahead = self._ahead[count:]
        self._passed += count

    def _decoded(self, block: bytes) -> NDArray[np.float64]:
        line = _SPACE.sub(b" ", block).strip()
        if not line:
            return np.empty(0)
        try:
            return np.loadtxt([line.decode("ascii")], dtype=np.float64, comments=None, ndmin=1)
        except ValueError:  # numpy's message would repeat the cloud
            raise UnreadableFile(
                f"The {self._kind} has something else than numbers behind number {self._passed}; save it again."
            ) from None
