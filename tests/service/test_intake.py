"""Bodies within limits: of one, and of all together."""

from __future__ import annotations

import select
from collections.abc import Callable, Iterator
from typing import Any

import httpx

from tests.conftest import PATIENCE_S
from tests.service.wire import OCTETS, post, post_head, problem_of, status_of

Serve = Callable[..., Any]


Eventually = Callable[[Callable[[], bool]], None]


def test_too_many_bytes_at_once_are_a_429_and_are_forgotten(serve: Serve, eventually: Eventually) -> None:
    server = serve(max_body_mb=1.0, max_held_mb=4.0)
    server.predictor.gate.set()
    uploads = [post_head(server.url, length=2**20) for _ in range(5)]
    for upload in uploads:
        upload.sendall(bytes(2**20 - 1))
    refused = select.select(uploads, [], [], PATIENCE_S)[0][0]  # whichever's bytes came last
    assert status_of(refused) == 429
    for upload in uploads:
        upload.close()
    eventually(lambda: server.endpoint.active == 0 and server.memory.held == 0)
    assert post(server.url).status_code == 200


def test_an_announced_body_above_the_limit_is_a_413_before_it_is_sent(service_url: str) -> None:
    with post_head(service_url, "/grasps", headers="Content-Length: 67108865") as connection:
        assert status_of(connection) == 413


def test_a_client_that_asks_before_sending_is_told_at_once(service_url: str) -> None:
    with post_head(service_url, "/grasps", headers="Content-Length: 67108865\r\nExpect: 100-continue") as connection:
        assert status_of(connection) == 413
        while connection.recv(4096):  # and the connection ends, without a body
            pass


def test_a_chunked_body_above_the_limit_is_a_413_before_it_ends(service_url: str) -> None:
    chunk = b"100000\r\n" + bytes(2**20) + b"\r\n"
    with post_head(service_url, "/grasps", headers="Transfer-Encoding: chunked") as connection:
        for _ in range(66):
            connection.sendall(chunk)
        assert status_of(connection) == 413  # though the last chunk was never sent


def test_a_client_that_sends_a_too_large_body_to_its_end_reads_the_413(http: httpx.Client) -> None:
    def body() -> Iterator[bytes]:
        for _ in range(80):
            yield bytes(2**20)

    problem_of(http.post("/grasps", content=body(), headers=OCTETS), 413, "67108864")
