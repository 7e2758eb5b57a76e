"""Failed attempts sorted by cause: what the hand touched first, whether the camera saw it, how the fingers closed.

The evidence comes from playing recorded rounds again; nothing is asked of a planner. An attempt counts as seeing what
its observation held, the camera's image without noise included.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from simharness.play.records import RoundRecord
from simharness.play.replay import replay
from simharness.play.round import Attempted
from simharness.play.settings import RunSettings
from simharness.report.report import aligned
from simharness.sim.camera import INTRINSICS, Images, Observation
from simharness.sim.execute import Grip
from simharness.sim.hand import HandContact, HandPart
from simharness.sim.objects import ObjectModel
from simharness.sim.outcome_kinds import OutcomeKind
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT
from tesnet.geometry import Pose

Place = Literal[
    "on a seen surface",
    "lower than the crop",
    "outside the perception box",
    "behind its own front",
    "behind something else",
    "beside everything seen",
]
Closing = Literal[
    "never closed",
    "nothing between the fingers",
    "touched on one side",
    "several things, none touched by both fingers",
    "touched by both fingers",
]

SEEN_WITHIN = 0.004
"""Metres: a surface with an observed point so near was seen, one so far behind the image's depth was hidden."""

TABLE = "table"


@dataclass(frozen=True, slots=True)
class FirstContact:
    """What the hand touched first before closing.

    Args:
        part: of the hand.
        touched: name of the object, or TABLE.
        place: where on the object; None on the table.
        position: metres in the world.
        depth: metres by which the surfaces overlapped.
        to_nearest_point: metres from there to the nearest observed point; None where nothing was observed.
    """

    part: HandPart
    touched: str
    place: Place | None
    position: tuple[float, float, float]
    depth: float
    to_nearest_point: float | None

    def __str__(self) -> str:
        part = "palm" if self.part == "palm" else "finger"
        return f"{part}, the table" if self.place is None else f"{part}, an object {self.place}"


@dataclass(frozen=True, slots=True)
class Failure:
    """One failed attempt.

    Args:
        line: of attempts.jsonl, which is what `replay --attempt` takes.
        seed, round, attempt: which attempt it is.
        outcome: how it failed.
        score: that the model gave.
        approach_deg: angle between the approach and straight down.
        height: of the TCP over the table, metres.
        first_contact: before closing; None when there was none.
        closing: what the fingers closed on.
    """

    line: int
    seed: int
    round: int
    attempt: int
    outcome: OutcomeKind
    score: float
    approach_deg: float
    height: float
    first_contact: FirstContact | None
    closing: Closing

    @property
    def cause(self) -> tuple[str, str, str]:
        """What failures are sorted by: outcome, first contact, closing. A hand has no left: both fingers are one."""
        return self.outcome, str(self.first_contact or "none"), self.closing


def failures(
    settings: RunSettings, objects: Sequence[ObjectModel], rounds: Sequence[RoundRecord], limit: int
) -> Iterator[Failure]:
    """The earliest failed attempts of a run, at most `limit`, with their causes.

    Args:
        settings: of the run.
        objects: the run's object set.
        rounds: the recorded rounds.
        limit: how many.

    Raises:
        UsageError: an attempt ended otherwise than recorded; the objects or the simulator are others.
    """
    first_line = 0
    for played in rounds:
        failed = [attempt.attempt for attempt in played.attempts if not attempt.success][:limit]
        limit -= len(failed)
        if failed:
            events = replay(settings, objects, played, failed[-1])
            yield from (examine(events[number], first_line + number) for number in failed)
        first_line += len(played.attempts)


def examine(event: Attempted, line: int) -> Failure:
    """The cause of one failed attempt, whose observation holds body ids."""
    record = event.record
    contact = event.outcome.first_contact
    down = -float(record.T_world_grasp[2, 2])
    return Failure(
        line=line,
        seed=record.seed,
        round=record.round,
        attempt=record.attempt,
        outcome=record.outcome,
        score=record.score,
        approach_deg=float(np.rad2deg(np.arccos(np.clip(down, -1.0, 1.0)))),
        height=float(record.T_world_grasp[2, 3]) - TABLE_HEIGHT,
        first_contact=None if contact is None else _described(contact, event.before.view, event.before.objects),
        closing=_closing(event.outcome.closed),
    )


