import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tesnet.errors import GaveUp
from tesnet.threads import FREE, LONGEST_PAUSE, STRETCH_S, Threads, idle_seconds


class Machine:
    """Clocks of a machine on which some other processes compute without pause.

    Where threads share cores with them, all are kept waiting; so much of a core each has."""

    def __init__(self, cores: int, tells_idle: bool = True) -> None:
        self.cores, self.neighbours, self.tells_idle = cores, 0, tells_idle
        self.seconds = self.computed = self.idled = 0.0

    def threads(self, most: int) -> Threads:
        return Threads(most, lambda: self.seconds, lambda: self.computed, self._idle)

    def work(self, threads: Threads, seconds: float = 2 * STRETCH_S) -> int:
        """One piece of work; with how many threads it was done."""
        with threads.working():
            used = torch.get_num_threads()
            wanted = used + self.neighbours
            self.seconds += seconds
            self.computed += seconds * min(1.0, self.cores / wanted)
            self.idled += seconds * max(0, self.cores - wanted)
        return used

    def _idle(self) -> float:
        return self.idled if self.tells_idle else math.nan


@pytest.fixture(autouse=True)
def _torch_keeps_its_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("most", [1, 2, 8])
def test_free_cores_are_all_used(most: int) -> None:
    machine = Machine(8)
    threads = machine.threads(most)
    assert {machine.work(threads) for _ in range(50)} == {most}


@pytest.mark.parametrize("tells_idle", [True, False])
def test_beside_busy_neighbours_one_thread_computes_and_later_all_again(tells_idle: bool) -> None:
    machine = Machine(2, tells_idle)
    threads = machine.threads(2)
    machine.neighbours = 2
    assert [machine.work(threads) for _ in range(50)] == [2] + 49 * [1]
    machine.neighbours = 0
    assert [machine.work(threads) for _ in range(5)][-1] == 2


def test_a_neighbour_that_leaves_one_core_to_us_is_left_alone() -> None:
    machine = Machine(2)
    threads = machine.threads(2)
    machine.neighbours = 1
    assert [machine.work(threads) for _ in range(50)] == [2] + 49 * [1]


def test_of_many_cores_those_are_used_that_the_neighbours_leave() -> None:
    machine = Machine(8)
    threads = machine.threads(8)
    machine.neighbours = 3
    assert [machine.work(threads) for _ in range(50)][2:] == 48 * [5]


def test_where_nobody_tells_what_is_idle_trials_become_rare_and_never_end() -> None:
    machine = Machine(2, tells_idle=False)
    threads = machine.threads(2)
    machine.neighbours = 1
    used = [machine.work(threads) for _ in range(10 * LONGEST_PAUSE)]
    trials = [number for number, count in enumerate(used) if count == 2]
    pauses = [later - earlier for earlier, later in itertools.pairwise(trials)]
    assert pauses == sorted(pauses)
    assert pauses[0] <= 3
    assert LONGEST_PAUSE <= pauses[-1] <= LONGEST_PAUSE + 1


def test_a_trial_that_goes_well_makes_the_pauses_short_again() -> None:
    """After long trouble and then a free machine, a moment's trouble is as soon over as the first one was."""
    machine = Machine(2, tells_idle=False)
    threads = machine.threads(2)

    def pieces_with_one_thread() -> int:
        machine.neighbours = 2
        machine.work(threads)
        machine.neighbours = 0
        return sum(machine.work(threads) == 1 for _ in range(3 * LONGEST_PAUSE))

    first = pieces_with_one_thread()
    machine.neighbours = 1
    for _ in range(5 * LONGEST_PAUSE):
        machine.work(threads)
    machine.neighbours = 0
    for _ in range(3 * LONGEST_PAUSE):
        machine.work(threads)
    assert pieces_with_one_thread() == first


def test_short_pieces_are_judged_together() -> None:
    machine = Machine(2)
    threads = machine.threads(2)
    machine.neighbours = 2
    used = [machine.work(threads, 0.3 * STRETCH_S) for _ in range(10)]
    assert used == 4 * [2] + 6 * [1]


def test_work_that_is_given_up_teaches_nothing() -> None:
    machine = Machine(2)
    threads = machine.threads(2)

    def be_given_up() -> None:
        with threads.working():
            machine.seconds += 1
            raise GaveUp

    with pytest.raises(GaveUp):
        be_given_up()
    assert threads.number == 2


def test_torchs_own_number_is_the_most_unless_another_is_wanted() -> None:
    torch.set_num_threads(3)
    assert Threads().most == 3
    assert Threads(2).most == 2


def test_idle_seconds_are_those_of_the_cores_that_this_process_may_use(tmp_path: Path) -> None:
    ours = min(os.sched_getaffinity(0))
    other = max(os.sched_getaffinity(0)) + 1
    statistics = tmp_path / "stat"
    statistics.write_text(
        f"cpu 1 1 1 9999 1 0 0 0 0 0\ncpu{ours} 1 1 1 250 1 0 0 0 0 0\ncpu{other} 1 1 1 700 1 0 0 0 0 0\nintr 1 2\n"
    )
    assert idle_seconds(statistics) == 2.5
    assert math.isnan(idle_seconds(tmp_path / "missing"))
    assert 0 <= idle_seconds() <= idle_seconds()


def test_a_core_is_not_shared_at_a_moments_disturbance() -> None:
    machine = Machine(2)
    threads = machine.threads(2)
    with threads.working():
        machine.seconds += 1.0
        machine.computed += 1.01 * FREE
    assert threads.number == 2
