"""A run under way as a bar on stderr with the rates so far."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from tqdm import tqdm

from simharness.play.metrics import Summary, summarise
from simharness.play.records import RoundRecord
from simharness.play.settings import RunSettings
from simharness.report.report import percent


class Progress:
    """The bar; it appears with the start of the run.

    Args:
        settings: of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._total = settings.rounds * len(settings.seeds)
        self._rounds: list[RoundRecord] = []
        self._bar: Any = None
        self._others: list[Callable[[Summary], None]] = []

    def also(self, show: Callable[[Summary], None]) -> None:
        """Somebody else who is told the numbers so far."""
        self._others.append(show)

    def start(self, done: Sequence[RoundRecord]) -> None:
        """The run begins, with the rounds that an earlier one had finished."""
        self._rounds = list(done)
        self._bar = tqdm(total=self._total, initial=len(done), unit="round", file=sys.stderr, dynamic_ncols=True)
        self._show()

    def add(self, record: RoundRecord) -> None:
        """A round is finished."""
        self._rounds.append(record)
        self._bar.update()
        self._show()

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def _show(self) -> None:
        summary = summarise(self._rounds)
        self._bar.set_postfix_str(f"GSR {percent(summary.gsr)}, DR {percent(summary.dr)}")
        for show in self._others:
            show(summary)
