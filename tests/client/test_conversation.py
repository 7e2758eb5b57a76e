"""The conversation itself, with a clock in the test's hand: no network and no waiting."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import client
from client.conversation import (
    POLL_INTERVAL,
    PROBE_TIMEOUT,
    ConnectionLost,
    Outcome,
    Send,
    TimedOut,
    Unusable,
    Wait,
    ask,
    await_ready,
    look,
)
from client.reply import Answer, grasp_reply
from client.request import Request
from tests.client.conftest import Answering

Refusing = Callable[..., Answering]


def test_the_deadline_shrinks_with_every_try(refusing: Refusing) -> None:
    """The conversation itself, with a clock in the test's hand: no network and no waiting."""
    now = 0.0
    refused = Answer(503, {"retry-after": "1"}, refusing(503).body)
    policy = client.RetryPolicy(max_retries=5, first_delay=0.1)
    steps = ask(
        Request("POST", "/grasps"), grasp_reply, timeout=5, policy=policy, clock=lambda: now, rng=random.Random(0)
    )
    step = next(steps)
    budgets = []
    for _ in range(2):
        assert isinstance(step, Send)
        budgets.append((step.timeout, float(step.request.headers["X-Request-Timeout"])))
        now += 0.5
        wait = steps.send(refused)
        assert isinstance(wait, Wait)
        assert 1 <= wait.seconds <= 1.2
        now += wait.seconds
        step = steps.send(None)
    assert isinstance(step, Send)
    now += 1.5
    with pytest.raises(client.Overloaded):  # half a second is left, and the service asks for one
        steps.send(refused)
    budgets.append((step.timeout, float(step.request.headers["X-Request-Timeout"])))
    assert budgets[0][0] == 5
    assert budgets == sorted(budgets, reverse=True)
    assert all(0 < theirs < ours for ours, theirs in budgets)


def test_the_default_client_waits_for_a_full_queue_as_long_as_its_own_time_allows(refusing: Refusing) -> None:
    policy = client.RetryPolicy()
    steps = ask(
        Request("POST", "/grasps"), grasp_reply, timeout=30, policy=policy, clock=lambda: 0.7, rng=random.Random(0)
    )
    next(steps)
    wait = steps.send(Answer(429, {"retry-after": "24"}, refusing(429).body))
    assert isinstance(wait, Wait)
    assert 24 <= wait.seconds <= 24 + policy.first_delay


def test_a_timeout_ends_the_conversation() -> None:
    steps = ask(
        Request("GET", "/model"),
        grasp_reply,
        timeout=5,
        policy=client.RetryPolicy(),
        clock=lambda: 0.0,
        rng=random.Random(0),
    )
    assert not isinstance(next(steps), Wait)
    with pytest.raises(client.ServiceTimeout):
        steps.send(TimedOut())


@pytest.mark.parametrize(
    ("outcome", "seen"),
    [
        (ConnectionLost("cannot reach it"), "cannot reach it"),
        (Unusable("the answer has over 2 MB", 200), "the answer has over 2 MB"),
        (TimedOut(), "no answer"),
    ],
)
def test_waiting_in_vain_says_what_was_seen_last(refusing: Refusing, outcome: Outcome, seen: str) -> None:
    now = 0.0
    steps = await_ready(timeout=0.3, clock=lambda: now)
    step = next(steps)
    for last in (Answer(503, {}, refusing(503).body), outcome):
        assert isinstance(step, Send)
        assert step.timeout == pytest.approx(0.3 - now)
        now += 0.05
        assert isinstance(steps.send(last), Wait)
        now += 0.05
        step = steps.send(None)
    now += 0.2
    with pytest.raises(client.ServiceTimeout, match=rf"not ready after 0\.3 s: {seen}"):
        steps.send(outcome)


def test_an_unusable_answer_is_not_asked_for_again() -> None:
    policy = client.RetryPolicy()
    steps = ask(
        Request("GET", "/model"), grasp_reply, timeout=5, policy=policy, clock=lambda: 0.0, rng=random.Random(0)
    )
    next(steps)
    with pytest.raises(client.UnexpectedResponse, match="over 2 MB; status 502; check the URL") as caught:
        steps.send(Unusable("the answer has over 2 MB", 502))
    assert caught.value.status == 502


@pytest.mark.parametrize(
    ("left", "told"), [(30, "29.900"), (1.5, "1.400"), (1, "0.900"), (0.5, "0.450"), (0.05, "0.045"), (0.0001, "0.001")]
)
def test_the_service_is_told_a_tenth_of_a_second_less_than_is_left_or_a_tenth_of_little(left: float, told: str) -> None:
    policy = client.RetryPolicy()
    request = Request("POST", "/grasps", b"body", {"Accept": "application/json"})
    step = next(ask(request, grasp_reply, timeout=left, policy=policy, clock=lambda: 0.0, rng=random.Random(0)))
    assert isinstance(step, Send)
    assert step.timeout == left
    assert step.request == Request("POST", "/grasps", b"body", {**request.headers, "X-Request-Timeout": told})


