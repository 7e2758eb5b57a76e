"""The service as a child process of the harness, on a free loopback port.

It knows the service's command line and environment only; the code of the service is never imported.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import httpx

from simharness.errors import RunBroken

if TYPE_CHECKING:
    from typing_extensions import Self

NUM_THREADS = 1
"""Compute threads of a service that the harness starts: fixed, so that results do not depend on machine or load."""

READY_WITHIN_S = 120.0
STOPPED_WITHIN_S = 15.0
_POLL_S = 0.1
_PORT_TRIES = 3
_PORT_REFUSED = "GRASP_PORT is"
"""How the service begins its message when it cannot have the port."""
_LOG_TAIL_LINES = 5
_LOG_TAIL_WIDTH = 400
_PR_SET_PDEATHSIG = 1


class LocalService:
    """`python -m service`, ready to answer, for as long as the context lasts.

    Settings that decide results are fixed: one compute thread, one cloud a batch. The others come from the caller's
    environment (`GRASP_WEIGHTS`, `GRASP_DEVICE`, ...).

    Args:
        model: the network to load.
        log: file for the service's output.
        command: what to start instead of the service.
        weights: the network's file; None leaves it to the environment or to the weights that are installed.
    """

    def __init__(
        self,
        model: str,
        log: Path,
        command: tuple[str, ...] = (sys.executable, "-m", "service"),
        *,
        weights: Path | None = None,
    ) -> None:
        self._model = model
        self._log = log
        self._command = command
        self._weights = weights
        self._process: subprocess.Popen[bytes] | None = None
        self.url = ""

    def __enter__(self) -> Self:
        """Start the process and wait until it is ready.

        Raises:
            RunBroken: it ended before it was ready, or took too long; the message ends with its last lines of output.
        """
        for tries_left in reversed(range(_PORT_TRIES)):
            port = free_port()
            self.url = f"http://127.0.0.1:{port}"
            self._start(port)
            try:
                if self._ready():
                    return self
            except BaseException:
                self._stop()
                raise
            # Another program may have taken the port between our look and the service's.
            if not tries_left or _PORT_REFUSED not in self._tail():
                break
        code = self._process.poll() if self._process else None
        self._stop()
        why = (
            f"was not ready after {READY_WITHIN_S:.0f} s"
            if code is None
            else f"ended with code {code} before it was ready"
        )
        raise RunBroken(f"the service {why}; its output ({self._log}) ends with:\n{self._tail()}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    @property
    def died(self) -> str | None:
        """How the process ended, with its last lines of output; None while it runs."""
        code = self._process.poll() if self._process else None
        if code is None:
            return None
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"the service {how}; its output ({self._log}) ends with:\n{self._tail()}"

    def _start(self, port: int) -> None:
        environment = {name: value for name, value in os.environ.items() if name != "GRASP_API_KEYS"}
        # Sums on a GPU may differ in their last bits from run to run; who wants its speed says so.
        environment.setdefault("GRASP_DEVICE", "cpu")
        environment |= {
            "GRASP_HOST": "127.0.0.1",
            "GRASP_PORT": str(port),
            "GRASP_MODELS": self._model,
            "GRASP_NUM_THREADS": str(NUM_THREADS),
            "GRASP_MAX_BATCH": "1",
            "PYTHONUNBUFFERED": "1",
        }
        if self._weights is not None:
            environment["GRASP_WEIGHTS"] = str(self._weights)
        with self._log.open("wb") as output:
            # A session of its own: Ctrl-C in the terminal reaches the harness, which then stops the service itself.
            self._process = subprocess.Popen(
                self._command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_end_with_parent(),  # noqa: PLW1509 - makes one system call, takes no lock
            )

    def _ready(self) -> bool:
        """Whether the service became ready in time, as opposed to having ended or hung."""
        assert self._process is not None
        deadline = time.monotonic() + READY_WITHIN_S
        with httpx.Client(base_url=self.url, timeout=5.0, trust_env=False) as http:
            while time.monotonic() < deadline and self._process.poll() is None:
                try:
                    if http.get("/health/ready").status_code == httpx.codes.OK:
                        return self._process.poll() is None
                except httpx.TransportError:
                    pass  # not listening yet
                time.sleep(_POLL_S)
        return False

    def _stop(self) -> None:
        process = self._process
        if process is None or process.poll() is not None:
            return
        process.terminate()
        try:
            process.wait(STOPPED_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(f"  {line[:_LOG_TAIL_WIDTH]}" for line in lines[-_LOG_TAIL_LINES:])


def _end_with_parent() -> Callable[[], None] | None:
    """What a child calls so that Linux ends it with its parent, even one that was killed; elsewhere nothing does."""
    if sys.platform != "linux":
        return None
    libc = ctypes.CDLL(None)

    def ask() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    return ask


def free_port() -> int:
    """A TCP port of the loopback interface that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
