"""Clouds, clients, and a server in this process whose predictor a test holds by a gate."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn
from numpy.typing import NDArray

from service.app import create_app
from service.grasps import GraspEndpoint
from service.memory import Memory
from service.protocol import PunctualProtocol
from service.settings import Settings
from tesnet.errors import GaveUp
from tesnet.geometry import GraspSet
from tesnet.predictor import GiveUp
from tesnet.query import GraspQuery
from tesnet.result import REJECTIONS, GraspCounts, GraspResult
from tests.conftest import PATIENCE_S

Cloud = NDArray[np.float32]


@pytest.fixture(scope="session")
def cloud() -> Cloud:
    """A box of 4 x 6 x 12 cm on a table, 6,000 points, metres, z up."""
    rng = np.random.default_rng(7)
    size = np.array([0.04, 0.06, 0.12])
    faces = rng.integers(0, 5, 4000)
    box = rng.uniform(-0.5, 0.5, (4000, 3))
    axis, side = faces // 2, np.where(faces % 2 == 0, 0.5, -0.5)
    box[np.arange(4000), axis] = np.where(axis == 2, 0.5, side)
    box = box * size + [0, 0, size[2] / 2]
    table = np.column_stack([rng.uniform(-0.15, 0.15, (2000, 2)), np.zeros(2000)])
    points: Cloud = np.concatenate([box, table]).astype(np.float32)
    points.setflags(write=False)
    return points


@pytest.fixture(scope="session")
def http(service_url: str) -> Iterator[httpx.Client]:
    """An HTTP client of the shared real service."""
    with httpx.Client(base_url=service_url, timeout=PATIENCE_S) as client:
        yield client


@dataclass
class GatedPredictor:
    """A predictor that answers nothing found, when its gate is open; `fault` is raised instead."""

    gate: threading.Event = field(default_factory=threading.Event)
    entered: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    seeds: list[int] = field(default_factory=list)
    fault: Exception | None = None
    batches: list[int] = field(default_factory=list)
    given_up: list[int] = field(default_factory=list)

    device = "cpu"

    @property
    def models(self) -> list[Any]:
        return [_Model()]

    def warm_up(self) -> None:
        pass

    def predict_batch(
        self, queries: Sequence[GraspQuery], give_up: Sequence[GiveUp | None] | None = None
    ) -> list[GraspResult]:
        self.batches.append(len(queries))
        results = [self._predict(query) for query in queries]
        for asked in give_up or ():
            if asked is not None and asked():
                self.given_up.append(self.seeds[-1])
                raise GaveUp
        return results

    def _predict(self, query: GraspQuery) -> GraspResult:
        self.entered.release()
        self.seeds.append(query.seed)
        assert self.gate.wait(PATIENCE_S)
        if self.fault is not None:
            raise self.fault
        counts = GraspCounts(len(query.points), 0, 0, 0, 0, dict.fromkeys(REJECTIONS, 0))
        timings = dict.fromkeys(("prepare", "candidates", "network", "rank"), 0.0)
        return GraspResult(GraspSet.empty(), counts, "no_candidates", (), timings)


@dataclass(frozen=True)
class _Model:
    name: str = "tesnet"
    version: str = "0"
    weights_sha256: str = "0" * 64
    card: dict[str, Any] = field(default_factory=dict)
    configuration: dict[str, Any] = field(default_factory=dict)


@dataclass
class LocalServer:
    """A server in a thread of this process."""

    url: str
    predictor: GatedPredictor
    endpoint: GraspEndpoint
    memory: Memory


@pytest.fixture
def serve() -> Iterator[Callable[..., LocalServer]]:
    """Start a server over a `GatedPredictor`: `serve(queue_size=1)`. At the end gates open and servers stop."""
    started: list[tuple[GatedPredictor, uvicorn.Server, threading.Thread]] = []

    def start(protocol: type[PunctualProtocol] = PunctualProtocol, **settings: Any) -> LocalServer:
        predictor = GatedPredictor()
        ready = threading.Event()
        app = create_app(Settings(**{"request_timeout": PATIENCE_S, **settings}), lambda: predictor, on_ready=ready.set)
        listener = socket.create_server(("127.0.0.1", 0))
        server = uvicorn.Server(
            uvicorn.Config(app, http=protocol.over(app.state.memory), log_config=None, access_log=False, ws="none")
        )
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        started.append((predictor, server, thread))
        assert ready.wait(PATIENCE_S)
        return LocalServer(
            f"http://127.0.0.1:{listener.getsockname()[1]}", predictor, app.state.endpoint, app.state.memory
        )

    yield start
    for predictor, server, thread in started:
        predictor.gate.set()
        server.should_exit = True
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.fixture(scope="session")
def eventually() -> Callable[[Callable[[], bool]], None]:
    """Wait until a condition holds."""

    def wait(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, "the condition never held"
            time.sleep(0.01)

    return wait
