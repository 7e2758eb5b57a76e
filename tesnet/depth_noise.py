"""The noise of a plane that a depth camera sees, which grows with the distance from the camera.

Knows bare points and no query. numpy only; lengths in metres.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet.planes import Array, median, spread

NEAR = 0.05
"""From a plane: what is farther is not its noise."""
_SAMPLE = 16_000
"""Points that are looked at."""
_MOST_RANGES, _FEWEST = 8, 50
"""Ranges of distance that are measured, and points below the plane in each."""
_ROUNDS, _CLIPPED_AT = 3, 3.0
"""Of clipping, at so many standard deviations."""


@dataclass(frozen=True, eq=False, slots=True)
class DepthNoise:
    """The standard deviation of a plane's points about it, as a straight line over the distance from the viewpoint.

    That of a depth grows with its square, but the farther a plane is, the more it is seen at a slant.

    Args:
        viewpoints: (V, 3); of several the nearest counts.
        base: at no distance, metres; below 0 where noise begins farther away.
        growth: per metre of distance, 0 or more.
    """

    viewpoints: Array
    base: float
    growth: float

    @classmethod
    def of(cls, points: NDArray[np.floating], over: NDArray[np.floating], viewpoints: Array) -> DepthNoise | None:
        """That of a plane, by points (N, 3) within `NEAR` of it and their heights (N,) over it.

        Nothing but noise is seen below a plane. None where too few points are: then it is not seen.
        """
        rows = spread(np.arange(len(points)), _SAMPLE)
        points, over = points[rows], over[rows]
        distances = _distances(points, viewpoints)
        below = np.sort(distances[over < 0])
        if len(below) < _FEWEST:
            return None
        limits = np.quantile(below, np.linspace(0, 1, min(len(below) // _FEWEST, _MOST_RANGES) + 1))
        measured = [_measured(distances, over, low, high) for low, high in itertools.pairwise(limits)]
        at, sd = np.array(measured).T
        first, second = np.triu_indices(len(at), 1)
        apart = at[second] > at[first]
        slopes = (sd[second] - sd[first])[apart] / (at[second] - at[first])[apart]
        growth = max(0.0, float(np.median(slopes))) if len(slopes) else 0.0  # of Theil and Sen: a few ranges may be off
        return cls(viewpoints, float(np.median(sd - growth * at)), growth)

    def at(self, points: NDArray[np.floating]) -> Array:
        """(N,) the standard deviation at points (N, 3)."""
        return np.maximum(self.base + self.growth * _distances(points, self.viewpoints), 0.0)


def _measured(
    distances: NDArray[np.floating], over: NDArray[np.floating], low: float, high: float
) -> tuple[float, float]:
    """The middle of a range of the points' distances (N,), and the standard deviation of their heights (N,) in it.

    By what is below or, where the plane is taken to be too high, by what is about their median; then by what is as near
    as noise, without things and dents.
    """
    inside = (distances >= low) & (distances <= high)
    below, heights = inside & (over < 0), over[inside]
    deviation = 1.4826 * median(-over[below])
    for _ in range(_ROUNDS):
        away = np.abs(heights - median(heights))
        deviation = min(deviation, 1.4826 * median(away))
        near = away <= _CLIPPED_AT * deviation
        if not near.any():
            break
        heights = heights[near]
    return median(distances[below]), deviation


def _distances(points: NDArray[np.floating], viewpoints: Array) -> Array:
    """(N,) from points (N, 3) to the nearest of the viewpoints (V, 3)."""
    nearest: Array = np.full(len(points), np.inf)
    for viewpoint in viewpoints:
        squares = np.zeros(len(points))
        for column, place in zip(points.T, viewpoint, strict=True):  # several times as fast as all columns at once
            squares += np.square(column - place)
        np.minimum(nearest, squares, out=nearest)
    return np.sqrt(nearest, out=nearest)
