from __future__ import annotations

import importlib.util
import socket
import time
from collections.abc import Callable
from typing import Any

import httpcore
import httpx
import pytest

from client import transport
from client.errors import InvalidArgument
from client.transport import Deadline, TimeLeft, is_this_machine, proxy_for, tls_context
from tests.conftest import PATIENCE_S

ELSEWHERE = httpx.URL("http://robot.example:8000")
VARIABLES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)


def test_a_time_out_is_what_is_left_when_it_is_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    left = TimeLeft(103.0)
    assert left.get("read") == left.get("connect") == 3
    now = 102.5
    assert left.get("read") == 0.5
    assert isinstance(left.get("write"), Deadline)
    assert left.get("write").end == 103
    assert left.get("other") is None
    now = 105.0
    assert left.get("read") > 0  # none at all would mean: do not wait, and another error


@pytest.mark.parametrize("place", range(3))
def test_each_address_of_a_host_is_tried_until_one_takes_the_connection(
    place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a name has an IPv6 address, and the service listens on IPv4 alone."""
    addresses = ["127.0.0.2", "127.0.0.3"]
    addresses.insert(place, "127.0.0.1")
    found: dict[str, list[str]] = {"robot.example": addresses, "nowhere.example": []}
    monkeypatch.setattr(transport, "_addresses", lambda host, port: found[host])
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        stream = transport._Backend().connect_tcp("robot.example", port, PATIENCE_S)
        assert stream.get_extra_info("server_addr") == ("127.0.0.1", port)
        stream.close()
    for host, words in (("robot.example", "refused"), ("nowhere.example", "has no address")):
        with pytest.raises(httpcore.ConnectError, match=words):
            transport._Backend().connect_tcp(host, port, PATIENCE_S)


def test_the_addresses_of_a_host_are_those_of_its_name_each_once() -> None:
    assert set(transport._addresses("localhost", 80)) <= {"127.0.0.1", "::1"}
    assert transport._addresses("127.0.0.7", 80) == ["127.0.0.7"]
    with pytest.raises(httpcore.ConnectError):
        transport._addresses("x" * 64, 80)  # no name is so long, which needs no network to be known


@pytest.mark.parametrize(
    ("host", "ours"),
    [
        ("127.0.0.1", True),
        ("127.8.9.10", True),
        ("::1", True),
        ("localhost", True),
        ("robot.localhost", True),
        ("10.0.0.1", False),
        ("localhost.example", False),
    ],
)
def test_which_hosts_are_this_machine(host: str, ours: bool) -> None:
    assert is_this_machine(host) is ours


def test_the_environments_proxy_is_for_other_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    assert proxy_for(ELSEWHERE, None) is None
    monkeypatch.setenv("all_proxy", "10.0.0.1:3128")
    assert proxy_for(ELSEWHERE, None) == "http://10.0.0.1:3128"
    monkeypatch.setenv("http_proxy", "http://10.0.0.2:3128")
    assert proxy_for(ELSEWHERE, None) == "http://10.0.0.2:3128"
    assert proxy_for(httpx.URL("http://127.0.0.1:8000"), None) is None
    monkeypatch.setenv("no_proxy", "robot.example")
    assert proxy_for(ELSEWHERE, None) is None


def test_a_proxy_that_is_told_is_for_this_machine_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")
    assert proxy_for(httpx.URL("http://127.0.0.1:8000"), "http://10.0.0.1:3128") == "http://10.0.0.1:3128"


@pytest.mark.parametrize(
    "proxy", ["ftp://me:secret@10.0.0.1", "http://", "http://me:secret@10.0.0.1:port", "//me:secret@host"]
)
def test_a_proxy_that_is_none_is_told_without_its_credentials(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", proxy)
    for told, source in ((None, "the environment's HTTP_PROXY"), (proxy, "it")):
        with pytest.raises(InvalidArgument, match=f"^proxy: {source} is") as caught:
            proxy_for(ELSEWHERE, told)
        assert "secret" not in str(caught.value)


def test_certificates_that_cannot_be_loaded_are_told_where_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", "/no/such/file.pem")
    with pytest.raises(InvalidArgument, match="SSL_CERT_FILE"):
        tls_context(httpx.URL("https://robot.example"), None)
    with pytest.raises(InvalidArgument, match="SSL_CERT_FILE"):
        tls_context(ELSEWHERE, "https://10.0.0.1:3128")
    tls_context(ELSEWHERE, "http://10.0.0.1:3128")


class _Slow(httpcore.NetworkStream):
    """A stream and backend of which each call takes a quarter of a second, and that keeps what it was given."""

    def __init__(self) -> None:
        self.now = 100.0
        self.given: list[tuple[float, float | None]] = []
        self.written: list[bytes] = []

    def _take(self, timeout: float | None) -> None:
        self.given.append((self.now, timeout))
        self.now += 0.25

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        self._take(timeout)
        return b"x" * max_bytes

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._take(timeout)
        self.written.append(buffer)

    def start_tls(self, context: Any, server_hostname: str | None = None, timeout: float | None = None) -> Any:
        self._take(timeout)
        return self

    def connect_tcp(self, host: str, port: int, timeout: float | None, *_: Any) -> Any:
        self._take(timeout)
        raise httpcore.ConnectError(f"{host} refused")

    def close(self) -> None:
        """Nothing to close."""


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> _Slow:
    made = _Slow()
    monkeypatch.setattr(time, "monotonic", lambda: made.now)
    monkeypatch.setattr(transport, "_addresses", lambda host, port: [f"10.0.0.{n}" for n in range(40)])
    return made


def _connect(slow: _Slow, timeout: float | None) -> None:
    backend = transport._Backend()
    backend._sockets = slow  # type: ignore[assignment]
    backend.connect_tcp("robot.example", 8000, timeout)


def _at_once(slow: _Slow, timeout: float | None) -> None:
    transport._Stream(slow).write(b"y" * (40 * transport.PIECE), timeout)


def _many_reads(slow: _Slow, timeout: float | None) -> None:
    for _ in range(40):
        transport._Stream(slow).read(7, timeout)


def _many_handshakes(slow: _Slow, timeout: float | None) -> None:
    for _ in range(40):
        transport._Stream(slow).start_tls(tls_context(ELSEWHERE, None), "robot.example", timeout)


@pytest.mark.parametrize(
    ("step", "passed"),
    [
        (_connect, httpcore.ConnectTimeout),
        (_at_once, httpcore.WriteTimeout),
        (_many_reads, httpcore.ReadTimeout),
        (_many_handshakes, httpcore.ConnectTimeout),
    ],
)
def test_every_wait_gets_what_is_left_until_the_end_and_none_begins_after_it(
    slow: _Slow, step: Callable[[_Slow, float | None], None], passed: type[httpcore.TimeoutException]
) -> None:
    with pytest.raises(passed, match="used up"):
        step(slow, Deadline.at(102.0))
    assert len(slow.given) == 8
    assert all(timeout == 102.0 - began for began, timeout in slow.given)


@pytest.mark.parametrize("size", [0, 1, transport.PIECE - 1, transport.PIECE, transport.PIECE + 1, 100_000])
def test_pieces_are_the_whole_in_order(slow: _Slow, size: int) -> None:
    whole = bytes(range(256)) * (size // 256 + 1)
    transport._Stream(slow).write(whole[:size], 3.0)
    assert b"".join(slow.written) == whole[:size]
    assert all(0 < len(piece) <= transport.PIECE for piece in slow.written)
    assert all(timeout == 3.0 for _, timeout in slow.given)


@pytest.mark.parametrize("scheme", ["http", "https"])
@pytest.mark.parametrize("credentials", [None, ("me", "s3cret")])
def test_a_pool_goes_through_its_proxy_with_its_credentials_and_what_it_is_trusted_by(
    scheme: str, credentials: tuple[str, str] | None
) -> None:
    context = tls_context(ELSEWHERE, None)
    named = "" if credentials is None else f"{credentials[0]}:{credentials[1]}@"
    pool = transport.DeadlineTransport(f"{scheme}://{named}10.0.0.1:3128", context)._pool
    proxy = pool._proxy
    assert proxy is not None
    assert (proxy.url.scheme, proxy.url.host, proxy.url.port) == (scheme.encode(), b"10.0.0.1", 3128)
    assert proxy.auth == (None if credentials is None else tuple(word.encode() for word in credentials))
    assert proxy.ssl_context is (context if scheme == "https" else None)
    assert pool._ssl_context is context
    assert transport.DeadlineTransport(None, context)._pool._proxy is None


@pytest.mark.parametrize(
    ("raised", "meant"),
    [
        (httpcore.ReadTimeout, httpx.TimeoutException),
        (httpcore.ConnectTimeout, httpx.TimeoutException),
        (httpcore.PoolTimeout, httpx.TimeoutException),
        (httpcore.ConnectError, httpx.NetworkError),
        (httpcore.RemoteProtocolError, httpx.NetworkError),
        (httpcore.ProxyError, httpx.NetworkError),
    ],
)
def test_what_goes_wrong_below_is_told_as_httpx_tells_it(
    raised: type[Exception], meant: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Any) -> None:
        raise raised("the reason")

    opened = transport.DeadlineTransport(None, tls_context(ELSEWHERE, None))
    monkeypatch.setattr(opened._pool, "handle_request", fail)
    with pytest.raises(meant, match="the reason"):
        opened.handle_request(httpx.Request("GET", ELSEWHERE))


@pytest.mark.parametrize(
    ("url", "proxy", "is_loaded"),
    [
        ("http://robot.example", None, False),
        ("http://robot.example", "http://10.0.0.1", False),
        ("http://robot.example", "https://10.0.0.1", True),
        ("https://robot.example", None, True),
        ("https://robot.example", "http://10.0.0.1", True),
    ],
)
def test_what_is_trusted_is_loaded_where_something_is_encrypted(url: str, proxy: str | None, is_loaded: bool) -> None:
    context = tls_context(httpx.URL(url), proxy)
    assert bool(context.get_ca_certs()) == is_loaded
    assert context.check_hostname


def test_the_environments_proxy_follows_the_scheme_and_then_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "10.0.0.2:3128")
    monkeypatch.setenv("https_proxy", "https://10.0.0.3:3128")
    assert proxy_for(httpx.URL("http://robot.example"), None) == "http://10.0.0.2:3128"
    assert proxy_for(httpx.URL("https://robot.example"), None) == "https://10.0.0.3:3128"
    monkeypatch.delenv("https_proxy")
    assert proxy_for(httpx.URL("https://robot.example"), None) is None
    monkeypatch.setenv("all_proxy", "socks5://10.0.0.4")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InvalidArgument, match="ALL_PROXY is a SOCKS proxy, which needs the package socksio"):
        proxy_for(httpx.URL("https://robot.example"), None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "socksio")
    assert proxy_for(httpx.URL("https://robot.example"), None) == "socks5://10.0.0.4"


def test_the_connections_of_a_pool_keep_the_deadline_and_are_as_many_as_are_shared() -> None:
    pool = transport.DeadlineTransport(None, tls_context(ELSEWHERE, None))._pool
    assert isinstance(pool._network_backend, transport._Backend)
    assert (pool._max_connections, pool._keepalive_expiry) == (100, 5.0)
