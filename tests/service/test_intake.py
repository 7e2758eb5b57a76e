"""Bodies within limits: of one, and of all together."""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from fastapi import Request
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Message

from service.errors import TooLarge
from service.intake import read_body
from service.memory import Memory
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


@given(sizes=st.lists(st.integers(0, 40), max_size=8), announced=st.booleans())
def test_a_body_is_read_up_to_the_last_byte_of_the_limit_however_it_comes(sizes: list[int], announced: bool) -> None:
    chunks = [bytes([number]) * size for number, size in enumerate(sizes)]
    whole = b"".join(chunks)

    def read(limit: int) -> bytes:
        left = [{"type": "http.request", "body": chunk, "more_body": True} for chunk in chunks]
        left.append({"type": "http.request", "body": b"", "more_body": False})

        async def receive() -> Message:
            return left.pop(0)

        headers = [(b"content-length", str(len(whole)).encode())] if announced else []
        with Memory(1e6).share() as share:
            body = asyncio.run(read_body(Request({"type": "http", "headers": headers}, receive), limit, share))
            assert share.size == len(body)
        return bytes(body)

    assert read(len(whole)) == read(len(whole) + 1) == whole
    if whole:
        with pytest.raises(TooLarge, match=f"{len(whole) - 1}"):
            read(len(whole) - 1)