@pytest.mark.parametrize("timeout", [0.05, 3.0, 12.0, 60.0])
@pytest.mark.parametrize("hangs", [False, True])
def test_each_look_at_a_service_that_is_not_ready_takes_no_more_than_its_share(timeout: float, hangs: bool) -> None:
    """One that takes connections and says nothing keeps each look for all of its time."""
    now = 7.0
    steps = await_ready(timeout=timeout, clock=lambda: now)
    step: Send | Wait = next(steps)
    try:
        while True:
            left = 7.0 + timeout - now
            if isinstance(step, Send):
                assert step.timeout == pytest.approx(max(min(left, PROBE_TIMEOUT), POLL_INTERVAL))
                now += step.timeout if hangs else 0.01
            else:
                assert step.seconds == POLL_INTERVAL < left
                now += step.seconds
            step = steps.send(TimedOut() if isinstance(step, Send) else None)
    except client.ServiceTimeout:
        assert 7.0 + timeout - POLL_INTERVAL <= now <= 7.0 + timeout + POLL_INTERVAL


OUTCOMES = st.tuples(
    st.sampled_from(["lost", "unusable", "timed out", "200", "400", "429", "500", "503", "504"]),
    st.sampled_from([None, 0, 1, 4]),
    st.floats(0, 3),
)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(OUTCOMES, min_size=6, max_size=6), st.integers(0, 4), st.floats(0.1, 9))
def test_a_conversation_is_what_its_rules_say_of_any_outcomes(
    refusing: Refusing, script: list[tuple[str, int | None, float]], retries: int, timeout: float
) -> None:
    """Against a second telling: what is lost or overloaded is sent again while tries and time are left."""
    now = 100.0
    policy = client.RetryPolicy(max_retries=retries, first_delay=0.1, max_delay=0.3)
    twin = random.Random(5)
    steps = ask(
        Request("GET", "/model"),
        lambda answer: answer.status,
        timeout=timeout,
        policy=policy,
        clock=lambda: now,
        rng=random.Random(5),
    )
    step: Send | Wait = next(steps)
    ended: object = None
    raised: client.GraspClientError | None = None
    expected: object
    for tries, (kind, retry_after, seconds) in enumerate(script):
        assert isinstance(step, Send)
        assert step.timeout == pytest.approx(100.0 + timeout - now)
        now += seconds
        outcome: Outcome
        if kind == "lost":
            outcome, expected = ConnectionLost("gone"), client.ServiceUnreachable
        elif kind == "unusable":
            outcome, expected = Unusable("odd", 200), client.UnexpectedResponse
        elif kind == "timed out":
            outcome, expected = TimedOut(), client.ServiceTimeout
        else:
            headers = {} if retry_after is None else {"retry-after": str(retry_after)}
            outcome = Answer(int(kind), headers, refusing(int(kind)).body)
            expected = 200 if kind == "200" else client.errors.problem_class(int(kind))
        wait = None
        if kind in ("lost", "429", "503"):
            asked = None if kind == "lost" else retry_after
            wait = policy.delay(tries, 100.0 + timeout - now, twin.random(), asked)
        try:
            step = steps.send(outcome)
        except StopIteration as end:
            ended = end.value
        except client.GraspClientError as error:
            ended, raised = type(error), error
        if wait is None:
            assert ended == expected
            assert not isinstance(raised, client.Overloaded) or raised.retry_after == retry_after
            return
        assert step == Wait(wait)
        now += wait
        step = steps.send(None)


@pytest.mark.parametrize(
    ("outcome", "is_there"),
    [
        (Answer(200, {}, b""), True),
        (Answer(204, {}, b""), False),
        (Answer(503, {}, b""), False),
        (ConnectionLost("gone"), False),
        (TimedOut(), False),
        (Unusable("odd", 200), False),
    ],
)
def test_a_look_is_one_try_that_says_yes_to_a_200_alone(outcome: Outcome, is_there: bool) -> None:
    steps = look("/health/live", timeout=3.0)
    assert next(steps) == Send(Request("GET", "/health/live"), 3.0)
    with pytest.raises(StopIteration) as ended:
        steps.send(outcome)
    assert ended.value.value is is_there


@pytest.mark.parametrize(("status", "words"), [(503, "503 A title: A detail."), (502, "status 502 without a problem")])
def test_waiting_in_vain_tells_the_words_of_the_service_or_of_a_proxy(
    refusing: Refusing, status: int, words: str
) -> None:
    now = 0.0
    steps = await_ready(timeout=0.3, clock=lambda: now)
    next(steps)
    now = 0.25
    with pytest.raises(client.ServiceTimeout, match=f"not ready after 0.3 s: {words}"):
        steps.send(Answer(status, {}, refusing(503).body if status == 503 else b"bad gateway"))
