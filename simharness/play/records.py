"""What a run writes down: frozen values and their JSON forms.

It knows neither how rounds are played nor where they are written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float64

from simharness.play.settings import RunSettings
from simharness.sim.outcome_kinds import OutcomeKind

RoundEnd = Literal["empty", "two_failures", "no_grasps"]

ROUND_ENDS: tuple[RoundEnd, ...] = get_args(RoundEnd)

OBJECTS_PER_ROUND = 5
FAILURES_IN_A_ROW = 2
LOOKS_IN_A_ROW = 3
"""So many looks at a table as it stands; if the last gives no grasp either, the round is over."""

UNSURE = "unsure"
"""Reason of an observation whose grasps score too little for who looks again (`look_again_below`)."""

_CALIBRATED, _CORRECTED = "calibrate", "depth is multiplied by"
"""How the service's warning of a correction begins, and what it says and others do not."""

TIMING_KEYS = ("latency_ms",)
"""Keys of the JSON forms that hold measured times; everything else repeats bit for bit."""


@dataclass(frozen=True, slots=True)
class ModelRecord:
    """The network that answered, as the service names it."""

    name: str
    version: str
    weights_sha256: str | None


@dataclass(frozen=True, slots=True)
class Serving:
    """Where a run's answers came from.

    Args:
        url: the address given, or None when the harness started the service.
        num_threads: compute threads of a service that the harness started.
        device: the predictor's, as the service names it.
    """

    url: str | None
    num_threads: int | None
    device: str | None


@dataclass(frozen=True, slots=True)
class Latency:
    """Times of one request, milliseconds: inside the service (None when it did not say) and as the harness saw it."""

    service: float | None
    round_trip: float


