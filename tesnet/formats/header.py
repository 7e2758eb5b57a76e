"""What the headers of PLY and PCD files have in common: lines of words before the data."""

from __future__ import annotations

from typing import TypeAlias

from tesnet.errors import TooManyPoints, UnreadableFile

Content: TypeAlias = bytes | bytearray | memoryview

MAX_HEADER_BYTES = 65_536
_MAX_DIGITS = 12


def header_lines(content: Content, last: str, kind: str) -> tuple[list[list[str]], int]:
    """The header's lines, each as its words, up to the line that begins with the word `last`; where the data starts.

    Raises:
        UnreadableFile: no such line in the first 64 KiB, or bytes that are no ASCII.
    """
    head = bytes(memoryview(content)[:MAX_HEADER_BYTES])
    lines: list[list[str]] = []
    start = 0
    while (end := head.find(b"\n", start)) >= 0:
        try:
            words = head[start:end].decode("ascii").split()
        except UnicodeDecodeError:
            break
        start = end + 1
        if words:
            lines.append(words)
            if words[0] == last:
                return lines, start
    raise UnreadableFile(
        f"The {kind} header has no line {last!r} in its first {len(head)} bytes; the file was cut off or damaged."
    )


def whole_number(word: str, what: str) -> int:
    """A count or a size that a header claims.

    Raises:
        UnreadableFile: not a whole number from 0 on, or more digits than a file has bytes for.
    """
    if not (word.isascii() and word.isdecimal() and len(word) <= _MAX_DIGITS):
        shown = word if len(word) <= 20 and word.isprintable() else f"{word[:17]!a}..."
        raise UnreadableFile(f"The {what} is {shown}; it must be a whole number of at most {_MAX_DIGITS} digits.")
    return int(word)


def check_count(count: int, max_points: int | None) -> None:
    """Raise `TooManyPoints` for more points than the limit; None is no limit."""
    if max_points is not None and count > max_points:
        raise TooManyPoints(count, max_points)


def check_bytes(wanted: int, there: int, kind: str) -> None:
    """Raise `UnreadableFile` for a header that claims more bytes than are there."""
    if wanted > there:
        raise UnreadableFile(
            f"The {kind} has {there} bytes of data, its header says {wanted} or more; it was cut off or damaged."
        )
