"""What is sent, when it is sent again and what the outcome means: the client's logic without any input or output.

A conversation is a generator. It yields what it wants done (`Send` or `Wait`), is sent the outcome, and returns the
parsed reply or raises the typed error. `session.py` performs the steps, once for threads and once for asyncio, so both
clients behave alike by construction.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias, TypeVar

from client.errors import Overloaded, ProblemError, ServiceTimeout, ServiceUnreachable, UnexpectedResponse
from client.reply import Answer, problem
from client.request import Request
from client.retry import RetryPolicy

T = TypeVar("T")

Clock = Callable[[], float]
"""Monotonic seconds."""

PROBE_TIMEOUT = 5.0
"""Seconds that one look at the service's health may take."""

POLL_INTERVAL = 0.1
"""Seconds between two looks while waiting for a service to become ready."""


@dataclass(frozen=True, slots=True)
class Send:
    """Send the request; the outcome is an `Answer` or a failure, after `timeout` seconds at most."""

    request: Request
    timeout: float


@dataclass(frozen=True, slots=True)
class Wait:
    """Let time pass; the outcome is None."""

    seconds: float


@dataclass(frozen=True, slots=True)
class ConnectionLost:
    """Refused, reset or closed before the whole answer was there."""

    why: str


@dataclass(frozen=True, slots=True)
class TimedOut:
    """The time given to `Send` passed."""


@dataclass(frozen=True, slots=True)
class Unusable:
    """An answer came that is not to be read to its end."""

    why: str
    status: int


Step: TypeAlias = Send | Wait
Outcome: TypeAlias = Answer | Unusable | ConnectionLost | TimedOut | None
Conversation: TypeAlias = Generator[Step, Outcome, T]


def ask(
    request: Request,
    parse: Callable[[Answer], T],
    *,
    timeout: float,
    policy: RetryPolicy,
    clock: Clock,
    rng: random.Random,
) -> Conversation[T]:
    """Send a request, again where `policy` allows it, and return the parsed answer, all within `timeout` seconds.

    Raises:
        ServiceUnreachable: the connection, or a proxy's to the service, was refused or lost on every try.
        ServiceTimeout: no answer in time.
        ProblemError: the service refused or failed; see `client.errors` for the kinds.
        UnexpectedResponse: the answer is not this service's, or larger than it may be.
    """
    deadline = clock() + timeout
    retries = 0
    while True:
        remaining = deadline - clock()
        outcome = yield Send(_with_deadline(request, remaining), remaining)
        error: ServiceUnreachable | Overloaded
        if isinstance(outcome, TimedOut):
            raise ServiceTimeout(
                f"no answer within {timeout:g} s; raise `timeout`, or lower `num_approach_points` and `max_candidates`"
            )
        if isinstance(outcome, Unusable):
            raise UnexpectedResponse(f"{outcome.why}; status {outcome.status}; check the URL", outcome.status)
        if isinstance(outcome, ConnectionLost):
            error = ServiceUnreachable(f"{outcome.why}; is the service running, and is the URL right?")
        else:
            assert outcome is not None, "a Send ends in an answer or a failure"
            if outcome.status == 200:
                return parse(outcome)
            refusal = problem(outcome)
            if not isinstance(refusal, Overloaded | ServiceUnreachable):
                raise refusal
            error = refusal
        retry_after = error.retry_after if isinstance(error, Overloaded) else None
        wait = policy.delay(retries, deadline - clock(), rng.random(), retry_after)
        if wait is None:
            raise error
        yield Wait(wait)
        retries += 1


def look(path: str, *, timeout: float) -> Conversation[bool]:
    """Whether a health route answers 200; False also where nothing answers. One try."""
    outcome = yield Send(Request("GET", path), timeout)
    return isinstance(outcome, Answer) and outcome.status == 200


def await_ready(*, timeout: float, clock: Clock) -> Conversation[None]:
    """Look at the service's readiness until it is ready.

    Raises:
        ServiceTimeout: not ready after `timeout` seconds; the message says what the last look saw.
    """
    deadline = clock() + timeout
    while True:
        remaining = deadline - clock()
        outcome = yield Send(Request("GET", "/health/ready"), max(min(remaining, PROBE_TIMEOUT), POLL_INTERVAL))
        if isinstance(outcome, Answer) and outcome.status == 200:
            return
        if deadline - clock() <= POLL_INTERVAL:
            raise ServiceTimeout(f"not ready after {timeout:g} s: {_seen(outcome)}")
        yield Wait(POLL_INTERVAL)


def _seen(outcome: Outcome) -> str:
    if isinstance(outcome, ConnectionLost | Unusable):
        return outcome.why
    if isinstance(outcome, Answer):
        error = problem(outcome)
        return f"{error.status} {error.title}: {error.detail}" if isinstance(error, ProblemError) else str(error)
    return "no answer"


def _with_deadline(request: Request, remaining: float) -> Request:
    """The request with the time that the service has, a little less than ours so that its explanation still arrives."""
    seconds = max(remaining - min(0.1, 0.1 * remaining), 0.001)
    headers: Mapping[str, str] = {**request.headers, "X-Request-Timeout": f"{seconds:.3f}"}
    return replace(request, headers=headers)
