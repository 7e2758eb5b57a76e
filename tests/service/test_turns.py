"""The order in which those are served that wait, as a value: no threads, and time stands still."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.turns import INTERRUPTED_FROM, Job, Turns
from tesnet.query import GraspQuery

QUERY = GraspQuery(np.zeros((4, 3), np.float32))
seconds = st.floats(0.001, 60)


def job(expected: float, deadline: float = math.inf, client: str | None = None) -> Job:
    return Job(QUERY, expected, deadline, client=client, submitted=0.0)


def test_the_cheapest_goes_first_and_equals_in_order_of_arrival() -> None:
    turns = Turns(places=8)
    dear, first, second = job(8.0), job(1.0), job(1.1)
    for one in (dear, first, second):
        turns.add(one, busy=0.0)
    assert [turns.take() for _ in range(4)] == [first, second, dear, None]


def test_whoever_is_passed_for_as_long_as_it_would_have_taken_is_due() -> None:
    turns = Turns(places=8)
    dear = job(8.0)
    turns.add(dear, busy=2.0)
    taken = []
    for _ in range(11):
        turns.add(job(1.0), busy=0.0)
        taken.append(turns.take())
    # Passed for the 2 s that it would have waited and the 8 s of its own.
    assert [one is dear for one in taken] == [False] * 10 + [True]


def test_whoever_is_due_is_ahead_of_a_cheaper_one_and_others_that_are_dearer_are_not() -> None:
    turns = Turns(places=8)
    turns.add(job(8.0, deadline=8.0), busy=0.0)  # nothing to spare: due from the start
    turns.add(job(4.0), busy=0.0)
    turns.add(job(1.0), busy=0.0)
    cheap = job(1.0)
    ahead = turns.ahead_of(cheap)
    turns.add(cheap, busy=0.0)
    order = [taken.expected for _ in range(3) if (taken := turns.take()) is not None]
    assert order == [8.0, 1.0, 1.0]
    assert cheap not in turns
    assert ahead == sum(order[:2])


@given(seconds, seconds, st.floats(0.0, 500.0), st.floats(0.0, 500.0), st.lists(seconds, max_size=5))
def test_what_a_job_may_be_passed_for_is_what_its_wait_and_its_deadlines_leave(
    expected: float, busy: float, deadline: float, begin_by: float, waiting: list[float]
) -> None:
    turns = Turns(places=8)
    for other in waiting:
        turns.add(job(other), busy=busy)
    asked = Job(QUERY, expected, deadline, begin_by, submitted=3.0)
    turns.add(asked, busy=busy)
    in_order = busy + sum(waiting)
    # Where it begins last of all, it still begins by `begin_by` and ends by its deadline.
    limits = (in_order + expected, begin_by - 3.0 - in_order, deadline - 3.0 - in_order - expected)
    assert asked.spare == pytest.approx(max(0.0, min(limits)), abs=1e-9)


def test_a_deadline_leaves_less_to_spare() -> None:
    turns = Turns(places=8)
    dear = job(8.0, deadline=13.0)
    turns.add(dear, busy=2.0)
    for _ in range(3):
        turns.add(job(1.0), busy=0.0)
        assert turns.take() is not dear
    turns.add(job(1.0), busy=0.0)
    assert turns.take() is dear


@given(st.lists(st.tuples(st.booleans(), seconds), max_size=60))
def test_nobody_waits_much_more_than_twice_as_long_as_in_order_of_arrival(events: list[tuple[bool, float]]) -> None:
    turns = Turns(places=100)
    clock = 0.0
    in_order: dict[Job, float] = {}
    longest = max((expected for _, expected in events), default=0.0)

    def serve() -> None:
        nonlocal clock
        taken = turns.take()
        assert taken is not None
        assert clock <= 2 * (in_order[taken] + taken.expected) + longest + 1e-6
        clock += taken.expected

    for served, expected in events:
        if served and len(turns):
            serve()
        one = Job(QUERY, expected, submitted=clock)
        in_order[one] = clock + turns.expected
        turns.add(one, busy=0.0)
    for _ in range(len(turns)):
        serve()
    assert len(turns) == 0


def test_a_cheap_one_may_interrupt_a_dear_one_while_nobody_is_due() -> None:
    turns = Turns(places=8)
    running = job(8.0)
    turns.add(running, busy=0.0)
    assert turns.take() is running
    turns.add(job(8.0 / INTERRUPTED_FROM + 0.1), busy=8.0)
    assert turns.take_between(running) is None
    for _ in range(8):
        cheap = job(1.0)
        turns.add(cheap, busy=8.0)
        assert turns.take_between(running) is cheap
    turns.add(job(1.0), busy=8.0)
    assert turns.take_between(running) is None  # the one that runs is due


def test_half_as_dear_is_cheap_enough_to_interrupt() -> None:
    turns = Turns(places=8)
    half = job(0.25)
    turns.add(half, busy=0.5)
    assert turns.take_between(job(0.5)) is half


def test_two_alike_go_in_order_of_arrival_though_they_came_under_other_guesses() -> None:
    turns = Turns(places=8)
    early, cheap, late = job(1.14), Job(GraspQuery(np.zeros((5, 3), np.float32)), 0.8), job(0.5)
    for one in (early, cheap, late):
        turns.add(one, busy=0.0)
    turns.expect(lambda query: {4: 0.5, 5: 0.2}[len(query.points)])
    assert turns.expected == pytest.approx(1.2)
    assert [turns.take() for _ in range(3)] == [cheap, early, late]


def test_cheap_ones_have_spare_places_and_others_do_not() -> None:
    turns = Turns(places=4)
    for _ in range(4):
        assert turns.has_place(job(1.0))
        turns.add(job(1.0), busy=0.0)
    assert not turns.has_place(job(1.0))
    assert turns.has_place(job(0.1))
    turns.add(job(0.1), busy=0.0)
    assert len(turns) == turns.most == 5
    assert not turns.has_place(job(0.1))


def test_places_are_counted_by_client() -> None:
    turns = Turns(places=8, client_places=2)
    jobs = [job(1.0, client="a"), job(1.0, client="a"), job(1.0)]
    for one in jobs:
        turns.add(one, busy=0.0)
    assert (turns.is_full_for("a"), turns.is_full_for("b"), turns.is_full_for(None)) == (True, False, False)
    turns.remove(jobs[0])
    turns.remove(jobs[0])
    assert not turns.is_full_for("a")
    turns.add(job(1.0, client="a"), busy=0.0)
    assert turns.is_full_for("a")
    turns.clear()
    turns.add(job(1.0, client="a"), busy=0.0)
    assert not any(turns.is_full_for(client) for client in ("a", None))


@pytest.mark.parametrize("expected", [1e-6, 0.1, 1.0, 100.0])
def test_twice_as_long_is_one_size_more(expected: float) -> None:
    assert job(2 * expected).size == job(expected).size + 1


@pytest.mark.parametrize(("places", "spare"), [(1, 1), (3, 1), (4, 1), (7, 1), (8, 2), (32, 8)])
def test_a_quarter_of_the_places_is_spare_and_at_least_one(places: int, spare: int) -> None:
    turns = Turns(places)
    for _ in range(places):
        turns.add(job(1.0), busy=0.0)
    while turns.has_place(job(0.01)):
        turns.add(job(0.01), busy=0.0)
    assert len(turns) == turns.most == places + spare
