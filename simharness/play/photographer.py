"""Which attempts a report shows, and the pictures of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from simharness.play.pictures import (
    FAILURE_COLOUR,
    SUCCESS_COLOUR,
    close_up,
    cloud_picture,
    png,
    point_colours,
    segmentation_colours,
    widen,
)
from simharness.play.records import AttemptRecord, RoundRecord
from simharness.play.round import Attempted, Observed
from simharness.play.settings import RunSettings
from simharness.sim.camera import INTRINSICS
from tesnet.geometry import Pose

VIEWS = ("colour", "segmentation", "cloud")

FIRST_ROUNDS = 4
"""The first attempt of so many rounds is shown, whatever its outcome."""

FAILURES = 8
"""So many failures are shown, the earliest ones."""

_ROUNDS_WITH_FAILURES = 24
"""Failures are looked for in so many rounds; later rounds take no pictures."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG and its file's name."""

    name: str
    content: bytes


def picture_name(attempt: AttemptRecord, view: str) -> str:
    """File name of one of the VIEWS of an attempt."""
    return f"seed{attempt.seed}-round{attempt.round:04d}-attempt{attempt.attempt:02d}-{view}.png"


def attempts_to_show(rounds: Iterable[RoundRecord], seed: int) -> list[AttemptRecord]:
    """The attempts of a run that its report shows: at most FIRST_ROUNDS + FAILURES, chosen by the results alone."""
    attempts = [attempt for record in rounds for attempt in record.attempts if attempt.seed == seed]
    attempts.sort(key=lambda attempt: (attempt.round, attempt.attempt))
    first = [attempt for attempt in attempts if _is_first(attempt)]
    failures = [attempt for attempt in attempts if _is_failure(attempt) and not _is_first(attempt)]
    return first + failures[:FAILURES]


class Photographer:
    """Takes the pictures that a report may need, as rounds are played.

    Args:
        settings: of the run; only its first seed is pictured.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._seed = settings.seeds[0]

    def wants(self, seed: int, round_number: int) -> bool:
        """Whether anything of a round may be shown."""
        return seed == self._seed and round_number < max(FIRST_ROUNDS, _ROUNDS_WITH_FAILURES)

    def __call__(self, event: Observed | Attempted) -> list[Picture]:
        """The pictures of an attempt that may be shown; none of anything else."""
        if not isinstance(event, Attempted) or event.record.seed != self._seed:
            return []
        return take_pictures(event) if _is_first(event.record) or _is_failure(event.record) else []


def take_pictures(event: Attempted) -> list[Picture]:
    """The pictures of an attempt."""
    return [Picture(picture_name(event.record, view), content) for view, content in attempt_pictures(event).items()]


def keep_only(pictures: Path, shown: Iterable[AttemptRecord]) -> None:
    """Remove the pictures in a folder that are of other attempts."""
    names = {picture_name(attempt, view) for attempt in shown for view in VIEWS}
    for path in pictures.glob("seed*-*.png"):
        if path.name not in names:
            path.unlink()


def attempt_pictures(event: Attempted) -> dict[str, bytes]:
    """PNGs by the names in VIEWS: what the camera saw before an attempt, and the grasp in the cloud."""
    images = event.before.view.images[0]
    colour = SUCCESS_COLOUR if event.record.success else FAILURE_COLOUR
    cloud = cloud_picture(
        event.before.view.points_world,
        observed_colours(event.before),
        event.record.T_world_grasp,
        event.record.width,
        colour,
        event.before.view.viewpoints[0],
        event.before.gripper,
    )
    segmentation = segmentation_colours(images.segmentation, event.before.objects)
    part = close_up(images.segmentation, event.before.objects)
    return {
        "colour": png(images.colour[part]),
        "segmentation": png(segmentation[part]),
        "cloud": png(cloud),
    }


def observed_colours(observed: Observed) -> UInt8[np.ndarray, "points 3"]:
    """Colours of a cloud's points, from the objects in the first camera's image."""
    view = observed.view
    images = view.images[0]
    # Noise moves points at an object's edge over the table's pixels; the table itself is in no cloud.
    colour = widen(images.colour, np.isin(images.segmentation, list(observed.objects)))
    return point_colours(view.points_world, colour, Pose.from_matrix(view.Ts_world_camera[0]), INTRINSICS)


def _is_first(attempt: AttemptRecord) -> bool:
    return attempt.attempt == 0 and attempt.round < FIRST_ROUNDS


def _is_failure(attempt: AttemptRecord) -> bool:
    return not attempt.success and attempt.round < _ROUNDS_WITH_FAILURES
