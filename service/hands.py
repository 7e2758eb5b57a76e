"""Hands as the wire has them: a request's option -> a `Gripper`, and a `Gripper` -> its description in answers."""

from __future__ import annotations

import difflib
from dataclasses import asdict
from typing import Any

from service.errors import Invalid, shortened
from service.schemas import GripperSize
from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS, KnownHand


def gripper_of(option: GripperSize | str | None) -> Gripper:
    """The hand that a request asks for.

    Raises:
        Invalid: no such name, or sizes that no hand has.
    """
    if option is None:
        return PANDA
    if isinstance(option, str):
        return _known(option)
    hand = PANDA if option.name is None else _known(option.name)
    sizes = option.model_dump(exclude_unset=True, exclude={"name"})
    if not sizes:
        return hand
    try:
        return hand.with_sizes(sizes)
    except ValueError as error:
        raise Invalid("gripper", str(error)) from None


def _known(name: str) -> Gripper:
    if name not in HANDS:
        close = difflib.get_close_matches(name, HANDS, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise Invalid(
            "gripper", f"{shortened(name)} is no known hand; {hint}valid: {', '.join(HANDS)}, or give its sizes"
        )
    return HANDS[name].gripper


def described(hand: Gripper) -> dict[str, Any]:
    """The fields of a `service.schemas.GripperOut`."""
    parts = [
        {"name": part.name, "side": part.side, "sections": [asdict(section) for section in part.sections]}
        for part in hand.parts
    ]
    return {"name": hand.name, **hand.sizes(), "parts": parts}


def described_known(hand: KnownHand) -> dict[str, Any]:
    """The fields of a `service.schemas.HandOut`."""
    return {
        **described(hand.gripper),
        "min_force": hand.min_force,
        "max_force": hand.max_force,
        "max_payload": hand.max_payload,
        "simulated": hand.simulated,
    }
