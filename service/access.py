"""Who may ask: API keys, where the settings name any. Knows no routes but the open ones."""

from __future__ import annotations

import hmac
from collections.abc import Iterable, Sequence
from hashlib import sha256

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Unauthorized, problem_response
from service.viewer import PAGE_PATHS

DOCS_FILES = "/docs/static"
"""Where the parts of the page `/docs` lie."""

OPEN_PATHS = PAGE_PATHS | {
    "/health/live",
    "/health/ready",
    "/v2/health/live",
    "/v2/health/ready",
    "/docs",
    "/docs/oauth2-redirect",
    f"{DOCS_FILES}/swagger-ui-bundle.js",
    f"{DOCS_FILES}/swagger-ui.css",
    f"{DOCS_FILES}/favicon.png",
    "/openapi.json",
}
"""Answered without a key: what an orchestrator probes, the documentation and the viewer, which hold no secret."""


class AccessMiddleware:
    """Answers 401 to a request without a key, before its body is read.

    Args:
        app: the application inside.
        keys: any of them opens every route.
    """

    def __init__(self, app: ASGIApp, keys: Sequence[str]) -> None:
        self._app = app
        self._digests = [_digest(key) for key in keys]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http" or scope["path"] in OPEN_PATHS:
            await self._app(scope, receive, send)
        elif (key := self._known(_keys_of(Headers(scope=scope)))) is not None:
            scope["state"]["record"].key = key
            await self._app(scope, receive, send)
        else:
            error = Unauthorized(
                "An API key is missing or wrong; send one as `Authorization: Bearer KEY` or `X-API-Key: KEY`."
            )
            await problem_response(error, scope)(scope, receive, send)

    def _known(self, given: Iterable[str]) -> bytes | None:
        """The digest of the key among what was given; each is compared in full, so that the time tells nothing."""
        digests = [_digest(key) for key in given]
        found = [known for digest in digests for known in self._digests if hmac.compare_digest(digest, known)]
        return found[-1] if found else None


def _keys_of(headers: Headers) -> list[str]:
    """What may be a key: `Authorization` can be meant for a proxy on the way, so it does not hide `X-API-Key`."""
    scheme, _, credentials = headers.get("authorization", "").partition(" ")
    return [credentials.strip() if scheme.lower() == "bearer" else "", headers.get("x-api-key", "")]


def _digest(key: str) -> bytes:
    return sha256(key.encode()).digest()
