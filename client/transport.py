"""How bytes get to the service and back: which proxy, and one deadline for all of it. Knows nothing of grasps.

httpx gives each phase of a request a time-out, and each wait for a byte within a phase that whole time again: a peer
that drips keeps it for ever. Here a time-out knows its end, and every wait gets what is left until then.
"""

from __future__ import annotations

import importlib.util
import ipaddress
import socket
import ssl
import time
import urllib.request
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import httpcore
import httpx

from client.errors import InvalidArgument

PIECE = 1 << 14
"""Bytes that are written before the time left is looked at again."""

_PROXY_SCHEMES = ("http", "https", "socks5", "socks5h")


class Deadline(float):
    """Seconds that were left when it was made, for who wants a number; and when they end."""

    end: float

    @classmethod
    def at(cls, end: float) -> Deadline:
        """The deadline at a moment of `time.monotonic`."""
        made = cls(max(end - time.monotonic(), 0.001))
        made.end = end
        return made


class TimeLeft(dict[str, float]):
    """httpx's timeout extension, whose entries are the time left when they are looked up."""

    def __init__(self, end: float) -> None:
        super().__init__(dict.fromkeys(("pool", "connect", "write", "read"), 0.0))
        self._end = end

    def get(self, key: str, default: Any = None) -> Any:
        """The time left of a phase."""
        return Deadline.at(self._end) if key in self else default


class DeadlineTransport(httpx.BaseTransport):
    """A pool of connections that keep `TimeLeft`.

    Args:
        proxy: URL of one that they go through.
        context: what is trusted.
    """

    def __init__(self, proxy: str | None, context: ssl.SSLContext) -> None:
        url = None if proxy is None else httpx.URL(proxy)
        auth = (url.username, url.password) if url is not None and url.username else None
        through = None if url is None else httpcore.Proxy(_core_url(url), auth=auth, ssl_context=_tls_of(url, context))
        self._pool = httpcore.ConnectionPool(
            context, proxy=through, max_connections=100, keepalive_expiry=5.0, network_backend=_Backend()
        )

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request; the answer's body comes as it is read."""
        asked = httpcore.Request(
            method=request.method,
            url=_core_url(request.url),
            headers=request.headers.raw,
            content=request.stream,
            extensions=request.extensions,
        )
        with _as_httpx():
            answer = self._pool.handle_request(asked)
        return httpx.Response(answer.status, headers=answer.headers, stream=_Body(answer), extensions=answer.extensions)

    def close(self) -> None:
        """Close the connections."""
        self._pool.close()


class _Body(httpx.SyncByteStream):
    def __init__(self, answer: httpcore.Response) -> None:
        self._answer = answer

    def __iter__(self) -> Iterator[bytes]:
        with _as_httpx():
            yield from self._answer.iter_stream()

    def close(self) -> None:
        self._answer.close()


@contextmanager
def _as_httpx() -> Iterator[None]:
    try:
        yield
    except httpcore.TimeoutException as error:
        raise httpx.ReadTimeout(str(error)) from error
    except (httpcore.NetworkError, httpcore.ProtocolError, httpcore.ProxyError) as error:
        raise httpx.NetworkError(str(error)) from error


class _Backend(httpcore.NetworkBackend):
    """TCP connections whose every wait ends at the deadline."""

    def __init__(self) -> None:
        self._sockets = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """A connection to the first of the host's addresses that takes one."""
        failed = httpcore.ConnectError(f"{host} has no address")
        for address in _addresses(host, port):
            left = _left(timeout, httpcore.ConnectTimeout)
            try:
                return _Stream(self._sockets.connect_tcp(address, port, left, local_address, socket_options))
            except httpcore.ConnectError as error:
                failed = error
        raise failed

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self._sockets.sleep(seconds)


def _addresses(host: str, port: int) -> list[str]:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise httpcore.ConnectError(str(error)) from error
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream) -> None:
        self._stream = stream

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, _left(timeout, httpcore.ReadTimeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        for begin in range(0, len(buffer), PIECE):
            self._stream.write(buffer[begin : begin + PIECE], _left(timeout, httpcore.WriteTimeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        left = _left(timeout, httpcore.ConnectTimeout)
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, left))

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


def _left(timeout: float | None, passed: type[httpcore.TimeoutException]) -> float | None:
    if not isinstance(timeout, Deadline):
        return timeout
    left = timeout.end - time.monotonic()
    if left <= 0:
        raise passed("the time is used up")
    return left


def proxy_for(url: httpx.URL, told: str | None) -> str | None:
    """The proxy on the way to a URL: the one that was told, else the environment's, but none to this machine.

    Raises:
        InvalidArgument: it is no proxy; credentials within it are not repeated.
    """
    if told is not None:
        return _checked_proxy(told, "it")
    if is_this_machine(url.host) or urllib.request.proxy_bypass(url.host):
        return None
    proxies = urllib.request.getproxies()
    name = url.scheme if url.scheme in proxies else "all"
    if name not in proxies:
        return None
    given = proxies[name]
    return _checked_proxy(given if "://" in given else f"http://{given}", f"the environment's {name.upper()}_PROXY")


def _checked_proxy(proxy: str, source: str) -> str:
    example = "give one like http://10.0.0.1:3128, or none"
    try:
        url = httpx.URL(proxy)
    except (httpx.InvalidURL, ValueError) as error:
        raise InvalidArgument("proxy", f"{source} is no URL ({error}); {example}") from None
    if url.scheme not in _PROXY_SCHEMES or not url.host:
        raise InvalidArgument("proxy", f"{source} is a {url.scheme or 'nameless'} URL of host {url.host!r}; {example}")
    if url.scheme.startswith("socks") and importlib.util.find_spec("socksio") is None:
        raise InvalidArgument(
            "proxy", f"{source} is a SOCKS proxy, which needs the package socksio; install it, or {example}"
        )
    return proxy


def is_this_machine(host: str) -> bool:
    """Whether a host is a loopback address or `localhost`."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def tls_context(url: httpx.URL, proxy: str | None) -> ssl.SSLContext:
    """What is trusted on the way to a URL; nothing is loaded where nothing is encrypted.

    Raises:
        InvalidArgument: the certificates that the environment names cannot be loaded.
    """
    if url.scheme != "https" and (proxy is None or httpx.URL(proxy).scheme != "https"):
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        return httpx.create_ssl_context()
    except OSError as error:
        why = f"the certificates that SSL_CERT_FILE or SSL_CERT_DIR names cannot be loaded ({error})"
        raise InvalidArgument("SSL_CERT_FILE", f"{why}; name others, or unset it") from None


def _core_url(url: httpx.URL) -> httpcore.URL:
    return httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path)


def _tls_of(proxy: httpx.URL, context: ssl.SSLContext) -> ssl.SSLContext | None:
    """A context is for a proxy that is spoken to encrypted alone."""
    return context if proxy.scheme == "https" else None
