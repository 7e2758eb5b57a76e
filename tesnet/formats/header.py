"""What text at the beginning of cloud files has in common: byte order marks, lines of words before the data, counts."""

from __future__ import annotations

import codecs
from typing import TypeAlias

from tesnet.errors import TooManyPoints, UnreadableFile

Content: TypeAlias = bytes | bytearray | memoryview

MAX_HEADER_BYTES = 65_536
_MAX_DIGITS = 12
_WIDE_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def unmarked(content: Content) -> Content:
    """The content behind a byte order mark, if it begins with one; UTF-16 (as Windows' consoles write it) as UTF-8."""
    if bytes(content[:3]) == codecs.BOM_UTF8:
        return memoryview(content)[3:]
    if bytes(content[:2]) in _WIDE_MARKS:
        return bytes(content).decode("utf-16", "replace").encode()
    return content


def beginning(content: Content, size: int = MAX_HEADER_BYTES) -> bytes:
    """The first bytes behind a byte order mark, for a look at what they are."""
    return bytes(unmarked(memoryview(content)[:size]))


def header_lines(content: Content, last: str, kind: str) -> tuple[list[list[str]], int]:
    """The header's lines, each as its words, up to the line that begins with the word `last`; where the data starts.

    Lines end as the first one does: with a line feed, a carriage return, or both. Bytes outside of ASCII, which occur
    in comments, mean nothing and may be of any encoding.

    Raises:
        UnreadableFile: no such line in the first 64 KiB.
    """
    head = bytes(memoryview(content)[:MAX_HEADER_BYTES])
    feed, ending = head.find(b"\n"), head.find(b"\r")
    separator = b"\r" if ending >= 0 and not 0 <= feed <= ending + 1 else b"\n"
    lines: list[list[str]] = []
    start = 0
    while (end := head.find(separator, start)) >= 0:
        words = [word.decode("latin-1") for word in head[start:end].split()]
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
