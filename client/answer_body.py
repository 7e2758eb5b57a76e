"""The body of an answer as it comes, within a limit, whatever it grows to when it is unpacked. No input or output."""

from __future__ import annotations

import zlib

ENCODINGS = {"": None, "identity": None, "gzip": 16 + zlib.MAX_WBITS, "x-gzip": 16 + zlib.MAX_WBITS}
"""Content encodings, with what zlib is told of each."""


class UnusableBody(Exception):
    """The body is not to be read further; the message says why and what to do."""


class AnswerBody:
    """Collects the bytes of an answer.

    Args:
        encoding: the answer's `Content-Encoding`.
        limit: bytes, unpacked.

    Raises:
        UnusableBody: an encoding that was not asked for.
    """

    def __init__(self, encoding: str, limit: int) -> None:
        name = encoding.strip().lower()
        if name not in ENCODINGS:
            raise UnusableBody(f"the answer is encoded as {name[:40]!r}; `gzip` or none was asked for")
        window = ENCODINGS[name]
        self._unpack = None if window is None else zlib.decompressobj(window)
        self._limit = limit
        self._content = bytearray()

    def add(self, chunk: bytes) -> None:
        """The next bytes as they came.

        Raises:
            UnusableBody: over the limit, beyond which no more than one byte is unpacked; or damaged.
        """
        self._content += chunk if self._unpack is None else self._unpacked(self._unpack, chunk)
        if len(self._content) > self._limit:
            raise UnusableBody(f"the answer has over {self._limit / 2**20:g} MB; raise `max_answer_mb` if it may have")

    def content(self) -> bytes:
        """All bytes, once they came.

        Raises:
            UnusableBody: cut off.
        """
        if self._unpack is not None and not self._unpack.eof:
            raise UnusableBody("the answer ends in the middle of its gzip")
        return bytes(self._content)

    def _unpacked(self, unpack: zlib._Decompress, chunk: bytes) -> bytes:
        if unpack.eof:
            raise UnusableBody("the answer goes on after the end of its gzip")
        try:
            return unpack.decompress(chunk, self._limit + 1 - len(self._content))
        except zlib.error as error:
            raise UnusableBody(f"the answer is no gzip, though its headers say so ({error})") from None
