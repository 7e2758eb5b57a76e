"""`calibrate`: depth scale and tilt of a view, solved from the support that it sees and whose height is known.

A camera whose depth is wrong by a factor, or that is turned a little, sees a known plane at another height and aslant.
The factor and the turn about the camera that bring the plane back are applied to everything that it sees. What moves
the camera along the plane, or turns it about the plane's normal, leaves no trace there and stays.

Knows no candidate and no network. numpy only; lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tesnet.planes import Array, Mask, basis, cells, fullest, least_squares, outline, robust_sd, spread, within
from tesnet.query import GraspQuery

MOST_SCALE = 0.10
"""Depth is wrong by no larger part than this, or it is another plane that was seen."""
MOST_TILT_DEG = 5.0
"""A view is turned by no more than this."""
MOST_NOISE = 0.010
"""Points that deviate more than this, as a standard deviation, are no plane that anything can be solved from."""
LEAST_AREA = 0.01
"""Square metres of the support in view: fewer tell no tilt."""
LEAST_PEAK = 5.0
"""So many times more of the plane's points lie within one standard deviation of it than between two and three: 16 times
where they are normal; of a slice through things, which has no plane, hardly more than once."""
MOST_BELOW = 0.05
"""Of the plane's own points: so many others may lie just below it; more, and things stand on another one."""

_SAMPLE = 10_000
_FEWEST = 200
_WIDER = 3.0
"""Where nothing is found within `MOST_SCALE`, so many times it is looked through, to tell what is wrong."""
_BANDS = (0.03, 0.02, 0.015, 0.01, 0.01, 0.01)
"""Half thickness of the slab that the plane is fitted in, from coarse to fine."""
_DEVIATIONS = 3.0
_LEAST_BAND = 0.002
_JUST_BELOW = 0.05
_SQUARE = 0.01


@dataclass(frozen=True, eq=False, slots=True)
class Correction:
    """What is done to the points of one view: about its viewpoint they are turned, and moved along their rays.

    Args:
        viewpoint: (3,) of the camera.
        scale: what distances from the viewpoint are multiplied with.
        rotation: (3, 3) what directions from it are turned by.
        noise_sd: robust standard deviation of the support's points about its plane, once corrected.
    """

    viewpoint: Array
    scale: float
    rotation: Array
    noise_sd: float

    @property
    def tilt_deg(self) -> float:
        """Angle of the turn, degrees."""
        return float(np.rad2deg(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1))))

    @property
    def plausible(self) -> bool:
        """Whether it is one that a camera can need."""
        return abs(self.scale - 1) <= MOST_SCALE and self.tilt_deg <= MOST_TILT_DEG

    def apply(self, points: NDArray[np.floating]) -> Array:
        """Where points (N, 3) of the view belong."""
        turned: Array = self.viewpoint + self.scale * ((points - self.viewpoint) @ self.rotation.T)
        return turned


def calibrated(query: GraspQuery) -> tuple[GraspQuery, list[str]]:
    """The query with its points corrected view by view, if it asks for that; and what is to be said of it.

    A view whose correction cannot be found, or is not plausible, stays as it is.
    """
    if not query.calibrate:
        return query, []
    known = _known(query)
    if isinstance(known, str):
        return query, [f"calibrate: {known}; {_KEPT}"]
    up, height, viewpoints = known
    points = query.points.astype(np.float64)
    normals = None if query.normals is None else query.normals.astype(np.float64)
    notes = []
    for view, viewpoint in enumerate(viewpoints):
        seen = np.ones(len(points), dtype=bool) if query.view_index is None else query.view_index == view
        found = correction(points[seen], viewpoint, up, height)
        name = f"calibrate, view {view}" if len(viewpoints) > 1 else "calibrate"
        notes.append(f"{name}: {found if isinstance(found, str) else _figures(found)}")
        if isinstance(found, Correction):
            points[seen] = found.apply(points[seen])
            if normals is not None:
                normals[seen] = normals[seen] @ found.rotation.T
    turned = None if normals is None else normals.astype(np.float32)
    return replace(query, points=points.astype(np.float32), normals=turned), notes


