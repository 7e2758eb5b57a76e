from __future__ import annotations

import socket
import time

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
