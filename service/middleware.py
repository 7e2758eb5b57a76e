"""Around every request: its id, its log line, its count, and a decent end for bodies that nobody reads."""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from dataclasses import dataclass, field
from typing import Any

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import NotReady, problem_response, shortened
from service.memory import Memory, Share
from service.metrics import Metrics
from service.schemas import REQUEST_ID

log = logging.getLogger("service.request")

COUNTED_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
"""Any other would be a label that a client makes up; Prometheus keeps a series for each."""

LOGGED_PATH, LOGGED_METHOD = 200, 20
"""Characters of what a client makes up that a log line repeats."""

LINGER_SECONDS = 5.0
LINGER_BYTES = 128 * 2**20
"""A client that still sends after its answer is heard so long: closing at once would destroy the answer on its way."""


@dataclass(slots=True)
class RequestRecord:
    """What is known of a request while it is answered; routes add `fields` to its log line."""

    request_id: str
    arrived: float
    share: Share
    fields: dict[str, Any] = field(default_factory=dict)
    bytes_in: int = 0
    asked_for_body: bool = False
    body_complete: bool = False
    status: int = 0
    key: bytes | None = None
    """The digest of its API key."""


class RequestMiddleware:
    """Gives `scope["state"]["record"]`; answers what no handler caught as a 500.

    Args:
        app: the application inside.
        metrics: counts requests.
        memory: what is held for them.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, memory: Memory) -> None:
        self._app = app
        self._metrics = metrics
        self._memory = memory

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        record = RequestRecord(request_id_of(headers.get("x-request-id")), time.perf_counter(), self._memory.share())
        scope.setdefault("state", {})["record"] = record
        record.body_complete = not _announces_body(headers)

        async def receiving() -> Message:
            record.asked_for_body = True
            message = await receive()
            if message["type"] == "http.request":
                record.bytes_in += len(message.get("body", b""))
                record.body_complete = not message.get("more_body", False)
            return message

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                record.status = message["status"]
                answer_headers = MutableHeaders(scope=message)
                answer_headers["X-Request-ID"] = record.request_id
                if not record.body_complete or _is_ambiguous(headers):
                    answer_headers["Connection"] = "close"
            elif not message.get("more_body", False) and not record.body_complete:
                await send({**message, "more_body": True})
                if record.asked_for_body or "expect" not in headers:
                    await _linger(receiving, record)
                message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        try:
            await self._app(scope, receiving, sending)
        except asyncio.CancelledError:  # the server's: draining took too long
            await _refuse_at_the_end(record, scope, receive, send)
        except Exception as error:
            log.exception("failed", extra={"fields": {"request_id": record.request_id}})
            if record.status:
                raise
            await problem_response(error, scope)(scope, receiving, sending)
        finally:
            record.share.release()
            self._finish(scope, record)

    def _finish(self, scope: Scope, record: RequestRecord) -> None:
        seconds = time.perf_counter() - record.arrived
        route = getattr(scope.get("route"), "path", "other")
        is_known = scope["method"] in COUNTED_METHODS
        method = scope["method"] if is_known else "other"
        self._metrics.request(method, route, record.status, seconds)
        log.info(
            "request",
            extra={
                "fields": {
                    "request_id": record.request_id,
                    "method": scope["method"] if is_known else shortened(scope["method"], LOGGED_METHOD),
                    "path": shortened(scope["path"], LOGGED_PATH),
                    "status": record.status,
                    "duration_ms": round(1e3 * seconds, 3),
                    "bytes_in": record.bytes_in,
                    **record.fields,
                }
            },
        )


def request_id_of(given: str | None) -> str:
    """The client's id where it is fit for a log (up to 128 letters, digits and . _ : / + = -), else a fresh one."""
    if given and re.fullmatch(REQUEST_ID, given):
        return given
    return uuid.uuid4().hex


def _is_ambiguous(headers: Headers) -> bool:
    """Whether a body has two lengths, which others on the way may read differently (RFC 9112, 6.1)."""
    return "transfer-encoding" in headers and "content-length" in headers


def _announces_body(headers: Headers) -> bool:
    return "transfer-encoding" in headers or headers.get("content-length", "0") != "0"


async def _refuse_at_the_end(record: RequestRecord, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer 503, without waiting for the rest of a body, unless an answer was begun."""
    if record.status:
        return
    error = NotReady("The service ended before this request was answered; repeat it.", retry_after=1)
    response = problem_response(error, scope)
    response.headers.update({"X-Request-ID": record.request_id, "Connection": "close"})
    record.status = response.status_code
    await response(scope, receive, send)


async def _linger(receive: Receive, record: RequestRecord) -> None:
    """Read and forget the rest of a body whose answer is on its way."""
    limit = record.bytes_in + LINGER_BYTES
    with anyio.move_on_after(LINGER_SECONDS):
        while not record.body_complete and record.bytes_in < limit:
            if (await receive())["type"] == "http.disconnect":
                return