def correction(points: Array, viewpoint: Array, up: Array, height: float) -> Correction | str:
    """What brings the support that a view sees to where it is known to be, or why there is nothing.

    Args:
        points: (N, 3) of the view.
        viewpoint: (3,) that they were seen from.
        up: (3,) unit normal of the support.
        height: of the support along it.
    """
    distance = float(viewpoint @ up) - height
    if distance <= 0:
        return f"the viewpoint lies {-distance:.3f} m below the support: check up, support_height, viewpoint; {_KEPT}"
    sample = spread(points, _SAMPLE).astype(np.float64)
    for widened in (1.0, _WIDER):
        found = _fitted(sample, viewpoint, up, distance, widened * MOST_SCALE)
        if found is not None:
            return found if found.plausible else _implausible(found)
    return (
        f"no support is seen within {MOST_SCALE:.0%} of its distance, {distance:.2f} m below the viewpoint, and "
        f"{MOST_TILT_DEG:g} degrees of up: send the table's points too, {LEAST_AREA * 1e4:g} cm2 or more; {_KEPT}"
    )


_KEPT = "nothing was corrected"


def _known(query: GraspQuery) -> tuple[Array, float, Array] | str:
    """`up`, the height along it and the viewpoints, or which of these is missing."""
    if query.known_up is None or not isinstance(query.support_height, float):
        return "needs up and support_height as numbers, the plane that the support is known to be: give both"
    if query.viewpoints is None:
        return "needs the viewpoint, about which depth is scaled: give it"
    if len(query.viewpoints) > 1 and query.view_index is None:
        return f"{len(query.viewpoints)} viewpoints may each be wrong in its own way: give view_index"
    return query.known_up, query.support_height, query.viewpoints


def _figures(found: Correction) -> str:
    return (
        f"depth is multiplied by {found.scale:.4f} and the view turned by {found.tilt_deg:.2f} degrees about its "
        f"viewpoint, which puts the support seen where it is known to be; its points deviate by "
        f"{1000 * found.noise_sd:.1f} mm"
    )


def _implausible(found: Correction) -> str:
    return (
        f"the plane seen would need depth multiplied by {found.scale:.3f} and a turn of {found.tilt_deg:.1f} degrees "
        f"(limits {1 - MOST_SCALE:g} to {1 + MOST_SCALE:g}, {MOST_TILT_DEG:g} degrees): check support_height, up, "
        f"viewpoint and depth_scale; {_KEPT}"
    )


def _fitted(points: Array, viewpoint: Array, up: Array, distance: float, most: float) -> Correction | None:
    """The correction by the plane with most of the points (N, 3), if one is no further off than a part `most`."""
    rays = points - viewpoint
    depths = -(rays @ up)
    near = np.abs(depths - distance) <= most * distance + _BANDS[0]
    if near.sum() < _FEWEST:
        return None
    normal, offset = up, fullest(-depths[near], _BANDS[-1])
    for band in _BANDS:
        residuals = rays @ normal - offset
        own = near & (np.abs(residuals) <= band)
        if own.sum() < _FEWEST:
            return None
        noise = robust_sd(residuals[own])
        own &= np.abs(residuals - np.median(residuals[own])) <= max(_DEVIATIONS * noise, _LEAST_BAND)
        normal, offset = least_squares(rays[own], up)
    residuals = rays @ normal - offset
    noise = robust_sd(residuals[np.abs(residuals) <= _BANDS[-1]])
    if noise > MOST_NOISE or not _is_support(rays, normal, residuals, max(_DEVIATIONS * noise, _LEAST_BAND)):
        return None
    scale = distance / -offset
    return Correction(viewpoint, scale, _turn(normal, up), scale * noise)


def _is_support(rays: Array, normal: Array, residuals: Array, band: float) -> bool:
    """Whether things can stand on the plane whose own points lie within a band of it."""
    own: Mask = np.abs(residuals) <= band
    if own.sum() < _FEWEST:
        return False
    squares, _, _ = cells(rays[own] @ basis(normal)[:, :2], _SQUARE)
    inner, outer = np.abs(residuals) <= band / 3, own & (np.abs(residuals) > 2 / 3 * band)
    below = (residuals < -band) & (residuals >= -_JUST_BELOW)
    below &= within(rays, outline(rays[own], normal))
    enough = len(squares) * _SQUARE**2 >= LEAST_AREA
    return bool(enough and inner.sum() >= LEAST_PEAK * outer.sum() and below.sum() <= MOST_BELOW * own.sum())


def _turn(start: Array, end: Array) -> Array:
    """The smallest rotation (3, 3) from one unit direction (3,) to another that is not opposite to it."""
    axis = np.cross(start, end)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + cross + cross @ cross / (1.0 + float(start @ end))
    return turn
