from __future__ import annotations

import pickle

import pytest

from simharness.errors import LoadError, MissingExtra, ObjectSetError, RunBroken, SimError, UsageError, from_extra


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


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'open3d'"), OSError("libGL.so.1: cannot open")])
def test_a_library_that_cannot_be_loaded_names_the_extra_that_brings_it(error: Exception) -> None:
    with (
        pytest.raises(MissingExtra, match=rf"a camera needs the extra `fusion`: {error}; pip install -e '.\[fusion\]'"),
        from_extra("fusion", "a camera needs"),
    ):
        raise error
