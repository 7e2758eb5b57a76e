"""What every decoder gives, and the checks that they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.errors import Undecodable
from tesnet.errors import TooManyPoints

Points = NDArray[np.float32]
RawOptions = Mapping[str, bytes]
"""Option name -> its value as JSON text."""


@dataclass(frozen=True, eq=False, slots=True)
class Payload:
    """A decoded body.

    Args:
        points: (N, 3) float32 in the cloud frame, not yet checked.
        options: that came with them.
        is_point: (R,) mask of the posted rows or pixels that have become points; None is all of them.
        mask: (R,) mask of the rows or pixels that show the target; None where no mask was posted.
        viewpoint: (3,) position of the camera in the cloud frame, where the body tells it.
    """

    points: Points
    options: RawOptions = field(default_factory=dict)
    is_point: NDArray[np.bool_] | None = None
    mask: NDArray[np.bool_] | None = None
    viewpoint: NDArray[np.float64] | None = None


def refuse_empty(body: bytes | bytearray | memoryview, what: str = "body") -> None:
    """Raise `Undecodable` for no bytes at all."""
    if not len(body):
        raise Undecodable(f"The {what} is empty; send the points of a cloud.")


def check_count(count: int, max_points: int) -> None:
    """Raise `TooManyPoints` above the limit."""
    if count > max_points:
        raise TooManyPoints(count, max_points)


def as_float32(array: NDArray[np.generic]) -> Points:
    """The array as contiguous float32; what overflows becomes infinite, and is refused as that."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=np.float32)
