"""What the harness's tests share: a stand-in for the service, and runs to report about."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.play.records import AttemptRecord, Latency, NoGraspRecord, RoundEnd, RoundRecord, Run
from simharness.play.round import play_round
from simharness.play.settings import RunSettings
from simharness.sim.objects import ObjectModel, load_object_set
from tests.simharness.commands import WAIT_S, run_it
from tests.simharness.planners import TopDown
from tests.simharness.recorded import MODEL, SERVING

STUB = Path(__file__).with_name("stub_service.py")

MakeSettings = Callable[..., RunSettings]
MakeRound = Callable[..., RoundRecord]
StartStub = Callable[..., str]


@pytest.fixture(scope="session")
def stub_command() -> tuple[str, ...]:
    """What starts the stand-in in place of `python -m service`."""
    return (sys.executable, str(STUB))


@pytest.fixture
def start_stub() -> Iterator[StartStub]:
    """Start a stand-in service; its URL. It ends with the test."""
    with ExitStack() as stack:
        yield lambda *options: stack.enter_context(_stub(options))


@contextmanager
def _stub(options: tuple[str, ...]) -> Iterator[str]:
    process = subprocess.Popen([sys.executable, str(STUB), *options], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait(WAIT_S)
        process.stdout.close()


@pytest.fixture(scope="session")
def make_settings() -> MakeSettings:
    """Settings of a small run, with changes."""

    def make(**changes: Any) -> RunSettings:
        values: dict[str, Any] = {
            "rounds": 2,
            "seeds": (0,),
            "scene": "packed",
            "objects": "procedural",
            "exclude": None,
            "only": None,
            "camera": "random",
            "noise_std": None,
            "depth_noise_std": None,
            "executor": "edge",
            "model": "tesnet",
            "max_grasps": 1,
        }
        return RunSettings(**{**values, **changes})

    return make


@pytest.fixture(scope="session")
def make_round() -> MakeRound:
    """A round with attempts of given outcomes: `make_round(0, 3, ["success", "slip"])`."""

    def make(
        seed: int, number: int, outcomes: list[Any], no_grasps: tuple[str, ...] = (), ended: RoundEnd = "empty"
    ) -> RoundRecord:
        objects = tuple(f"set/thing_{index}" for index in range(5))
        attempts = tuple(
            AttemptRecord(
                seed=seed,
                round=number,
                attempt=index,
                observation=index,
                request_seed=7,
                viewpoints=((0.1, 0.2, 0.7),),
                T_world_grasp=np.eye(4),
                width=0.08,
                score=0.9,
                outcome=outcome,
                grasped=(objects[index],) if outcome == "success" else (),
                objects=objects,
                contact_at_start=False,
                contact_on_way=False,
                counts={"points": 100},
                latency=Latency(service=10.0 + index, round_trip=12.0 + index),
            )
            for index, outcome in enumerate(outcomes)
        )
        observations = range(len(outcomes), len(outcomes) + len(no_grasps))
        empty = tuple(
            NoGraspRecord(observation, reason, {}, None)
            for observation, reason in zip(observations, no_grasps, strict=True)
        )
        return RoundRecord(seed, number, objects, ended, attempts, empty)

    return make


@pytest.fixture
def run(make_settings: Any, make_round: Any) -> Run:
    """A finished run of two seeds, with every way to end a round."""
    rounds = (
        make_round(0, 0, ["success"] * 5),
        make_round(0, 1, ["slip", "drop"], ("no_candidates",), "two_failures"),
        make_round(1, 0, ["success", "approach", "success"]),
        make_round(1, 1, [], ("no_candidates",) * 3, "no_grasps"),
    )
    return Run(make_settings(seeds=(0, 1)), 2, MODEL, SERVING, rounds, None)


@pytest.fixture(scope="module")
def objects() -> tuple[ObjectModel, ...]:
    """The test objects of packed scenes."""
    return load_object_set("procedural", "packed")


@pytest.fixture(scope="module")
def played(objects: tuple[ObjectModel, ...], make_settings: Any) -> RoundRecord:
    """A round of a planner that is right most of the time."""
    return play_round(make_settings(), objects, TopDown(), 0, 1)


@pytest.fixture(scope="module")
def two_rounds(tmp_path_factory: pytest.TempPathFactory, stub_command: tuple[str, ...]) -> Path:
    """A finished run of two rounds by one worker."""
    out = tmp_path_factory.mktemp("run") / "out"
    stub = subprocess.Popen(stub_command, stdout=subprocess.PIPE, text=True)
    assert stub.stdout is not None
    try:
        done = run_it("--rounds", 2, "--url", stub.stdout.readline().strip(), "--workers", 1, "--out", out)
    finally:
        stub.terminate()
        stub.communicate()
    assert done.returncode == 0, done.stderr
    (out.parent / "stdout").write_text(done.stdout)
    (out.parent / "stderr").write_text(done.stderr)
    return out
