"""Reads request bodies within limits: bytes of one body, and bytes of all bodies that are being read or decoded."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from starlette.requests import ClientDisconnect, Request

from service.errors import ClientGone, QueueFull, TooLarge


class Intake:
    """The bodies in memory.

    Args:
        max_body_bytes: limit of one body.
        max_bytes: limit of all bodies together.
    """

    def __init__(self, max_body_bytes: int, max_bytes: int) -> None:
        self._max_body_bytes = max_body_bytes
        self._max_bytes = max_bytes
        self._held = 0

    @asynccontextmanager
    async def body(self, request: Request) -> AsyncIterator[bytearray]:
        """The request's body; its bytes count until the block is left.

        Raises:
            TooLarge: at the announced length, or at the first byte too many of a body that announces none.
            QueueFull: too many bodies at once.
            ClientGone: the client hung up in the middle.
        """
        announced = request.headers.get("content-length", "")
        if announced.isdecimal() and int(announced) > self._max_body_bytes:
            raise self._too_large(f"{announced} bytes")
        body = bytearray()
        try:
            async for chunk in request.stream():
                self._held += len(chunk)
                body += chunk
                if len(body) > self._max_body_bytes:
                    raise self._too_large("more bytes")
                if self._held > self._max_bytes:
                    raise QueueFull(
                        "Too many large bodies arrive at once; repeat the request after 1 s.", retry_after=1
                    )
            yield body
        except ClientDisconnect:
            raise ClientGone("The client closed the connection while its body was read.") from None
        finally:
            self._held -= len(body)

    def _too_large(self, size: str) -> TooLarge:
        return TooLarge(
            f"The body has {size} (limit {self._max_body_bytes}); crop or downsample the cloud, or send it as "
            "application/octet-stream, 12 bytes a point."
        )
