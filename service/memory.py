"""Bytes that are held for requests: bodies, clouds that wait, answers on their way. For the event loop's thread alone.

A lone request is always served, whatever it holds; beside others it is refused where the limit would be passed.
What clients leave lying, answers that they do not read and heads that they do not finish, cannot be refused: before
anybody is, the one that lies there the longest loses its connection.
"""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

from service.errors import QueueFull

if TYPE_CHECKING:
    from typing_extensions import Self


class Memory:
    """What all requests hold together.

    Args:
        limit: bytes.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.held = 0
        self._lying: dict[Share, Callable[[], None]] = {}

    def share(self) -> Share:
        """What one more request holds; nothing yet."""
        return Share(self)

    def keep_lying(self, share: Share, size: int, close: Callable[[], None]) -> None:
        """Note what a client leaves lying; over the limit the oldest of such connections are closed.

        Args:
            share: the connection's.
            size: bytes; 0 for nothing any more.
            close: ends the connection, and its share with it.
        """
        self.held += size - share.size
        share.size = size
        if size:
            self._lying.setdefault(share, close)
        else:
            self._lying.pop(share, None)
        if self.held > share.size:  # a lone one may lie
            self.make_room(0)

    def make_room(self, size: int) -> None:
        """Close what lies there the longest until so many bytes more may be held, or nothing lies there any more."""
        while self._lying and self.held + size > self.limit:
            oldest = next(iter(self._lying))
            close = self._lying.pop(oldest)
            oldest.release()
            close()


class Share:
    """What one request, or one connection, holds. A context manager that lets go of it."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self.size = 0

    def resize(self, size: int) -> None:
        """Hold so many bytes from now on.

        Raises:
            QueueFull: more than before, and with what others hold more than the limit.
        """
        self._memory.make_room(size - self.size)
        others = self._memory.held - self.size
        if size > self.size and others > 0 and others + size > self._memory.limit:
            raise QueueFull(
                f"{others / 2**20:.0f} MiB are held for other requests and this one needs {size / 2**20:.0f} MiB "
                f"(limit {self._memory.limit / 2**20:.0f} MiB in all); repeat it after 1 s.",
                retry_after=1,
            )
        self._memory.held = others + size
        self.size = size

    def release(self) -> None:
        """Hold nothing any more."""
        self._memory.held -= self.size
        self.size = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
