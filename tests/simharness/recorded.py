"""Who answered the recorded runs that reports are made of."""

from __future__ import annotations

from simharness.play.records import ModelRecord, Serving

MODEL = ModelRecord("tesnet", "1.2", "ab" * 32)


SERVING = Serving(None, 1, "cpu")
