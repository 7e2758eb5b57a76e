"""Connections, on a real server, whose clients do not keep to the protocol, or to the time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from service.protocol import PunctualProtocol
from tests.service.wire import POINTS, connect, post, post_head

Serve = Callable[..., Any]


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
        assert decent.recv(4096).startswith(b"HTTP/1.1 200 ")
    assert post(server.url).status_code == 200