@dataclass(frozen=True, eq=False, slots=True)
class AttemptRecord:
    """One grasp that was carried out.

    Args:
        seed, round, attempt, observation: which attempt this is; all but the run seed count from 0.
        request_seed: the seed sent with the request.
        viewpoints: camera positions in the world, metres.
        T_world_grasp: (4, 4) pose of the TCP.
        width: opening set before the approach, metres.
        score: probability of success that the model gave.
        outcome: what became of it.
        grasped: names of the objects that were lifted.
        objects: names of the objects that were there before.
        contact_at_start, contact_on_way: whether the hand touched anything before closing.
        counts: the response's counts.
        latency: the request's times; None when the planner had no need of one.
        warnings: the response's.
    """

    seed: int
    round: int
    attempt: int
    observation: int
    request_seed: int
    viewpoints: tuple[tuple[float, ...], ...]
    T_world_grasp: Float64[np.ndarray, "4 4"]
    width: float
    score: float
    outcome: OutcomeKind
    grasped: tuple[str, ...]
    objects: tuple[str, ...]
    contact_at_start: bool
    contact_on_way: bool
    counts: Mapping[str, Any]
    latency: Latency | None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        pose = np.array(self.T_world_grasp, dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"T_world_grasp has shape {pose.shape}; expected (4, 4)")
        pose.setflags(write=False)
        object.__setattr__(self, "T_world_grasp", pose)

    @property
    def corrected(self) -> bool:
        """Whether the service corrected the depth that it was sent."""
        return any(warning.startswith(_CALIBRATED) and _CORRECTED in warning for warning in self.warnings)

    @property
    def success(self) -> bool:
        """Whether an object was lifted."""
        return self.outcome == "success"

    def to_json(self) -> dict[str, Any]:
        """The attempt as JSON values; its position repeats the matrix's last column for readers of the file."""
        return {
            "seed": self.seed,
            "round": self.round,
            "attempt": self.attempt,
            "observation": self.observation,
            "outcome": self.outcome,
            "score": self.score,
            "grasped": list(self.grasped),
            "objects": list(self.objects),
            "position": self.T_world_grasp[:3, 3].tolist(),
            "T_world_grasp": self.T_world_grasp.tolist(),
            "width": self.width,
            "contact_at_start": self.contact_at_start,
            "contact_on_way": self.contact_on_way,
            "viewpoints": [list(viewpoint) for viewpoint in self.viewpoints],
            "request_seed": self.request_seed,
            "counts": dict(self.counts),
            "warnings": list(self.warnings),
            "latency_ms": _latency_to_json(self.latency),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> AttemptRecord:
        """An attempt from `to_json`.

        Raises:
            KeyError, TypeError, ValueError: `values` is no attempt.
        """
        return cls(
            seed=values["seed"],
            round=values["round"],
            attempt=values["attempt"],
            observation=values["observation"],
            request_seed=values["request_seed"],
            viewpoints=tuple(tuple(viewpoint) for viewpoint in values["viewpoints"]),
            T_world_grasp=np.array(values["T_world_grasp"]),
            width=values["width"],
            score=values["score"],
            outcome=values["outcome"],
            grasped=tuple(values["grasped"]),
            objects=tuple(values["objects"]),
            contact_at_start=values["contact_at_start"],
            contact_on_way=values["contact_on_way"],
            counts=values["counts"],
            latency=_latency_from_json(values["latency_ms"]),
            warnings=tuple(values.get("warnings", ())),  # runs of before 0.5.0 have none
        )


@dataclass(frozen=True, slots=True)
class NoGraspRecord:
    """One observation after which no grasp was tried: its number in the round, why, the answer's counts and times.

    `latency` is None where the camera saw nothing and no request was made.
    """

    observation: int
    reason: str
    counts: Mapping[str, Any]
    latency: Latency | None

    def to_json(self) -> dict[str, Any]:
        """The observation as JSON values."""
        return {
            "observation": self.observation,
            "reason": self.reason,
            "counts": dict(self.counts),
            "latency_ms": _latency_to_json(self.latency),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> NoGraspRecord:
        """An observation from `to_json`.

        Raises:
            KeyError, TypeError: `values` is no such observation.
        """
        latency = _latency_from_json(values["latency_ms"])
        return cls(values["observation"], values["reason"], values["counts"], latency)


@dataclass(frozen=True, slots=True)
class RoundRecord:
    """One finished round.

    Args:
        seed, round: which round this is; rounds count from 0.
        objects: names of the objects present after the scene had settled.
        ended: why it ended.
        attempts: in the order of execution.
        no_grasps: observations after which none was tried, in order.
    """

    seed: int
    round: int
    objects: tuple[str, ...]
    ended: RoundEnd
    attempts: tuple[AttemptRecord, ...]
    no_grasps: tuple[NoGraspRecord, ...]

    def to_json(self) -> dict[str, Any]:
        """The round as JSON values, with the number of its attempts; these have lines of their own."""
        return {
            "seed": self.seed,
            "round": self.round,
            "objects": list(self.objects),
            "ended": self.ended,
            "attempts": len(self.attempts),
            "no_grasps": [no_grasp.to_json() for no_grasp in self.no_grasps],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any], attempts: tuple[AttemptRecord, ...]) -> RoundRecord:
        """A round from `to_json` and its attempts.

        Raises:
            KeyError, TypeError, ValueError: `values` is no round, or the attempts are not as many as it says.
        """
        if len(attempts) != values["attempts"]:
            raise ValueError(f"round {values['round']} has {values['attempts']} attempts; {len(attempts)} were given")
        if values["ended"] not in ROUND_ENDS:
            raise ValueError(f"a round cannot end by {values['ended']!r}; valid: {', '.join(ROUND_ENDS)}")
        return cls(
            seed=values["seed"],
            round=values["round"],
            objects=tuple(values["objects"]),
            ended=values["ended"],
            attempts=attempts,
            no_grasps=tuple(NoGraspRecord.from_json(entry) for entry in values["no_grasps"]),
        )


@dataclass(frozen=True, slots=True)
class Run:
    """A run that is over, complete or not.

    Args:
        settings: what decided its results.
        workers: processes that played it.
        model: the network that answered; None until it was asked.
        serving: where; None until it was asked.
        rounds: the finished rounds by seed and number.
        stopped_by: what broke the run off; None when it was not.
    """

    settings: RunSettings
    workers: int
    model: ModelRecord | None
    serving: Serving | None
    rounds: tuple[RoundRecord, ...]
    stopped_by: str | None

    @property
    def complete(self) -> bool:
        """Whether every round was played."""
        return len(self.rounds) == len(self.settings.seeds) * self.settings.rounds


def _latency_to_json(latency: Latency | None) -> dict[str, float | None] | None:
    return None if latency is None else asdict(latency)


def _latency_from_json(values: Mapping[str, Any] | None) -> Latency | None:
    return None if values is None else Latency(**values)
