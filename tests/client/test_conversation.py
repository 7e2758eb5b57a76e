"""The conversation itself, with a clock in the test's hand: no network and no waiting."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

import client
from client.conversation import ConnectionLost, Outcome, Send, TimedOut, Unusable, Wait, ask, await_ready
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
