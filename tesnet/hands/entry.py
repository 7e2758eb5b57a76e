"""What the file of each hand says: its sizes and what else is known of it."""

from __future__ import annotations

from dataclasses import dataclass

from tesnet.geometry import Gripper


@dataclass(frozen=True, slots=True)
class KnownHand:
    """A hand that is sold.

    Args:
        gripper: its sizes, and its name.
        min_force, max_force: what it can be told to press with, newtons.
        max_payload: what it carries by friction, kilograms.
        simulated: whether results in simulation are claimed for it.
    """

    gripper: Gripper
    min_force: float
    max_force: float
    max_payload: float
    simulated: bool
