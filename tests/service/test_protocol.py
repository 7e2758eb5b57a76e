"""Connections, on a real server, whose clients do not keep to the protocol, or to the time."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
import pytest

from service.protocol import PunctualProtocol
from tests.conftest import PATIENCE_S
from tests.service.wire import POINTS, connect, post, post_head, status_of

Serve = Callable[..., Any]
Eventually = Callable[[Callable[[], bool]], None]


def test_a_connection_whose_head_never_comes_is_closed(serve: Serve) -> None:
    class Impatient(PunctualProtocol):
        head_seconds = 1.0

    server = serve(protocol=Impatient)
    server.predictor.gate.set()
    with connect(server.url) as silent, connect(server.url) as slow:
        slow.sendall(b"POST /grasps HT")
        assert silent.recv(1) == slow.recv(1) == b""
    with post_head(server.url) as decent:
        time.sleep(1.5)  # a body has the request's deadline, not the head's
        decent.sendall(POINTS)
        assert status_of(decent) == 200
    assert post(server.url).status_code == 200


HEAD = b"POST /grasps HTTP/1.1\r\nHost: test\r\nContent-Type: application/octet-stream\r\nContent-Length: %d\r\n"


def unread(server: Any, count: int, window: int = 2**16) -> list[socket.socket]:
    """Connections that asked for 1.2 MB each and read nothing."""
    points = np.zeros((100_000, 3), np.float32).tobytes()
    connections = []
    for _ in range(count):
        connection = connect(server.url)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
        connection.sendall(HEAD.replace(b"/grasps", b"/viewer/points") % len(points) + b"\r\n" + points)
        connections.append(connection)
    return connections


def test_answers_that_nobody_reads_are_counted_and_end_with_their_connections(
    serve: Serve, eventually: Eventually
) -> None:
    class Impatient(PunctualProtocol):
        unread_seconds = 0.3

    server = serve(protocol=Impatient)
    with ExitStack() as stack:
        for connection in unread(server, 3):
            stack.enter_context(connection)
        most = 0

        def closed() -> bool:
            nonlocal most
            most = max(most, server.memory.held)
            return bool(0 == server.memory.held < most)

        eventually(closed)
    assert post(server.url, X_Request_Timeout="0.1").status_code == 504  # the service is well


def test_over_the_limit_the_answer_that_is_unread_the_longest_is_closed(serve: Serve, eventually: Eventually) -> None:
    server = serve(max_held_mb=2.0)
    with ExitStack() as stack:
        connections = []
        for _ in range(8):
            (connection,) = unread(server, 1)
            connections.append(stack.enter_context(connection))
            assert connection.recv(12) == b"HTTP/1.1 200"
            eventually(lambda: server.endpoint.active == 0)
            assert server.memory.held <= 2 * 2**20
        assert received_by(connections[0]) < 1_200_000 < received_by(connections[-1])


def received_by(connection: socket.socket) -> int:
    """Bytes that still come before the connection is closed, or the answer is complete."""
    received = 0
    with suppress(ConnectionResetError):
        while received < 1_200_001 and (part := connection.recv(2**18)):
            received += len(part)
    return received


def test_a_slow_reader_that_reads_gets_all_of_its_answer(serve: Serve) -> None:
    class Impatient(PunctualProtocol):
        unread_seconds = 3.0
        unread_bytes = 1

    (connection,) = unread(serve(protocol=Impatient), 1, window=2**18)
    received = b""
    with connection:
        while not received or len(received.partition(b"\r\n\r\n")[2]) < 1_200_000:
            part = connection.recv(2**17)
            assert part
            received += part
            time.sleep(0.5)
    assert received.startswith(b"HTTP/1.1 200 ")


def test_a_client_that_ends_its_side_gets_its_answer(serve: Serve) -> None:
    server = serve()
    with connect(server.url) as connection:
        connection.sendall(HEAD % len(POINTS) + b"\r\n" + POINTS)
        connection.shutdown(socket.SHUT_WR)
        assert server.predictor.entered.acquire(timeout=PATIENCE_S)
        server.predictor.gate.set()
        received = b"".join(iter(lambda: connection.recv(4096), b""))
    interim, _, answer = received.rpartition(b"HTTP/1.1 200 OK\r\n")
    assert interim.replace(b"HTTP/1.1 100 Continue\r\n\r\n", b"") == b""
    assert b"no_candidates" in answer


@pytest.mark.parametrize("path", [b"/grasps", b"/nothing"])
def test_a_body_of_two_lengths_ends_its_connection(serve: Serve, path: bytes) -> None:
    """Or what one reads as the end of a body another reads as the next request (RFC 9112, 6.1)."""
    server = serve()
    server.predictor.gate.set()
    chunked = b"%x\r\n%b\r\n0\r\n\r\n" % (len(POINTS), POINTS)
    with connect(server.url) as connection:
        head = HEAD.replace(b"/grasps", path) % len(chunked) + b"Transfer-Encoding: chunked\r\n\r\n"
        connection.sendall(head + chunked + b"GET /health/live HTTP/1.1\r\nHost: test\r\n\r\n")
        received = b"".join(iter(lambda: connection.recv(4096), b""))
    assert received.count(b"HTTP/1.1 ") == 1
    assert b"connection: close" in received.lower()


def test_heads_that_never_end_are_counted(serve: Serve, eventually: Eventually) -> None:
    server = serve()
    with connect(server.url) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: test\r\n" + b"X-Long: aaaa\r\n" * 700)
        eventually(lambda: server.memory.held >= 9_800)
    eventually(lambda: server.memory.held == 0)


def test_a_head_that_comes_in_pieces_counts_for_all_of_them(serve: Serve, eventually: Eventually) -> None:
    server = serve()
    sent = 0

    def all_counted() -> bool:
        return bool(server.memory.held == sent)

    with connect(server.url) as connection:
        for piece in (b"GET / HTTP/1.1\r\nHost: test\r\n", b"X-Long: aaaa\r\n" * 300, b"X-Longer: bbb\r\n" * 200, b"X"):
            connection.sendall(piece)
            sent += len(piece)
            eventually(all_counted)
    eventually(lambda: server.memory.held == 0)
