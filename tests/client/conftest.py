"""A real HTTP server that answers by script, and the answers of the grasp service to put in it."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, cast

import numpy as np
import pytest

from client import AsyncGraspClient, GraspClient
from service import schemas
from tesnet.geometry import Pose
from tests.conftest import PATIENCE_S


@dataclass(frozen=True)
class Answering:
    """Answer with a status, headers and a body."""

    status: int
    body: bytes = b""
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Reset:
    """Reset the connection in place of an answer."""


@dataclass(frozen=True)
class Stall:
    """Send the first bytes of an answer's body (none: not even its headers), then nothing until the server ends."""

    first: bytes = b""


@dataclass(frozen=True)
class Received:
    """One request as it came."""

    method: str
    target: str
    headers: Mapping[str, str]
    body: bytes


class ScriptedServer(ThreadingHTTPServer):
    """Does the script's steps, one a request; the last step is repeated."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.script: list[Answering | Reset | Stall] = []
        self.received: list[Received] = []
        self.ended = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except ConnectionError:  # the client gave up, as the script provoked
            self.close_connection = True

    def do_GET(self) -> None:
        server = cast("ScriptedServer", self.server)
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        headers = {name.lower(): value for name, value in self.headers.items()}
        step = server.script[min(len(server.received), len(server.script) - 1)]
        server.received.append(Received(self.command, self.path, headers, body))
        if isinstance(step, Reset):
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.close_connection = True
        elif isinstance(step, Stall):
            if step.first:
                self.send_response(200)
                self.send_header("Content-Length", "1000")
                self.end_headers()
                self.wfile.write(step.first)
                self.wfile.flush()
            server.ended.wait()
            self.close_connection = True
        else:
            self.send_response(step.status)
            for name, value in step.headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(step.body)))
            self.end_headers()
            self.wfile.write(step.body)

    do_POST = do_GET

    def log_message(self, *args: Any) -> None:
        """Say nothing."""


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    """A server on a free loopback port whose `script` the test fills."""
    scripted = ScriptedServer()
    thread = threading.Thread(target=scripted.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield scripted
    scripted.ended.set()
    scripted.shutdown()
    scripted.server_close()
    thread.join()


@dataclass
class Peer:
    """A server whose connections behave as the test says; `hung_up` counts those that clients closed early."""

    url: str
    connections: int = 0
    hung_up: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))


@pytest.fixture
def start_peer() -> Iterator[Callable[[Callable[[socket.socket], None]], Peer]]:
    """`start_peer(behave)`: a `Peer` on a free loopback port that hands each connection to `behave`."""
    listeners: list[socket.socket] = []

    def start(behave: Callable[[socket.socket], None]) -> Peer:
        listener = socket.create_server(("127.0.0.1", 0))
        listeners.append(listener)
        peer = Peer(f"http://127.0.0.1:{listener.getsockname()[1]}")

        def serve(connection: socket.socket) -> None:
            with connection:
                try:
                    behave(connection)
                except OSError:
                    peer.hung_up.release()

        def accept() -> None:
            with suppress(OSError):  # the listener was closed: the test is over
                while True:
                    connection, _ = listener.accept()
                    peer.connections += 1
                    threading.Thread(target=serve, args=(connection,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        return peer

    yield start
    for listener in listeners:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


@pytest.fixture
def closed_url() -> str:
    """A loopback URL where nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


Call = Callable[..., Any]


@pytest.fixture(params=["sync", "async"])
def call(request: pytest.FixtureRequest) -> Call:
    """`call(url, method, *arguments, client={...}, **options)`: one method of either client, patient unless told
    otherwise, which is closed after."""

    def of_sync(url: str, method: str, *arguments: Any, client: Mapping[str, Any] | None = None, **options: Any) -> Any:
        with GraspClient(url, **{"timeout": PATIENCE_S, **(client or {})}) as opened:
            return getattr(opened, method)(*arguments, **options)

    def of_async(
        url: str, method: str, *arguments: Any, client: Mapping[str, Any] | None = None, **options: Any
    ) -> Any:
        async def go() -> Any:
            async with AsyncGraspClient(url, **{"timeout": PATIENCE_S, **(client or {})}) as opened:
                awaitable: Awaitable[Any] = getattr(opened, method)(*arguments, **options)
                return await awaitable

        return asyncio.run(go())

    return of_sync if request.param == "sync" else of_async


