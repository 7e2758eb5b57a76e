"""Recorded attempts, simulated again from the round's seed with the grasps that were recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from simharness.errors import UsageError
from simharness.play.records import AttemptRecord, RoundRecord
from simharness.play.round import Attempted, Observed, Plan, play_round
from simharness.play.settings import RunSettings
from simharness.sim.camera import Observation
from simharness.sim.objects import ObjectModel


class RecordedPlanner:
    """Proposes what a recorded round proposed, observation by observation."""

    def __init__(self, played: RoundRecord) -> None:
        self._grasps = {attempt.observation: attempt for attempt in played.attempts}
        self._reasons = {entry.observation: entry.reason for entry in played.no_grasps}
        self._observation = -1

    def plan(self, observation: Observation, seed: int) -> Plan:  # noqa: ARG002 - a planner is asked so
        """The grasp recorded for the next observation."""
        self._observation += 1
        attempt = self._grasps.get(self._observation)
        if attempt is None:
            return Plan.nothing(self._reasons[self._observation])
        response: dict[str, Any] = {"counts": attempt.counts, "warnings": attempt.warnings}
        return Plan(attempt.T_world_grasp[None], np.array([attempt.score]), np.array([attempt.width]), None, response)


class _Reached(Exception):
    """The attempt that was asked for has been carried out."""


def find_attempt(rounds: Sequence[RoundRecord], index: int) -> AttemptRecord:
    """The attempt at a line of attempts.jsonl, the first being 0.

    Raises:
        UsageError: there are not so many.
    """
    attempts = [attempt for record in rounds for attempt in record.attempts]
    if index >= len(attempts):
        raise UsageError(f"--attempt {index}: the run has {len(attempts)} attempts; give 0 to {len(attempts) - 1}")
    return attempts[index]


def replay(settings: RunSettings, objects: Sequence[ObjectModel], played: RoundRecord, attempt: int) -> list[Attempted]:
    """Play a recorded round up to one of its attempts; all attempts until then, that one being the last.

    Args:
        settings: of the run.
        objects: the run's object set.
        played: the recorded round.
        attempt: number within the round.

    Raises:
        UsageError: an attempt on the way ended otherwise than recorded; the objects or the simulator are others.
    """
    events: list[Attempted] = []

    def listen(event: Attempted | Observed) -> None:
        if not isinstance(event, Attempted):
            return
        recorded, now = played.attempts[event.record.attempt], event.record
        if (now.outcome, now.grasped, now.objects) != (recorded.outcome, recorded.grasped, recorded.objects):
            raise UsageError(
                f"round {played.round}, attempt {now.attempt} ended as {now.outcome} with objects "
                f"{', '.join(now.objects)}; recorded was {recorded.outcome} with {', '.join(recorded.objects)}. "
                "Replay with the object files and package versions of the run"
            )
        events.append(event)
        if now.attempt == attempt:
            raise _Reached

    try:
        play_round(settings, objects, RecordedPlanner(played), played.seed, played.round, listen, segmentation=True)
    except _Reached:
        return events
    raise UsageError(
        f"round {played.round} ended before attempt {attempt}; "
        "replay with the object files and package versions of the run"
    )
