"""Which plane things stand on: `support_height="auto"` and `up="auto"`.

Knows no candidate and no network. numpy only; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet.planes import SQUARE, Array, Mask, Plane, Surfaces, basis, cells, within
from tesnet.query import GraspQuery

LOWEST = 0.003
"""Above the plane, or `DEVIATIONS` of its noise where that is more: what is lower is the plane."""
HIGHEST = 0.35
"""Above the plane: what reaches higher does not stand on it for a hand to take."""
EDGE = 0.02
"""Of an outline."""
DEVIATIONS = 3.0
BELOW = 0.015
MOST_SEEN_THROUGH = 0.15
"""Of a plane's own points: so many others may be seen through it; more, and it is a slice of the air."""
SMALL_AREA = 0.09
MOST_UNDER = 0.2
"""Under the top of a box are its sides. For a plane under `SMALL_AREA` square metres: points straight below it, as a
share of its own."""
LEAST_AREA = 0.008
FEW_THINGS = 15
"""Sampled points: fewer are as likely stray points as things."""
_FEWEST = 32
_USUAL_UP = np.array([0.0, -0.8, -0.6])
"""In the frame of a camera that stands upright and looks down on a table."""
_LEAST_LIKELIHOOD = 0.1


@dataclass(frozen=True, eq=False, slots=True)
class SupportPlane:
    """The plane that things stand on, in the frame of the query.

    Args:
        up: (3,) unit, against gravity.
        height: along it.
        share: of what is seen, 0 to 1.
        noise_sd: robust standard deviation of its points about it.
        sides: (S, 4) unit outward normals across `up`, and distances along them, of its convex outline.
    """

    up: Array
    height: float
    share: float
    noise_sd: float
    sides: Array

    @property
    def clearance(self) -> float:
        """What is lower than this above it is the plane itself."""
        return max(LOWEST, DEVIATIONS * self.noise_sd)


def settled(query: GraspQuery) -> tuple[GraspQuery, SupportPlane | None, list[str]]:
    """The query with what is "auto" in it found, or left out where there is no plane; that plane; and notes."""
    finds_up = isinstance(query.up, str)
    if not finds_up and query.support_height != "auto":
        return query, None, []
    plane = find(query)
    if plane is None:
        return query.but(up=query.known_up, support_height=None), None, [_NO_UP if finds_up else _NO_HEIGHT]
    note = _up_note(plane, query) if finds_up else f"support_height auto: {_figures(plane, query)}"
    return query.but(up=plane.up, support_height=plane.height), plane, [note]


_NO_UP = "up auto: no plane that things stand on was found, so none is kept clear and up is unknown: give up"
_NO_HEIGHT = "support_height auto: no plane across up was found, so no support is kept clear: give the height, or up"


def _up_note(plane: SupportPlane, query: GraspQuery) -> str:
    up = ", ".join(f"{value:.4f}" for value in plane.up)
    tilt = np.rad2deg(np.arccos(np.clip(-plane.up[2], -1, 1)))
    figures = _figures(plane, query)
    return f"up auto: [{up}], {tilt:.0f} degrees from -z: things stand on {figures}; give up where that is not so"


def _figures(plane: SupportPlane, query: GraspQuery) -> str:
    height = plane.height + float(plane.up @ query.offset)
    share, noise = f"{plane.share:.0%} of what is seen", f"noise {1000 * plane.noise_sd:.1f} mm"
    return f"the plane at {height:.4f} m along up, {share}, {noise}"


def region(points: NDArray[np.float32], plane: SupportPlane) -> Mask:
    """Mask (N,) of the points (N, 3) of what stands on a plane: above its noise, to 0.35 m, inside its outline.

    A margin of `EDGE` is left out, where walls and the sides of shelves and bins begin.
    """
    heights = points @ plane.up.astype(points.dtype) - plane.height
    rows = np.flatnonzero((heights > plane.clearance) & (heights <= HIGHEST))
    mask = np.zeros(len(points), dtype=bool)
    mask[rows[within(points[rows], plane.sides - np.array([0, 0, 0, EDGE]))]] = True
    return mask


def find(query: GraspQuery) -> SupportPlane | None:
    """The plane that things stand on, if there is one: across the query's `up`, where it has one.

    Of several it is the one with most of things and surface in view, which is mostly the nearest.
    """
    points = query.points
    if query.workspace is not None:
        points = points[query.workspace.contains(points)]
    if len(points) < _FEWEST:
        return None
    surfaces = Surfaces.of(points)
    eye = None if query.viewpoints is None else query.viewpoints[0]
    if query.known_up is not None:
        planes: Iterable[Plane] = surfaces.planes_across(query.known_up)
        likelihood = False
    else:
        eye = np.zeros(3) if eye is None else eye
        planes = (plane for direction in surfaces.directions() for plane in surfaces.planes_near(direction))
        planes = (plane if eye @ plane.up > plane.height else plane.turned for plane in planes)
        likelihood = not (eye + query.offset).any()
    best, most = None, 0.0
    for plane in planes:
        worth = _worth(plane, surfaces.points, eye)
        if likelihood:
            worth *= max(_LEAST_LIKELIHOOD, float(plane.up @ _USUAL_UP)) ** 2
        if worth > most:
            best, most = plane, worth
    if best is None:
        return None
    return SupportPlane(best.up, best.height, float(best.own.mean()), best.noise_sd, best.sides)


def _worth(plane: Plane, points: Array, eye: Array | None) -> float:
    """How much speaks for a plane; 0 where it is none that things can stand on."""
    u_v_height = points @ basis(plane.up)
    height = u_v_height[:, 2] - plane.height
    squares, square_of, _ = cells(u_v_height[:, :2], SQUARE)
    covered = np.zeros(len(squares), dtype=bool)
    covered[square_of[plane.own]] = True
    area = covered.sum() * SQUARE**2
    own = int(plane.own.sum())
    inside = within(points, plane.sides)
    if area < LEAST_AREA:
        return 0.0
    if area < SMALL_AREA and (inside & (height < -BELOW)).sum() > MOST_UNDER * own:
        return 0.0
    if eye is not None and _seen_through(plane, points, height, eye) > MOST_SEEN_THROUGH * own:
        return 0.0
    above = inside & (height > max(LOWEST, DEVIATIONS * plane.noise_sd))
    top = np.full(len(squares), -np.inf)
    np.maximum.at(top, square_of[above], height[above])
    things = int((above & (top[square_of] <= HIGHEST)).sum())
    return float(np.sqrt(own) * (np.sqrt(things) if things >= FEW_THINGS else 1.0))


def _seen_through(plane: Plane, points: Array, height: Array, eye: Array) -> int:
    """How many points behind the plane are seen where it should hide them."""
    eye_height = float(eye @ plane.up - plane.height)
    if eye_height <= 0:
        return 0
    below = points[height < -BELOW]
    share = eye_height / (eye_height - height[height < -BELOW])
    crossings = eye + share[:, None] * (below - eye)
    shrunk = plane.sides - np.array([0, 0, 0, SQUARE])
    return int(within(crossings, shrunk).sum())
