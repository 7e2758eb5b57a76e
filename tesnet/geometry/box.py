"""Axis-aligned boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry.pose import frozen


@dataclass(frozen=True, eq=False, slots=True)
class Box:
    """Axis-aligned box, metres, in the frame of the points that it is about.

    Args:
        minimum, maximum: its corners (3,).

    Raises:
        ValueError: a minimum that is not below its maximum, wrong shapes, or values that are not finite.
    """

    minimum: NDArray[np.float64]
    maximum: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("minimum", "maximum"):
            object.__setattr__(self, name, frozen(getattr(self, name), (3,), name))
        if not (self.minimum < self.maximum).all():
            raise ValueError(f"min {self.minimum.tolist()} is not below max {self.maximum.tolist()} on every axis")

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Mask (N,) of the points (N, 3) that lie in it, its sides included."""
        inside: NDArray[np.bool_] = np.all((points >= self.minimum) & (points <= self.maximum), axis=1)
        return inside
