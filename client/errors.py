"""Everything the client raises on purpose.

::

    GraspClientError
    +-- InvalidArgument          refused here, before anything is sent; also a ValueError; `argument` names it
    +-- ServiceUnreachable       no connection, or lost on every try, by a proxy before the service too
    +-- ServiceTimeout           no answer within the caller's timeout
    +-- UnexpectedResponse       not this service's answer, or too large: wrong URL, a proxy's page, another version
    +-- ProblemError             the service's own problem+json: status, title, detail, request_id, problem
        +-- BadRequest             400  the body cannot be decoded
        +-- Unauthorized           401  API key missing or wrong
        +-- PayloadTooLarge        413  more bytes or points than the service's limits
        +-- UnsupportedMediaType   415  unknown content type
        +-- InvalidRequest         422  decodes, but a value cannot be used
        +-- Overloaded             429, 503  queue full or draining; `retry_after` seconds
        +-- DeadlineExceeded       504  the service gave up at the deadline
        +-- ServiceFault           any other 5xx

A status without a class of its own is a plain `ProblemError`. Messages give the value, the limit and the remedy, and
never the cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any


class GraspClientError(Exception):
    """Base class of this package's errors. All of them can be pickled, so worker processes can raise them."""


class InvalidArgument(GraspClientError, ValueError):
    """An argument that cannot be sent.

    Args:
        argument: its name (`points`, `base_url`, ...).
        message: the value, the limit and the remedy.
    """

    def __init__(self, argument: str, message: str) -> None:
        super().__init__(f"{argument}: {message}")
        self.argument = argument
        self.message = message

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.argument, self.message)


class ServiceUnreachable(GraspClientError):
    """No connection to the service, or a connection lost on every try, be it ours or a proxy's."""


class ServiceTimeout(GraspClientError):
    """No answer within the caller's timeout."""


class UnexpectedResponse(GraspClientError):
    """An answer that this service does not give.

    Args:
        message: what was expected, what came and what to check.
        status: the HTTP status.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.status)


class ProblemError(GraspClientError):
    """The service answered `application/problem+json` (RFC 9457).

    Args:
        status: the HTTP status.
        title: the kind of problem, in a few words.
        detail: the value, the limit and the remedy.
        request_id: names this request in the service's log.
        problem: the whole document.
        retry_after: seconds the service asks to wait, where it does.
    """

    def __init__(
        self,
        status: int,
        title: str,
        detail: str,
        request_id: str | None = None,
        problem: Mapping[str, Any] | None = None,
        retry_after: float | None = None,
    ) -> None:
        suffix = f" (request {request_id})" if request_id else ""
        super().__init__(f"{status} {title}: {detail}{suffix}")
        self.status = status
        self.title = title
        self.detail = detail
        self.request_id = request_id
        self.problem: Mapping[str, Any] = MappingProxyType(dict(problem or {}))
        self.retry_after = retry_after

    def __reduce__(self) -> tuple[Any, ...]:
        fields = (self.status, self.title, self.detail, self.request_id, dict(self.problem), self.retry_after)
        return type(self), fields


class BadRequest(ProblemError):
    """400: the body cannot be decoded."""


class Unauthorized(ProblemError):
    """401: the service wants an API key, and it is missing or wrong."""


class PayloadTooLarge(ProblemError):
    """413: more bytes or points than the service's limits."""


class UnsupportedMediaType(ProblemError):
    """415: the service does not know the content type."""


class InvalidRequest(ProblemError):
    """422: the request decodes, but a value in it cannot be used."""


class Overloaded(ProblemError):
    """429 or 503: the queue is full, or the service is starting or draining. `retry_after` says when to come back."""


class ServiceFault(ProblemError):
    """5xx: the service failed; its log has the reason under `request_id`."""


class DeadlineExceeded(ProblemError):
    """504: the service stopped computing because the deadline had passed."""


_BY_STATUS: Mapping[int, type[ProblemError]] = MappingProxyType(
    {
        400: BadRequest,
        401: Unauthorized,
        413: PayloadTooLarge,
        415: UnsupportedMediaType,
        422: InvalidRequest,
        429: Overloaded,
        503: Overloaded,
        504: DeadlineExceeded,
    }
)


def problem_class(status: int) -> type[ProblemError]:
    """The class of errors that an HTTP status stands for."""
    return _BY_STATUS.get(status, ServiceFault if status >= 500 else ProblemError)
