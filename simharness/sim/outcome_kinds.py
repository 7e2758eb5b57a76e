"""What can become of a grasp: every kind of outcome with its code, its meaning and its colour. Knows no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

OutcomeKind = Literal["success", "pregrasp", "approach", "slip", "drop"]

OUTCOME_KINDS: tuple[OutcomeKind, ...] = get_args(OutcomeKind)
"""A kind's place is its code in label files: new kinds come last."""

FAILURE_KINDS: tuple[OutcomeKind, ...] = tuple(kind for kind in OUTCOME_KINDS if kind != "success")


@dataclass(frozen=True, slots=True)
class OutcomeWords:
    """How a kind of outcome is shown to people.

    Args:
        meaning: in some words.
        colour: on pages, as in CSS.
    """

    meaning: str
    colour: str


OUTCOMES: Mapping[OutcomeKind, OutcomeWords] = {
    "success": OutcomeWords("lifted and held", "#16a34a"),
    "pregrasp": OutcomeWords("contact before the approach", "#7c3aed"),
    "approach": OutcomeWords("contact on the way", "#d97706"),
    "slip": OutcomeWords("nothing held after closing", "#dc2626"),
    "drop": OutcomeWords("lost while lifting", "#0284c7"),
}
