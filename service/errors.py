"""Exceptions -> `application/problem+json` (RFC 9457), in one table.

Of the routes it knows where those of the Open Inference Protocol begin, whose clients look for a field of their own.

::

    ServiceError
    +-- Unauthorized         no API key, or a wrong one
    +-- UnknownModel         no such network or version at this path
    +-- Undecodable          the body is not what its content type says
    +-- TooLarge             more bytes or points than the limits
    +-- UnknownContentType   no decoder for the body
    +-- NotAcceptable        no encoder for what the client accepts
    +-- Invalid              decodes, but a value cannot be used; `field` names it
    +-- QueueFull            come back after `retry_after` seconds
    +-- NotReady             loading or draining; the same
    +-- DeadlineExceeded     the client's deadline passed
    +-- ClientGone           nobody is left to answer

`InvalidQuery`, `UnreadableFile` and `TooManyPoints` of `tesnet.errors` have their rows too.

A detail states the value, the limit and the remedy; it never holds the
cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus

import msgspec
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Scope

from service.schemas import Problem
from tesnet.errors import InvalidQuery, TooManyPoints, UnreadableFile

PROBLEM_JSON = "application/problem+json"
INFERENCE_PROTOCOL = "/v2"
"""Where the paths of the Open Inference Protocol begin, whose clients read a problem's `error`."""


class ServiceError(Exception):
    """Base class of what the service refuses a request for."""


class Unauthorized(ServiceError):
    """An API key is wanted, and none or a wrong one came."""


class UnknownModel(ServiceError):
    """The path names a network, or a version of it, that is not loaded."""


class Undecodable(ServiceError):
    """The body is not what its content type says."""


class TooLarge(ServiceError):
    """More bytes or points than the configured limits."""


class UnknownContentType(ServiceError):
    """No decoder for the request's body."""


class NotAcceptable(ServiceError):
    """No encoder for what the client accepts."""


class Invalid(ServiceError):
    """A value that decodes but cannot be used.

    Args:
        field: the option or header, as on the wire.
        message: the value, the limit and the remedy.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field


class _TryLater(ServiceError):
    """The same request may succeed in `retry_after` seconds."""

    def __init__(self, message: str, retry_after: int) -> None:
        super().__init__(message)
        self.retry_after = retry_after


class QueueFull(_TryLater):
    """As many requests wait as may."""


class NotReady(_TryLater):
    """The weights are being loaded, or the process is about to end."""


class DeadlineExceeded(ServiceError):
    """The request's deadline passed before the answer was there."""


class ClientGone(ServiceError):
    """The client closed the connection. Nobody reads the answer; the log has status 499."""


@dataclass(frozen=True, slots=True)
class Row:
    """How a kind of exception is told to the client."""

    status: int
    slug: str
    title: str
    when: str


_UNDECODABLE = Row(
    400,
    "undecodable-body",
    "The body cannot be decoded",
    "Empty or truncated body, broken JSON, form, .npy, PLY, PCD or PNG",
)
_TOO_LARGE = Row(
    413, "too-large", "The request is too large", "More bytes, points or pixels than the configured limits"
)
_INVALID = Row(
    422, "invalid-request", "A value cannot be used", "NaN, wrong shape, not metres, an option unknown or out of range"
)

PROBLEMS: Mapping[type[Exception], Row] = {
    Unauthorized: Row(
        401, "unauthorized", "An API key is wanted", "API keys are configured, and the request has none of them"
    ),
    UnknownModel: Row(404, "unknown-model", "No such model", "The path names a model or version that is not loaded"),
    Undecodable: _UNDECODABLE,
    UnreadableFile: _UNDECODABLE,
    NotAcceptable: Row(
        406, "not-acceptable", "No such answer format", "`Accept` asks for other formats than the service's"
    ),
    TooLarge: _TOO_LARGE,
    TooManyPoints: _TOO_LARGE,
    UnknownContentType: Row(
        415, "unknown-content-type", "The content type is not supported", "Unknown `Content-Type` or `Content-Encoding`"
    ),
    Invalid: _INVALID,
    InvalidQuery: _INVALID,
    QueueFull: Row(
        429, "queue-full", "The queue is full", "Too many requests wait; `Retry-After` says when to come back"
    ),
    NotReady: Row(
        503, "not-ready", "The service is not ready", "Loading or draining; `Retry-After` says when to come back"
    ),
    DeadlineExceeded: Row(
        504, "deadline-exceeded", "The deadline passed", "No answer within `X-Request-Timeout` seconds"
    ),
    ClientGone: Row(499, "client-gone", "The client closed the connection", "Seen in the log only"),
}
INTERNAL = Row(500, "internal-error", "The service failed", "A fault of the service, never of the body")


def problem_response(error: Exception, scope: Scope) -> Response:
    """The problem document for an exception. What the table does not know is a 500 that tells no details.

    Args:
        error: what went wrong.
        scope: of the request, with its record.
    """
    headers: dict[str, str] = {}
    field: str | None = None
    if isinstance(error, HTTPException):  # the router's 404 and 405
        row = _http_row(error)
        detail = _http_detail(error)
        headers.update(error.headers or {})
    else:
        row = next((PROBLEMS[kind] for kind in type(error).__mro__ if kind in PROBLEMS), INTERNAL)
        detail = str(error) if row is not INTERNAL else "The service's log has the reason under this request_id."
        if isinstance(error, (Invalid, InvalidQuery, TooManyPoints)):
            field = error.field
        if isinstance(error, _TryLater):
            headers["Retry-After"] = str(error.retry_after)
        if isinstance(error, Unauthorized):
            headers["WWW-Authenticate"] = 'Bearer realm="tes-net"'
    problem = Problem(
        type=f"urn:tes-net:problem:{row.slug}",
        title=row.title,
        status=row.status,
        detail=detail,
        request_id=scope["state"]["record"].request_id,
        field=field,
        error=detail if f"{scope['path']}/".startswith(f"{INFERENCE_PROTOCOL}/") else None,
    )
    body = msgspec.json.encode(problem.model_dump(exclude_none=True))
    return Response(body, row.status, headers, media_type=PROBLEM_JSON)


def shortened(text: str, limit: int = 80) -> str:
    """A value that a client sent, fit for a message: printable and short."""
    printable = "".join(character if character.isprintable() else "?" for character in text[: limit + 1])
    return printable if len(printable) <= limit else f"{printable[: limit - 3]}..."


def _http_row(error: HTTPException) -> Row:
    phrase = HTTPStatus(error.status_code).phrase
    return Row(error.status_code, phrase.lower().replace(" ", "-"), phrase, phrase)


def _http_detail(error: HTTPException) -> str:
    if error.status_code == HTTPStatus.NOT_FOUND:
        return "There is nothing at this path; /docs lists what there is."
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        return f"This path does not take this method; it takes {(error.headers or {}).get('Allow', 'another one')}."
    return str(error.detail)
