"""What is held for all requests together, as a value."""

from __future__ import annotations

from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import QueueFull
from service.memory import Memory, Share


def test_a_lone_request_may_hold_more_than_the_limit_and_another_may_not() -> None:
    memory = Memory(100)
    with memory.share() as lone, memory.share() as other:
        lone.resize(500)
        with pytest.raises(QueueFull, match="limit"):
            other.resize(1)
        lone.resize(90)
        other.resize(10)
        with pytest.raises(QueueFull):
            other.resize(11)
        other.resize(5)  # less is never refused
    assert memory.held == 0


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 120)), max_size=60))
def test_what_is_held_is_the_sum_of_the_shares(resizes: list[tuple[int, int]]) -> None:
    memory = Memory(100)
    shares = [memory.share() for _ in range(6)]
    for number, size in resizes:
        try:
            shares[number].resize(size)
        except QueueFull:
            assert size > shares[number].size
        assert memory.held == sum(share.size for share in shares)
        assert memory.held <= 100 or max(share.size for share in shares) > 100 - memory.held + 100
    for share in shares:
        share.release()
    assert memory.held == 0


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 60)), max_size=60))
def test_over_the_limit_what_lies_there_the_longest_goes_first(events: list[tuple[int, int]]) -> None:
    memory = Memory(100)
    shares = [memory.share() for _ in range(6)]
    lying: list[Share] = []
    closed: list[Share] = []
    for number, size in events:
        share = shares[number]
        if share in lying and size == 0:
            lying.remove(share)
        elif share not in lying and size:
            lying.append(share)
        memory.keep_lying(share, size, partial(closed.append, share))
        while closed:
            assert closed.pop(0) is lying.pop(0)
        assert memory.held == sum(one.size for one in lying) <= 100


def test_what_lies_there_gives_way_to_a_request() -> None:
    memory = Memory(100)
    lying, request = memory.share(), memory.share()
    closed: list[str] = []
    memory.keep_lying(lying, 90, lambda: closed.append("closed"))
    request.resize(10)
    assert closed == []
    request.resize(20)
    assert (closed, memory.held) == (["closed"], 20)


def test_what_lies_there_alone_may_be_of_any_size_until_something_else_is_held() -> None:
    memory = Memory(100)
    lone, other = memory.share(), memory.share()
    closed: list[str] = []
    memory.keep_lying(lone, 900, lambda: closed.append("lone"))
    assert (closed, memory.held) == ([], 900)
    memory.keep_lying(other, 5, lambda: closed.append("other"))
    assert (closed, memory.held) == (["lone"], 5)
