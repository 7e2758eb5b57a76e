"""Requests as the tests of the service send them, and what holds for every problem that it answers."""

from __future__ import annotations

import io
import json
import socket
import urllib.parse
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from service.schemas import Problem
from tests.conftest import PATIENCE_S

OCTETS = {"Content-Type": "application/octet-stream"}
POINTS = np.zeros((20, 3), np.float32).tobytes()
"""A body of 20 points."""


def post(url: str, seed: int = 0, **headers: str) -> httpx.Response:
    """The answer to a cloud of 20 points; `X_Request_Timeout="1"` is a header."""
    renamed = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.post(f"{url}/grasps?seed={seed}", content=POINTS, headers={**OCTETS, **renamed}, timeout=PATIENCE_S)


def connect(url: str) -> socket.socket:
    """A connection on which nothing was sent."""
    parts = urllib.parse.urlsplit(url)
    return socket.create_connection((parts.hostname or "", parts.port or 0), timeout=PATIENCE_S)


def post_head(url: str, path: str = "/grasps", length: int = len(POINTS), headers: str | None = None) -> socket.socket:
    """A connection on which the head of a POST was sent, and nothing of its body."""
    connection = connect(url)
    more = headers or f"Content-Length: {length}"
    connection.sendall(
        f"POST {path} HTTP/1.1\r\nHost: test\r\nContent-Type: application/octet-stream\r\n{more}\r\n\r\n".encode()
    )
    return connection


def status_of(connection: socket.socket) -> int:
    """The status of the answer that comes next, whose head is read to its end however it is cut into packets."""
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        part = connection.recv(1)
        assert part, head
        head += part
    return int(head.split()[1])


def npy(array: NDArray[Any], **options: Any) -> bytes:
    """The content of a .npy file."""
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def url_options(options: dict[str, Any]) -> str:
    """Options as a query string."""
    plain = {key: value if isinstance(value, str) else json.dumps(value) for key, value in options.items()}
    return urllib.parse.urlencode(plain)


def post_octets(http: httpx.Client, cloud: NDArray[np.float32], **options: Any) -> dict[str, Any]:
    """The document that answers a cloud."""
    answer = http.post(f"/grasps?{url_options(options)}", content=cloud.astype("<f4").tobytes(), headers=OCTETS)
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = answer.json()
    return document


def problem_of(answer: httpx.Response, status: int, *words: str) -> Problem:
    """The problem document, after checking what holds for every one of them."""
    assert answer.status_code == status, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    problem = Problem.model_validate(answer.json(), extra="forbid", strict=True)
    assert problem.status == status
    assert problem.type.startswith("urn:tes-net:problem:")
    assert problem.request_id == answer.headers["X-Request-ID"]
    assert "Traceback" not in answer.text
    assert len(answer.text) < 2000
    for word in words:
        assert word in problem.detail, problem.detail
    return problem
