from __future__ import annotations

import pickle

import pytest

from simharness.errors import LoadError, ObjectSetError, RunBroken, SimError, UsageError


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (LoadError("box.urdf", "no such file"), "box.urdf: no such file"),
        (ObjectSetError("set x", "holds nothing", "name another"), "set x: holds nothing; name another"),
        (UsageError("--resume needs --out"), "--resume needs --out"),
        (RunBroken("the service ended"), "the service ended"),
    ],
)
def test_every_error_is_the_packages_own_and_says_all_it_knows(error: SimError, message: str) -> None:
    assert isinstance(error, SimError)
    assert str(error) == message


def test_what_broke_a_run_can_be_told_from_another_process() -> None:
    again = pickle.loads(pickle.dumps(RunBroken("a worker ended")))
    assert (type(again), str(again)) == (RunBroken, "a worker ended")
