"""Around every request: its id and its log line."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from starlette.types import Message, Receive, Scope, Send

from service import middleware
from service.memory import Memory
from service.metrics import Metrics
from service.middleware import LOGGED_METHOD, LOGGED_PATH, RequestMiddleware


def test_the_request_id_comes_back_or_is_made_up(http: httpx.Client) -> None:
    given = http.get("/health/live", headers={"X-Request-ID": "robot-7/cell:3"})
    assert given.headers["X-Request-ID"] == "robot-7/cell:3"
    for unfit in ("with space", "a" * 129, 'quote"'):
        made_up = http.get("/health/live", headers={"X-Request-ID": unfit}).headers["X-Request-ID"]
        assert made_up.isalnum()
        assert made_up != http.get("/health/live").headers["X-Request-ID"]


def test_one_log_line_a_request_tells_what_happened(
    http: httpx.Client, shared_service: Any, cloud: NDArray[np.float32]
) -> None:
    http.post(
        "/grasps?max_candidates=100",
        content=cloud.tobytes(),
        headers={"Content-Type": "application/octet-stream", "X-Request-ID": "logged-1"},
    )
    line = shared_service.wait_for("request", request_id="logged-1")
    assert (line["method"], line["path"], line["status"]) == ("POST", "/grasps", 200)
    assert (line["points"], line["bytes_in"]) == (len(cloud), 12 * len(cloud))
    assert line["timings_ms"]["total"] <= line["duration_ms"]
    assert sum(other.get("request_id") == "logged-1" for other in shared_service.lines) == 1


def test_a_log_line_repeats_little_of_what_a_client_makes_up(http: httpx.Client, shared_service: Any) -> None:
    path = "/" + "a" * 60_000
    assert http.request("B" * 50, path, headers={"X-Request-ID": "long-1"}).status_code == 404
    line = shared_service.wait_for("request", request_id="long-1")
    assert (len(line["path"]), line["path"][:100]) == (LOGGED_PATH, path[:100])
    assert (len(line["method"]), line["method"][0]) == (LOGGED_METHOD, "B")
    assert len(json.dumps(line)) < 1000


class Asked:
    """One request to a `RequestMiddleware` around `app`, whose body comes in pieces; and what became of it."""

    def __init__(self, app: Any, headers: dict[str, str], pieces: list[bytes], method: str = "POST") -> None:
        self.memory, self.metrics = Memory(1e6), Metrics()
        self.sent: list[Message] = []
        self.left = [
            {"type": "http.request", "body": piece, "more_body": number + 1 < len(pieces)}
            for number, piece in enumerate(pieces)
        ]
        raw = [(name.encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "method": method, "path": "/grasps", "headers": raw, "query_string": b""}
        asyncio.run(RequestMiddleware(app, self.metrics, self.memory)(scope, self.receive, self.send))

    async def receive(self) -> Message:
        return self.left.pop(0) if self.left else {"type": "http.disconnect"}

    async def send(self, message: Message) -> None:
        self.sent.append(message)

    @property
    def status(self) -> int:
        return int(self.sent[0]["status"])

    @property
    def headers(self) -> dict[str, str]:
        return {name.decode(): value.decode() for name, value in self.sent[0]["headers"]}

    @property
    def body(self) -> bytes:
        return b"".join(message.get("body", b"") for message in self.sent[1:])

    def counted(self) -> list[str]:
        """What the metrics have of it: method, route and status."""
        lines = self.metrics.text().decode().splitlines()
        return [line for line in lines if line.startswith("grasp_requests_total")]


def answering(reads: int) -> Any:
    """An application that reads so many pieces of the body and answers."""

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        scope["state"]["record"].share.resize(1000)
        for _ in range(reads):
            await receive()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"a", "more_body": True})
        await send({"type": "http.response.body", "body": b"b"})

    return app


@pytest.mark.parametrize("reads", range(4))
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"content-length": "0"},
        {"content-length": "3"},
        {"transfer-encoding": "chunked"},
        {"transfer-encoding": "chunked", "content-length": "3"},
        {"transfer-encoding": "chunked", "content-length": "0"},
    ],
)
def test_a_connection_is_kept_where_its_body_was_read_and_had_one_length_alone(
    headers: dict[str, str], reads: int
) -> None:
    """What others on the way may read differently is an answer, and then no connection for another request."""
    has_body = headers not in ({}, {"content-length": "0"})
    pieces = [b"x", b"y", b"z"] if has_body else [b""]
    asked = Asked(answering(reads), headers, pieces)
    is_whole = not has_body or reads == 3
    is_ambiguous = len(headers) == 2
    assert (asked.headers.get("connection") == "close") == (is_ambiguous or not is_whole)
    assert (asked.status, asked.body) == (200, b"ab")
    assert [message.get("more_body", False) for message in asked.sent[1:]][-1] is False
    if has_body:
        assert asked.left == []  # read and forgotten, so that the answer arrives
    assert asked.memory.held == 0
    assert asked.counted() == ['grasp_requests_total{method="POST",route="other",status="200"} 1.0']


@pytest.mark.parametrize("expects", [False, True])
@pytest.mark.parametrize("reads", [0, 1])
def test_who_waits_to_be_asked_for_the_rest_is_not_heard_unless_it_was(expects: bool, reads: int) -> None:
    headers = {"content-length": "3"} | ({"expect": "100-continue"} if expects else {})
    asked = Asked(answering(reads), headers, [b"x", b"y", b"z"])
    assert len(asked.left) == (3 if expects and not reads else 0)


def test_no_more_than_its_limit_is_read_and_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middleware, "LINGER_BYTES", 5)
    asked = Asked(answering(1), {"content-length": "20"}, [b"xx"] * 10)
    assert len(asked.left) == 10 - 1 - 3
    assert asked.body == b"ab"


@pytest.mark.parametrize(("method", "counted"), [("GET", "GET"), ("DELETE", "DELETE"), ("BREW", "other")])
def test_a_fault_is_answered_as_one_and_what_it_held_is_forgotten(
    method: str, counted: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        scope["state"]["record"].share.resize(1000)
        raise RuntimeError("a secret")

    asked = Asked(app, {"x-request-id": "robot-7"}, [b""], method)
    assert asked.status == 500
    assert asked.headers["x-request-id"] == json.loads(asked.body)["request_id"] == "robot-7"
    assert b"secret" not in asked.body
    assert asked.memory.held == 0
    assert asked.counted() == [f'grasp_requests_total{{method="{counted}",route="other",status="500"}} 1.0']


@pytest.mark.parametrize("begun", [False, True])
def test_a_request_that_the_end_of_the_service_meets_is_told_to_come_again(begun: bool) -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        if begun:
            await send({"type": "http.response.start", "status": 200, "headers": []})
        raise asyncio.CancelledError

    asked = Asked(app, {"content-length": "3", "x-request-id": "robot-7"}, [b"x", b"y", b"z"])
    if begun:
        assert [message["type"] for message in asked.sent] == ["http.response.start"]
        return
    assert asked.status == json.loads(asked.body)["status"] == 503
    told = {name: asked.headers[name] for name in ("connection", "x-request-id", "retry-after")}
    assert told == {"connection": "close", "x-request-id": "robot-7", "retry-after": "1"}
    assert len(asked.left) == 3
