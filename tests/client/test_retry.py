from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client.errors import InvalidArgument
from client.retry import RetryPolicy

JITTER = st.floats(0, 1, exclude_max=True)


@given(st.integers(0, 20), st.floats(0, 100), JITTER)
def test_a_wait_is_bounded_and_never_outlasts_the_time_left(retries: int, remaining: float, jitter: float) -> None:
    policy = RetryPolicy(max_retries=10, first_delay=0.1, max_delay=2.0)
    wait = policy.delay(retries, remaining, jitter)
    assert wait is None or 0.05 <= wait < min(remaining, 2.0 + 1e-9)


@given(st.integers(0, 5), JITTER)
def test_waits_double(retries: int, jitter: float) -> None:
    policy = RetryPolicy(max_retries=10, first_delay=0.1, max_delay=60)
    first, second = policy.delay(retries, 100, jitter), policy.delay(retries + 1, 100, jitter)
    assert first is not None
    assert second == pytest.approx(2 * first)


@given(st.floats(0, 60), JITTER)
def test_the_wait_that_the_service_asks_for_is_never_shortened(retry_after: float, jitter: float) -> None:
    wait = RetryPolicy(max_delay=5).delay(0, 100, jitter, retry_after)
    assert wait is not None
    assert retry_after <= wait <= retry_after + 0.1


def test_a_wait_that_is_asked_for_but_longer_than_the_time_left_ends_the_tries() -> None:
    assert RetryPolicy().delay(0, 1.0, 0.0, 2.0) is None
    assert RetryPolicy().delay(0, 29.0, 0.0, 29.0) is None


def test_tries_end_after_max_retries() -> None:
    policy = RetryPolicy(max_retries=2)
    assert policy.delay(1, 100, 0.5) is not None
    assert policy.delay(2, 100, 0.5) is None
    assert RetryPolicy(max_retries=0).delay(0, 100, 0.5) is None


def test_an_impossible_policy_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="max_retries: is -1"):
        RetryPolicy(max_retries=-1)
    with pytest.raises(InvalidArgument, match="first_delay: is 10 s"):
        RetryPolicy(first_delay=10, max_delay=1)


@pytest.mark.parametrize("jitter", [0.0, 0.25, 0.5, 0.999])
def test_clients_that_failed_together_come_back_apart(jitter: float) -> None:
    """Over the upper half of the wait, and over a first delay beyond what the service asks for."""
    policy = RetryPolicy(max_retries=9, first_delay=0.2, max_delay=1.0)
    for retries, whole in enumerate((0.2, 0.4, 0.8, 1.0, 1.0)):
        assert policy.delay(retries, 100, jitter) == pytest.approx(whole / 2 + jitter * whole / 2)
        assert policy.delay(retries, 100, jitter, 7.0) == pytest.approx(7.0 + 0.2 * jitter)


def test_the_defaults_and_the_limits_of_a_policy() -> None:
    assert RetryPolicy() == RetryPolicy(max_retries=2, first_delay=0.1, max_delay=5.0)
    RetryPolicy(max_retries=0, first_delay=5.0)
    for first_delay in (0.0, -0.1, 5.001):
        with pytest.raises(InvalidArgument, match="first_delay"):
            RetryPolicy(first_delay=first_delay)


@given(st.floats(0.01, 50), st.floats(0, 20), JITTER)
def test_a_wait_that_would_end_with_the_time_is_not_begun(remaining: float, retry_after: float, jitter: float) -> None:
    wait = RetryPolicy().delay(0, remaining, jitter, retry_after)
    meant = retry_after + 0.1 * jitter
    assert wait == (meant if meant < remaining else None)
