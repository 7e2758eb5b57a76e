"""Rows of numbers in text, block by block: a whole file of lines as Python strings would take many times its size."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import UnreadableFile
from tesnet.formats.header import Content, check_bytes

_BLOCK = 1 << 17
"""Bytes decoded in one go: a few milliseconds, whatever the size of the file."""

_BLANK = re.compile(rb"\n\s+")
"""Lines without words, and what stands before the first word of a line: millions of them in a file made to be slow."""


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
    for lines in _blocks(content, start, kind):
        dropped = min(skip, len(lines))
        skip -= dropped
        wanted = lines[dropped : dropped + count - done]
        if wanted:
            rows[done : done + len(wanted)] = _numbers(wanted, columns, done, kind)
            done += len(wanted)
        if done == count:
            break
    if done < count:
        raise UnreadableFile(f"The {kind} has {done} rows, its header says {count}; it was cut off or damaged.")
    return rows


def _blocks(content: Content, start: int, kind: str) -> Iterator[list[bytes]]:
    view = memoryview(content)
    while start < len(view):
        block = bytes(view[start : start + _BLOCK])
        if start + len(block) < len(view):
            end = block.rfind(b"\n") + 1
            if end == 0:
                raise UnreadableFile(f"The {kind} has a line of over {_BLOCK} bytes; it was damaged.")
            block = block[:end]
        start += len(block)
        yield [line for line in _BLANK.sub(b"\n", block).split(b"\n") if line.strip()]


def _numbers(lines: list[bytes], columns: Sequence[int], first: int, kind: str) -> NDArray[np.float64]:
    try:
        text = [line.decode("ascii") for line in lines]
        return np.loadtxt(text, dtype=np.float64, comments=None, usecols=tuple(columns), ndmin=2)
    except ValueError:  # numpy's message would repeat the cloud
        raise UnreadableFile(
            f"The {kind} has something else than {max(columns) + 1} or more numbers in a line among rows {first} to "
            f"{first + len(lines) - 1}; save it again."
        ) from None