def place_of(position: Float64[np.ndarray, 3], body: int, view: Observation) -> Place:
    """How a position on a body's surface (metres in the world) relates to what was observed."""
    distance = _to_nearest_point(position, view)
    if distance is not None and distance <= SEEN_WITHIN:
        return "on a seen surface"
    if position[2] < PERCEPTION_BOX.minimum[2]:
        return "lower than the crop"
    if (position < PERCEPTION_BOX.minimum).any() or (position > PERCEPTION_BOX.maximum).any():
        return "outside the perception box"
    hiding = [
        _hiding_body(position, images, Pose.from_matrix(matrix))
        for images, matrix in zip(view.images, view.Ts_world_camera, strict=True)
    ]
    if None in hiding:
        return "beside everything seen"
    return "behind its own front" if body in hiding else "behind something else"


def failures_report(found: Sequence[Failure], attempts: int, failed: int) -> dict[str, Any]:
    """The content of failures.json: causes by frequency, then every failure; lengths in metres.

    Args:
        found: the failures that were sorted.
        attempts: how many attempts the run has.
        failed: how many of them failed.
    """
    causes = [
        {
            "outcome": outcome,
            "first_contact": contact,
            "closing": closing,
            "count": len(members),
            **_medians(members),
            "lines": [failure.line for failure in members],
        }
        for (outcome, contact, closing), members in _sorted(found)
    ]
    return {
        "attempts": attempts,
        "failed": failed,
        "sorted": len(found),
        "causes": causes,
        "failures": [asdict(failure) for failure in found],
    }


def failures_table(content: Mapping[str, Any]) -> str:
    """The causes in `failures_report` as lines of text, the most frequent first."""
    heading = ("count", "outcome", "first contact before closing", "closing", "score", "tilt", "height", "lines")
    rows = [heading]
    for cause in content["causes"]:
        shown = ", ".join(str(line) for line in cause["lines"][:4])
        more = ", ..." if len(cause["lines"]) > 4 else ""
        rows.append(
            (
                str(cause["count"]),
                cause["outcome"],
                cause["first_contact"],
                cause["closing"],
                f"{cause['score']:.2f}",
                f"{cause['approach_deg']:.0f} deg",
                f"{1000 * cause['height']:.0f} mm",
                shown + more,
            )
        )
    counted = f"{content['sorted']} of {content['failed']} failures in {content['attempts']} attempts"
    note = "score, tilt of the approach from straight down and height of the TCP over the table are medians"
    return "\n".join([counted, "", *aligned(rows), "", note])


def _described(contact: HandContact, view: Observation, objects: Mapping[int, str]) -> FirstContact:
    position = np.array(contact.position)
    return FirstContact(
        part=contact.part,
        touched=objects.get(contact.body, TABLE),
        place=place_of(position, contact.body, view) if contact.body in objects else None,
        position=contact.position,
        depth=contact.depth,
        to_nearest_point=_to_nearest_point(position, view),
    )


def _to_nearest_point(position: Float64[np.ndarray, 3], view: Observation) -> float | None:
    if not len(view.points_world):
        return None
    return float(np.linalg.norm(view.points_world - position, axis=1).min())


def _hiding_body(position: Float64[np.ndarray, 3], images: Images, T_world_camera: Pose) -> int | None:
    """The body in front of a position in an image; None where the position is in sight or outside the image."""
    x, y, z = T_world_camera.inverse().apply(position)
    column, row = round(INTRINSICS.fx * x / z + INTRINSICS.cx), round(INTRINSICS.fy * y / z + INTRINSICS.cy)
    if z <= 0 or not (0 <= column < INTRINSICS.width and 0 <= row < INTRINSICS.height):
        return None
    depth = float(images.depth[row, column])
    return int(images.segmentation[row, column]) if 0 < depth < z - SEEN_WITHIN else None


def _closing(grip: Grip | None) -> Closing:
    if grip is None:
        return "never closed"
    if grip.empty or not grip.touched:
        return "nothing between the fingers"
    if grip.pinched:
        return "touched by both fingers"
    return "touched on one side" if len(grip.touched) == 1 else "several things, none touched by both fingers"


def _sorted(found: Sequence[Failure]) -> list[tuple[tuple[str, str, str], list[Failure]]]:
    groups: dict[tuple[str, str, str], list[Failure]] = defaultdict(list)
    for failure in found:
        groups[failure.cause].append(failure)
    return sorted(groups.items(), key=lambda group: (-len(group[1]), group[0]))


def _medians(members: Sequence[Failure]) -> dict[str, float]:
    return {
        "score": median(failure.score for failure in members),
        "approach_deg": median(failure.approach_deg for failure in members),
        "height": median(failure.height for failure in members),
    }
