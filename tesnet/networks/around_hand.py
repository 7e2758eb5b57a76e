"""Where a network looks for what matters to a hand: boxes and places on and about it.

They are the Franka hand's, and go with another's sizes; those at the fingers move with each candidate's opening. Knows
no cloud. Lengths are metres, places lie in the grasp frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.geometry import PANDA, Gripper

Region = tuple[float, float, float, float]
"""Half extents along x and y, and extents along -z and +z from the TCP."""


PROBES, PROBES_IN_FINGERS = 105, 60
"""Of a hand: in all, and how many of the first ones stand in the fingers."""


@dataclass(frozen=True, eq=False, slots=True)
class Places:
    """Places about a hand.

    Args:
        open: (S, 3) where they are as the hand is open.
        with_finger: (S,) how far each moves along y where the finger at its positive side moves by one.
    """

    open: Tensor
    with_finger: Tensor

    def of(self, candidates: Candidates) -> Tensor:
        """(C, S, 3) where they are about each candidate's hand."""
        widths = candidates.widths
        places = self.open.to(widths.device).expand(len(widths), -1, -1).clone()
        places[:, :, 1] += self.with_finger.to(widths.device) * _outward(candidates)[:, None]
        return places


def ends(hand: Gripper) -> Places:
    """Seven: the TCP, and tips, roots of the fingers and ends of the palm, outermost."""
    finger, _, palm = hand.parts
    outer = hand.max_width / 2 + 0.012 * _ratio(hand, "finger_thickness")
    outermost = [
        (side * y, z, side * moves)
        for y, z, moves in (
            (outer, finger.front, 1.0),
            (outer, finger.back, 1.0),
            (palm.thickness.full / 2 - 0.002, palm.front - 0.01, 0.0),
        )
        for side in (-1, 1)
    ]
    return _places([(0.0, 0.0, 0.0, 0.0), *((0.0, *place) for place in outermost)])


def probes(hand: Gripper) -> Places:
    """`PROBES`, where it matters what the camera did not see: in the fingers, between, ahead of them, in the palm."""
    finger, _, palm = hand.parts
    tip, half = finger.front, hand.max_width / 2
    x = finger.breadth.full / 2 - 0.0015
    longer, thicker, wider = (_ratio(hand, size) for size in ("finger_length", "finger_thickness", "max_width"))
    fingers = [
        (x * side_x, side * (half + across * thicker), z, side)
        for side_x in (-1, 1)
        for side in (-1, 1)
        for z in (*(tip - behind * longer for behind in (0.0, 0.0116, 0.0226, 0.0346)), finger.back)
        for across in (0.001, 0.012, 0.024)
    ]
    between = [
        (x, y * wider, z, y * wider / half)
        for x in (side_x * 0.008 * _ratio(hand, "finger_breadth") for side_x in (-1, 1))
        for y in (-0.03, -0.015, 0.0, 0.015, 0.03)
        for z in (tip, tip - 0.0186 * longer, tip - 0.0336 * longer)
    ]
    ahead = [(0.0, y * wider, tip + 0.012, y * wider / half) for y in (-0.05, -0.025, 0.0, 0.025, 0.05)]
    end = palm.thickness.full / 2 - 0.012
    behind = [
        (x, y * end, palm.front - 0.01, 0.0)
        for x in (side_x * 0.02 * _ratio(hand, "palm_front_breadth") for side_x in (-1, 1))
        for y in (-1, -0.5, 0.0, 0.5, 1)
    ]
    return _places(fingers + between + ahead + behind)


def region_about(region: Region, candidates: Candidates) -> tuple[float, Tensor, float, float]:
    """As far about each candidate's fingers, tips and palm as a region lies about those of the open Franka hand.

    Its half extent along y, (C,), differs with the opening.
    """
    hand = candidates.gripper
    breadth, length, behind, ahead = region
    return (
        breadth + (hand.finger_breadth - PANDA.finger_breadth) / 2,
        length + (hand.max_width - PANDA.max_width) / 2 + _outward(candidates),
        behind + PANDA.palm_front - hand.palm_front,
        ahead + hand.tip_offset - PANDA.tip_offset,
    )


def _outward(candidates: Candidates) -> Tensor:
    """(C,) how far each finger is outwards of where it is as the hand is open: exactly zero there, else negative."""
    return (candidates.widths - candidates.gripper.max_width) / 2


def _ratio(hand: Gripper, size: str) -> float:
    return float(getattr(hand, size) / getattr(PANDA, size))


def _places(rows: list[tuple[float, float, float, float]]) -> Places:
    """From rows of x, y, z and `with_finger`."""
    table = torch.tensor(rows)
    return Places(table[:, :3].contiguous(), table[:, 3].contiguous())
