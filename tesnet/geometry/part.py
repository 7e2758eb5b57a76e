"""A part of a hand: a box that tapers towards its front, and where it is as the hand opens.

Everything that is drawn, checked or simulated of a hand follows from its parts. They know no hand as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

PartName = Literal["left finger", "right finger", "palm"]

ROUNDED = 0.007
"""Metres over which the tip of a finger is rounded off."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How far a part extends across the direction of travel, metres: evenly more from its front, then the same.

    Args:
        full: what it grows to.
        front: at the part's very front.
        taper: over how much of the part's depth it grows; 0 where it does not.
    """

    full: float
    front: float
    taper: float

    @classmethod
    def constant(cls, full: float) -> Extent:
        """The same all along the part."""
        return cls(full, full, 0.0)

    def at(self, behind: float) -> float:
        """The extent at a distance behind the part's front, metres."""
        if behind >= self.taper:
            return self.full
        return self.front + behind / self.taper * (self.full - self.front)


@dataclass(frozen=True, slots=True)
class Section:
    """A part's cross-section: a rectangle at `z`, as broad along x and as thick along y as it says, metres."""

    z: float
    breadth: float
    thickness: float


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of a hand, metres, in the grasp frame; it is convex, and symmetric about x = 0.

    Args:
        name: what it is called.
        side: 0 where it lies about the hand's middle and stays as the hand opens; +1 or -1 for a finger, whose inner
            face is half the opening from the middle to that side, along y.
        front, back: where it ends along z.
        breadth: its extent along x.
        thickness: its extent along y: about the middle, or outwards from a finger's inner face.
        tip_breadth: its extent along x at the very front, if that is rounded off over `ROUNDED`.
    """

    name: PartName
    side: Literal[-1, 0, 1]
    front: float
    back: float
    breadth: Extent
    thickness: Extent
    tip_breadth: float | None = None

    @property
    def sections(self) -> tuple[Section, ...]:
        """Cross-sections from front to back; the part is the convex hull of them."""
        changes = {self.breadth.taper, self.thickness.taper} | ({ROUNDED} if self.tip_breadth is not None else set())
        between = [
            self._section(self.front - behind, behind)
            for behind in sorted(changes)
            if 0 < behind < self.front - self.back
        ]
        return self._section(self.front, 0.0), *between, self._section(self.back, self.front - self.back)

    def _section(self, z: float, behind: float) -> Section:
        breadth = self.breadth.at(behind)
        if self.tip_breadth is not None:
            breadth = min(breadth, Extent(self.breadth.full, self.tip_breadth, ROUNDED).at(behind))
        return Section(z, breadth, self.thickness.at(behind))

    def span(self, thickness: float, width: float) -> tuple[float, float]:
        """Where a cross-section of this thickness begins and ends along y, as the hand is open by `width`."""
        if not self.side:
            return -thickness / 2, thickness / 2
        return self.side * (width / 2), self.side * (width / 2 + thickness)

    def corners(self, width: float) -> NDArray[np.float64]:
        """Corners (K, 3) of the cross-sections, as the hand is open by `width`; the part is their convex hull."""
        return np.array(
            [
                (x, y, section.z)
                for section in self.sections
                for y in self.span(section.thickness, width)
                for x in (-section.breadth / 2, section.breadth / 2)
            ]
        )