@pytest.fixture
def points() -> np.ndarray[Any, np.dtype[np.float32]]:
    """A small cloud (200, 3), metres."""
    return np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3)).astype(np.float32)


@pytest.fixture
def found() -> dict[str, Any]:
    """The service's document with three grasps."""
    return document(3)


@pytest.fixture
def nothing_found() -> dict[str, Any]:
    """The service's document without grasps."""
    return document(0)


@pytest.fixture
def refusing() -> Callable[..., Answering]:
    """`refusing(status, retry_after=None)`: the service's problem document."""

    def refuse(status: int, retry_after: str | None = None) -> Answering:
        problem = schemas.Problem(
            type="urn:tes-net:problem:test", title="A title", status=status, detail="A detail.", request_id="r-1"
        )
        headers = {"Content-Type": "application/problem+json"} | ({"Retry-After": retry_after} if retry_after else {})
        return Answering(status, problem.model_dump_json().encode(), headers)

    return refuse


def answering(content: Mapping[str, Any]) -> Answering:
    """A 200 with a JSON document."""
    return Answering(200, json.dumps(content).encode(), {"Content-Type": "application/json"})


def document(size: int) -> dict[str, Any]:
    """The service's answer with `size` grasps, made by the service's own schema."""
    rng = np.random.default_rng(size)
    grasps = []
    for rank in range(size):
        pose = Pose.random(rng, reach=0.3)
        hand = pose @ Pose(np.eye(3), np.array([0.0, 0.0, -0.1034]))
        pregrasp = pose @ Pose(np.eye(3), np.array([0.0, 0.0, -0.05]))
        outs = [
            schemas.PoseOut.model_validate(
                {"position": p.translation.tolist(), "quaternion_xyzw": p.quaternion_xyzw.tolist()}
            )
            for p in (pose, hand, pregrasp)
        ]
        grasps.append(
            {
                "score": 0.9 - 0.1 * rank,
                **outs[0].model_dump(),
                "matrix": pose.matrix.tolist(),
                "hand_pose": outs[1].model_dump(),
                "pregrasp": outs[2].model_dump(),
                "width": 0.08,
                "approach_point": rng.uniform(-0.3, 0.3, 3).tolist(),
                "contact_point": rng.uniform(-0.3, 0.3, 3).tolist(),
            }
        )
    response = schemas.GraspResponse.model_validate(
        {
            "grasps": grasps,
            "frame": "cloud",
            "model": {"name": "tesnet", "version": "1", "weights_sha256": "ab" * 32},
            "counts": {
                "points": 200,
                "prepared_points": 150,
                "candidates": 90,
                "collision_free": 40,
                "returned": size,
                "rejected": dict.fromkeys(schemas.RejectedOut.model_fields, 7),
            },
            "reason": None if size else "all_in_collision",
            "warnings": ["`up` is missing."],
            "timings_ms": dict.fromkeys(schemas.TimingsOut.model_fields, 1.5),
            "request_id": "r-1",
        }
    )
    return response.model_dump(mode="json")


def model_document() -> dict[str, Any]:
    """The service's answer at `/model`."""
    return {
        "models": [
            {"name": "tesnet", "version": "1", "weights_sha256": "ab" * 32, "card": {"seed": 0}, "configuration": {}}
        ],
        "gripper": {**dict.fromkeys(schemas.GripperOut.model_fields, 0.08), "name": "franka", "parts": []},
        "frame_conventions": ["panda", "graspnet"],
        "content_types": ["application/octet-stream"],
        "limits": dict.fromkeys(schemas.LimitsOut.model_fields, 1000),
        "device": "cpu",
    }
