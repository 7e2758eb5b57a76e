"""Connections, on a real server, whose clients do not keep to the protocol, or to the time."""

from __future__ import annotations

import socket
import time
import urllib.parse
from collections.abc import Callable
from typing import Any

from service.protocol import PunctualProtocol
from tests.service.wire import POINTS, post, post_head

Serve = Callable[..., Any]


def test_a_connection_whose_head_never_comes_is_closed(serve: Serve) -> None:
    class Impatient(PunctualProtocol):
        head_seconds = 0.2

    server = serve(protocol=Impatient)
    server.predictor.gate.set()
    parts = urllib.parse.urlsplit(server.url)
    address = (parts.hostname or "", parts.port or 0)
    with socket.create_connection(address, timeout=30) as silent, socket.create_connection(address, 30) as slow:
        slow.sendall(b"POST /grasps HT")
        assert silent.recv(1) == slow.recv(1) == b""
    with post_head(server.url) as decent:
        time.sleep(0.4)  # a body has the request's deadline, not the head's
        decent.sendall(POINTS)
        assert decent.recv(4096).startswith(b"HTTP/1.1 200 ")
    assert post(server.url).status_code == 200
