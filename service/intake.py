"""Reads request bodies within limits: bytes of one body, and what is held for all requests."""

from __future__ import annotations

from starlette.requests import ClientDisconnect, Request

from service.errors import ClientGone, TooLarge
from service.memory import Share


async def read_body(request: Request, max_bytes: int, share: Share) -> bytearray:
    """The request's body, which `share` holds from its first byte on.

    Raises:
        TooLarge: at the announced length, or at the first byte too many of a body that announces none.
        QueueFull: too much is held for other requests.
        ClientGone: the client hung up in the middle.
    """
    announced = announced_bytes(request)
    if announced is not None and announced > max_bytes:
        raise _too_large(f"{announced} bytes", max_bytes)
    body = bytearray()
    try:
        async for chunk in request.stream():
            if len(body) + len(chunk) > max_bytes:
                raise _too_large("more bytes", max_bytes)
            share.resize(len(body) + len(chunk))
            body += chunk
    except ClientDisconnect:
        raise ClientGone("The client closed the connection while its body was read.") from None
    return body


def announced_bytes(request: Request) -> int | None:
    """The length that a request's head tells, None where it tells none; no more digits than a length can have."""
    announced = request.headers.get("content-length", "")
    return int(announced[:20]) if announced.isdecimal() else None


def _too_large(size: str, limit: int) -> TooLarge:
    return TooLarge(
        f"The body has {size} (limit {limit}); crop or downsample the cloud, or send it as "
        "application/octet-stream, 12 bytes a point."
    )
