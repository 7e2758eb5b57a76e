"""`python -m service`. A signal ends it from its first moment on: PID 1 of a container hears none without a handler."""

from __future__ import annotations

import os
import signal
import sys


def exit_on_signals() -> None:
    """SIGTERM and SIGINT end the process at once, with 0: nothing is accepted yet. Who serves puts its own in place."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: os._exit(0))


def main() -> int:
    """Serve until SIGTERM or SIGINT; the process's exit code. See `service.process`."""
    exit_on_signals()
    from service.process import main as serve  # noqa: PLC0415 - loads libraries, which takes a while

    return serve()


if __name__ == "__main__":
    sys.exit(main())
