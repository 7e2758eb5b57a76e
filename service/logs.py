"""One JSON object a log line, on standard output, written by a thread of its own.

A reader that has stopped, or a disk that is full, costs lines and nothing else: requests go on.
"""

from __future__ import annotations

import datetime as dt
import logging
import os
import queue
import sys
import threading
from typing import Any

import msgspec

QUEUED_BYTES = 4 * 2**20
"""Of lines that wait to be written."""
CLOSE_SECONDS = 2.0
"""For the last lines to be written, when the process ends."""


class JsonFormatter(logging.Formatter):
    """A record as JSON: time, level, logger, event, the fields given as `extra={"fields": {...}}`, a traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON."""
        line: dict[str, Any] = {
            "time": dt.datetime.fromtimestamp(record.created, dt.timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return msgspec.json.encode(line, enc_hook=str).decode()


class BackgroundHandler(logging.Handler):
    """Writes to a file descriptor in a thread. What it cannot write is counted, and told when writing works again.

    Args:
        descriptor: of an open file or pipe.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._lost = 0
        self._queued = 0  # bytes
        self._counting = threading.Lock()
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record's line."""
        line = f"{self.format(record)}\n".encode()
        with self._counting:
            if self._queued + len(line) > QUEUED_BYTES:
                self._lost += 1
                return
            self._queued += len(line)
        self._lines.put(line)

    def close(self) -> None:
        """Write what is queued, for at most `CLOSE_SECONDS`."""
        if self._thread.is_alive():
            self._lines.put(None)
            self._thread.join(CLOSE_SECONDS)
        super().close()

    def _write_all(self) -> None:
        while (line := self._lines.get()) is not None:
            written = self._write(line)
            with self._counting:
                self._queued -= len(line)
            if not written:
                self._count(1)
            elif lost := self._counted():
                values = {"name": __name__, "levelname": "WARNING", "msg": "log lines lost", "fields": {"lines": lost}}
                if not self._write(f"{self.format(logging.makeLogRecord(values))}\n".encode()):
                    self._count(lost)

    def _count(self, lost: int) -> None:
        with self._counting:  # lines are lost in every thread that logs
            self._lost += lost

    def _counted(self) -> int:
        """How many lines were lost since this was last asked."""
        with self._counting:
            lost, self._lost = self._lost, 0
        return lost

    def _write(self, line: bytes) -> bool:
        rest = memoryview(line)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            return False
        return True


def configure_logging(level: str) -> None:
    """Send every logger of the process to standard output as JSON; uvicorn's own chatter from warnings upwards."""
    handler = BackgroundHandler(sys.stdout.fileno())
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(capture=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    logging.getLogger("python_multipart").setLevel(logging.ERROR)  # a broken form is the client's matter
