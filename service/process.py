"""The process of `python -m service`: settings, socket, signals, exit code. torch loads once the port is ours."""

from __future__ import annotations

import argparse
import contextlib
import errno
import logging
import math
import os
import resource
import signal
import socket
import sys
import textwrap
import time
from collections.abc import Iterator
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn

from service.logs import configure_logging
from service.protocol import KEEP_ALIVE_SECONDS, PunctualProtocol
from service.settings import InvalidSetting, Settings, load_settings, service_version, unknown_variables, variables

if TYPE_CHECKING:
    from service.grasps import GraspEndpoint

log = logging.getLogger("service")

LAST_BYTES_SECONDS = 2
"""For answers on their way when draining has ended."""
MAX_OPEN_FILES = 65_536


def main() -> int:
    """Serve until SIGTERM or SIGINT; the process's exit code.

    0: ended as asked. 1: the predictor could not be loaded. 2: a setting, the command line or the port is wrong.
    """
    _open_standard_files()
    _parser().parse_args()
    started = time.perf_counter()
    _allow_many_connections()
    try:
        settings = load_settings(os.environ)
        listener = _listen(settings)
    except InvalidSetting as error:
        return _fail(str(error), 2)
    configure_logging(settings.log_level)
    if os.environ.get("GRASP_API_KEYS") == "":
        log.warning("GRASP_API_KEYS is empty: no key is wanted, everybody is answered")
    for name, close in unknown_variables(os.environ).items():
        log.warning("unknown setting %s is ignored%s", name, f"; did you mean {close}?" if close else "")
    code = _serve(settings, listener, started)
    logging.shutdown()
    return code


def _serve(settings: Settings, listener: socket.socket, started: float) -> int:
    from service.app import create_app  # noqa: PLC0415 - after the port is known to be free
    from service.loading import predictor_factory  # noqa: PLC0415 - the same

    host, port = listener.getsockname()[:2]
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
    failures: list[BaseException] = []

    def on_ready() -> None:
        log.info(
            "ready",
            extra={
                "fields": {
                    "url": url,
                    "port": port,
                    "pid": os.getpid(),
                    "seconds": round(time.perf_counter() - started, 2),
                }
            },
        )

    def on_failure(error: BaseException) -> None:
        failures.append(error)
        server.should_exit = True

    app = create_app(settings, predictor_factory(settings), on_ready, on_failure)
    config = uvicorn.Config(
        app,
        loop="asyncio",  # named, because uvicorn would take another where it happens to be installed
        http=PunctualProtocol.over(app.state.memory),
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        log_config=None,
        access_log=False,
        ws="none",
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=LAST_BYTES_SECONDS,
    )
    server = _Server(config, app.state.endpoint, settings.drain_timeout)
    log.info("listening", extra={"fields": {"url": url, "port": port, "pid": os.getpid()}})
    server.run(sockets=[listener])
    if failures:
        return _fail_loading(failures[0])
    log.info("stopped")
    if not app.state.endpoint.closed:  # a prediction still runs: the interpreter could not end in order
        logging.shutdown()
        os._exit(0)
    return 0


def _open_standard_files() -> None:
    """Give those that whoever started the process has closed to nobody, or the next socket would get their numbers."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) < 3:  # each gets the lowest free number
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or os.fdopen(1, "w")
    sys.stderr = sys.stderr or os.fdopen(2, "w")


def _allow_many_connections() -> None:
    """Raise the limit of open files, each connection being one, as far as this user may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class _Server(uvicorn.Server):
    """uvicorn, except for signals: the first drains while health and refusals still answer, the second ends at once.

    Args:
        config: uvicorn's.
        endpoint: is drained.
        drain_timeout: seconds that draining may take.
    """

    def __init__(self, config: uvicorn.Config, endpoint: GraspEndpoint, drain_timeout: float) -> None:
        super().__init__(config)
        self._endpoint = endpoint
        self._drain_timeout = drain_timeout
        self._signal: int | None = None
        self._drain_until = math.inf

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Handle SIGTERM and SIGINT for as long as the server runs."""
        before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def on_tick(self, counter: int) -> bool:
        """Called ten times a second: whether to end."""
        if self._signal is not None and self._drain_until == math.inf:
            self._drain_until = time.monotonic() + self._drain_timeout
            name = signal.Signals(self._signal).name
            log.info("draining", extra={"fields": {"signal": name, "active": self._endpoint.active}})
        if self._signal is not None and (self._endpoint.active == 0 or time.monotonic() > self._drain_until):
            return True
        return await super().on_tick(counter)

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if self._signal is not None:
            os._exit(128 + number)
        self._signal = number
        self._endpoint.drain()


def _listen(settings: Settings) -> socket.socket:
    """The listening socket.

    Raises:
        InvalidSetting: the address is not ours, the port is taken or not allowed.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        why = f"is {settings.host!r}, which is no address here ({error.strerror}); try 127.0.0.1 or 0.0.0.0"
        raise InvalidSetting("GRASP_HOST", why) from None
    listener = socket.socket(family, kind, protocol)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen(2048)
    except OSError as error:
        listener.close()
        port, host = settings.port, settings.host
        if error.errno == errno.EADDRINUSE:
            why = f"is {port}, where another process listens already; stop it or take another port (0: a free one)"
            raise InvalidSetting("GRASP_PORT", why) from None
        if error.errno == errno.EACCES:
            why = f"is {port}, which this user may not open; take one from 1024 upwards"
            raise InvalidSetting("GRASP_PORT", why) from None
        why = f"is {host!r}, where nothing can listen ({error.strerror}); try 127.0.0.1 or 0.0.0.0"
        raise InvalidSetting("GRASP_HOST", why) from None
    return listener


def _fail_loading(error: BaseException) -> int:
    from tesnet.errors import TesnetError  # noqa: PLC0415 - not needed unless loading fails

    if not isinstance(error, TesnetError):
        log.error("loading failed", exc_info=error)
    return _fail(f"the predictor cannot be loaded: {error}", 1)


def _fail(message: str, code: int) -> int:
    sys.stdout.flush()
    print(f"python -m service: {message}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    lines = []
    for name, field in variables().items():
        described = Settings.model_fields[field]
        default = (
            "" if described.default_factory or described.default in (None, ()) else f" Default: {described.default}."
        )
        lines.append(
            textwrap.fill(
                f"{described.description}{default}", 110, initial_indent=f"  {name:<22} ", subsequent_indent=" " * 25
            )
        )
    parser = argparse.ArgumentParser(
        prog="python -m service",
        description="Grasp inference over HTTP: a point cloud in, ranked grasps out. It documents itself at /docs.",
        epilog="Settings are environment variables:\n"
        + "\n".join(lines)
        + "\n\nSIGTERM finishes accepted requests and exits with 0.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"tes-net {service_version()}")
    return parser
