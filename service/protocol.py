"""HTTP/1.1 on a connection: uvicorn's, which also ends those whose request never comes or whose answer is not read.

Works with whichever of uvicorn's protocols is beneath; `PunctualProtocol` is what the service runs.
"""

from __future__ import annotations

import asyncio
import math
import socket
from typing import TYPE_CHECKING, Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.memory import Memory

if TYPE_CHECKING:
    from typing_extensions import Self

KEEP_ALIVE_SECONDS = 65
"""Longer than the minute after which common proxies drop idle connections, so that the proxy closes first."""

HEAD_SECONDS = 10.0
"""For a request's head, from the connection or from the head's first byte. A body has the request's deadline."""

UNREAD_SECONDS = 10.0
UNREAD_BYTES = 65_536
"""Who reads less of an answer than this in `UNREAD_SECONDS` has its connection closed."""

SEND_BUFFER = 131_072
"""Bytes that the system is asked to take of an answer that is not read: on its own it takes megabytes a connection."""

PROBES_S = (0.05, 1.0)
"""When to look whether a client that has said all it will say still listens: for the first time, and then each time."""

_PROBE = b"HTTP/1.1 100 Continue\r\n\r\n"
"""Clients pass over it (RFC 9110, 15.2); where there is none any more, the system tells at the next one."""


class Reluctant(asyncio.Protocol):
    """Counts what a client has not read of its answers, and closes the connection of one that does not read.

    A base beside one of uvicorn's protocols. What the system has taken to send is no longer this process's memory.
    """

    memory = Memory(math.inf)
    unread_seconds = UNREAD_SECONDS
    unread_bytes = UNREAD_BYTES
    _transport: asyncio.Transport
    _unread_timer: asyncio.TimerHandle | None = None

    @classmethod
    def over(cls, memory: Memory) -> type[Self]:
        """The same protocol, which counts in `memory`."""
        return type(cls.__name__, (cls,), {"memory": memory})

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """A client is there; every byte that waits for it is told."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=0)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._transport = transport
        self._share = self.memory.share()

    def pause_writing(self) -> None:
        """The system takes no more: from now on the rest waits in this process."""
        super().pause_writing()
        loop = asyncio.get_running_loop()
        loop.call_soon(self._count_unread)  # when the request that it answers has let go of it
        self._unread_timer = loop.call_later(self.unread_seconds, self._check_unread)

    def resume_writing(self) -> None:
        """The system has taken everything."""
        self._forget_unread()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client is gone."""
        self._forget_unread()
        super().connection_lost(exc)

    def _count_unread(self) -> None:
        if self._unread_timer is not None:
            self.memory.keep_lying(self._share, self._transport.get_write_buffer_size(), self._transport.abort)

    def _check_unread(self) -> None:
        before = self._share.size
        self._count_unread()
        if self._share.size > before - self.unread_bytes:
            self._transport.abort()
        else:
            loop = asyncio.get_running_loop()
            self._unread_timer = loop.call_later(self.unread_seconds, self._check_unread)

    def _forget_unread(self) -> None:
        if self._unread_timer is not None:
            self._unread_timer.cancel()
            self._unread_timer = None
            self.memory.keep_lying(self._share, 0, self._transport.abort)


class PunctualProtocol(Reluctant, H11Protocol):
    """Closes a connection that sends nothing, or a head byte by byte. Between requests uvicorn's own timer runs.

    A client that ends its side of the connection behind its request gets its answer. One that has gone altogether looks
    the same until something is sent to it, so something is.
    """

    head_seconds = HEAD_SECONDS

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._head_timer: asyncio.TimerHandle | None = None
        self._probe_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """A client is there: its head is awaited."""
        super().connection_made(transport)
        self._head = self.memory.share()
        self._await_head()

    def data_received(self, data: bytes) -> None:
        """Bytes came: part of a head, or more."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._await_head()
            self.memory.keep_lying(self._head, self._head.size + len(data), self._transport.abort)
        else:
            self._forget_head()

    def eof_received(self) -> bool:  # type: ignore[override]  # asyncio asks for it, uvicorn has no use for it
        """The client says no more: whether the connection stays open, for the answer to a request that is complete."""
        asked = self.conn.their_state in (h11.DONE, h11.MUST_CLOSE) and self.conn.their_http_version == b"1.1"
        if not asked or self.conn.our_state not in (h11.SEND_RESPONSE, h11.SEND_BODY):
            return False
        self.cycle.keep_alive = False
        self._probe()
        return True

    def connection_lost(self, exc: Exception | None) -> None:
        """The client is gone."""
        self._forget_head()
        if self._probe_timer is not None:
            self._probe_timer.cancel()
        super().connection_lost(exc)

    def _probe(self, wait: float = PROBES_S[0]) -> None:
        if not self.cycle.response_started and not self._transport.is_closing():
            self._transport.write(_PROBE)
            self._probe_timer = self.loop.call_later(wait, self._probe, PROBES_S[1])

    def _await_head(self) -> None:
        if self._head_timer is None:
            self._head_timer = self.loop.call_later(self.head_seconds, self.timeout_keep_alive_handler)

    def _forget_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None
            self.memory.keep_lying(self._head, 0, self._transport.abort)
