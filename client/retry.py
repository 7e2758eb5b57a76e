"""When to try again, as a pure decision. Knows no HTTP library, no clock and no random state.

A grasp request is a pure computation: it changes nothing in the service, so sending it twice is harmless, and a
connection that was lost at any moment may be tried again.
"""

from __future__ import annotations

from dataclasses import dataclass

from client.errors import InvalidArgument


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How often and how patiently to try again.

    Lost connections are tried again, a proxy's to the service too (its 500 or 502), and so are the answers 429 and 503.
    Other answers never are: they would be the same again. A timeout never is: the time is used up.

    Args:
        max_retries: tries after the first.
        first_delay: seconds before the first retry; doubles with each one.
        max_delay: seconds that no wait of the client's own exceeds; the service's `Retry-After` may be longer.
    """

    max_retries: int = 2
    first_delay: float = 0.1
    max_delay: float = 5.0

    def __post_init__(self) -> None:
        if self.max_retries < 0:
            raise InvalidArgument("max_retries", f"is {self.max_retries}; give 0 (try once) or more")
        if not 0 < self.first_delay <= self.max_delay:
            raise InvalidArgument(
                "first_delay",
                f"is {self.first_delay:g} s; it must be over 0 and at most max_delay ({self.max_delay:g} s)",
            )

    def delay(self, retries: int, remaining: float, jitter: float, retry_after: float | None = None) -> float | None:
        """Seconds to wait before the next try, or None to give up.

        Args:
            retries: retries already made.
            remaining: seconds left of the caller's timeout; a wait that would use them up is not begun.
            jitter: uniform in [0, 1); spreads clients that failed together over the upper half of the wait.
            retry_after: seconds that the service asked to wait, which are never shortened.
        """
        if retries >= self.max_retries:
            return None
        if retry_after is None:
            ceiling = min(self.max_delay, self.first_delay * 2.0**retries)
            wait = ceiling * (0.5 + 0.5 * jitter)
        else:
            wait = retry_after + self.first_delay * jitter
        return wait if wait < remaining else None
