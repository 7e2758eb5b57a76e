"""Which plane things stand on: `support_height="auto"` and `up="auto"`.

Knows no candidate and no network. numpy only; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tesnet import plausibility
from tesnet.depth_noise import NEAR, DepthNoise
from tesnet.planes import (
    SQUARE,
    TALLEST,
    Array,
    Mask,
    Plane,
    Surfaces,
    basis,
    cells,
    grown,
    left_out,
    spread,
    within,
)
from tesnet.query import GraspQuery

LOWEST = 0.003
"""Above the plane, or `DEVIATIONS` of its noise there where that is more: what is lower is the plane."""
EDGE = 0.02
"""Of an outline."""
DEVIATIONS = 4.0
"""Standard deviations over which noise lifts but a few of a hundred thousand points."""
BELOW = 0.015
MOST_SEEN_THROUGH = 0.15
"""Of a plane's own points: so many others may be seen through it; more, and it is a slice of the air.

Besides, as many as its own may be seen in its recesses.
"""
SMALL_AREA = 0.09
MOST_UNDER = 0.2
"""Under the top of a box are its sides. For a plane under `SMALL_AREA` square metres: points straight below it, down to
`TALLEST`, as a share of its own."""
LEAST_AREA, LEAST_WORTH = 0.008, 0.1
"""What is smaller is no support, and under `SMALL_AREA` what less speaks for than such a part of the most."""
LARGE_SHARE = 0.2
"""Of what is seen."""
MOST_LOOKED_AT, FEW_THINGS = 64_000, 30
"""Points among which things are looked for, and how many of them: fewer are as likely stray points as things."""
_FEWEST = 32
_USUAL_UP = np.array([0.0, -0.8, -0.6])
"""In the frame of a camera that stands upright and looks down on a table."""
_LEAST_LIKELIHOOD = 0.25


@dataclass(frozen=True, eq=False, slots=True)
class SupportPlane:
    """The plane that things stand on, in the frame of the query.

    Args:
        up: (3,) unit, against gravity.
        height: along it.
        share: of what is seen, 0 to 1.
        area: of it that is seen, square metres.
        noise_sd: robust standard deviation of its points about it.
        sides: (S, 4) unit outward normals across `up`, and distances along them, of its convex outline.
        noise: where, by the distance from the camera.
    """

    up: Array
    height: float
    share: float
    area: float
    noise_sd: float
    sides: Array
    noise: DepthNoise

    def clearance(self, points: NDArray[np.floating]) -> Array:
        """(N,) over points (N, 3) or under them: what is lower than this above the plane is the plane itself."""
        return np.maximum(LOWEST, DEVIATIONS * self.noise.at(points))


def settled(query: GraspQuery) -> tuple[GraspQuery, SupportPlane | None, list[str]]:
    """The query with what is "auto" in it found, or left out where there is no plane; that plane; and notes."""
    finds_up = isinstance(query.up, str)
    if not finds_up and query.support_height != "auto":
        return query, None, _forgotten(query)
    plane = find(query)
    if plane is None:
        wrong = None if finds_up else _reversed(query)
        if wrong is not None:
            return query.but(up=None, support_height=None), None, [f"{wrong}; here it was left out"]
        return query.but(up=query.known_up, support_height=None), None, [_NO_UP if finds_up else _NO_HEIGHT]
    note = _up_note(plane, query) if finds_up else f"support_height auto: {_figures(plane, query)}"
    return query.but(up=plane.up, support_height=plane.height), plane, [note]


_NO_UP = "up auto: no plane that things stand on was found, so none is kept clear and up is unknown: give up"
_NO_HEIGHT = "support_height auto: no plane across up was found, so no support is kept clear: give the height, or up"


def _forgotten(query: GraspQuery) -> list[str]:
    """What is to be said where up is given alone: of a large plane, which is then grasped like things, or of up."""
    if query.known_up is None or query.support_height is not None:
        return []
    plane = find(query)
    if plane is None and (wrong := _reversed(query)) is not None:
        return [wrong]
    if plane is None or plane.share < LARGE_SHARE or plane.area < SMALL_AREA:
        return []
    note = f"support_height not given: grasps are looked for on {_figures(plane, query)}, too; give that height, or "
    return [f'{note}support_height: "auto"']


def _reversed(query: GraspQuery) -> str | None:
    """What is to be said where `up`, turned round, has the plane that it lacks, seen by a camera that is known."""
    if query.known_up is None or query.viewpoints is None:
        return None
    plane = find(query.but(up=-query.known_up))
    return None if plane is None else plausibility.reversed_up(query.viewpoints @ -plane.up, -plane.height)


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
    rows = np.flatnonzero((heights > LOWEST) & (heights <= TALLEST))
    rows = rows[heights[rows] > plane.clearance(points[rows])]
    mask = np.zeros(len(points), dtype=bool)
    mask[rows[within(points[rows], plane.sides - np.array([0, 0, 0, EDGE]))]] = True
    return mask


def find(query: GraspQuery) -> SupportPlane | None:
    """The plane that things stand on, if there is one: across the query's `up`, where it has one.

    Of several that are parallel it is the nearest to the camera with things on it; of several directions, that with
    most of things and surface in view.
    """
    points = query.points
    if query.workspace is not None:
        points = points[query.workspace.contains(points)]
    if len(points) < _FEWEST:
        return None
    surfaces, looked_at = Surfaces.of(points), spread(points, MOST_LOOKED_AT)
    viewpoints = np.zeros((1, 3)) if query.viewpoints is None else query.viewpoints
    eye = None if query.viewpoints is None and query.known_up is not None else viewpoints[0]
    likely = query.known_up is None and not (viewpoints[0] + query.offset).any()
    best, most = None, 0.0
    for planes in _parallel(surfaces, query.known_up, eye):
        looked_for = (_judged(plane, surfaces, looked_at, viewpoints, eye) for plane in planes)
        judged = [one for one in looked_for if one is not None]
        worth = max((one.worth for one in judged), default=0.0)
        if likely:
            worth *= max(_LEAST_LIKELIHOOD, float(planes[0].up @ _USUAL_UP)) ** 4
        if worth > most:
            best, most = _nearest(judged), worth
    return None if best is None else best.support


def _parallel(surfaces: Surfaces, up: Array | None, eye: Array | None) -> Iterator[list[Plane]]:
    """The planes whose upper side the eye sees, if it is known where that is, those together that are parallel.

    Across `up` or, without it, in any direction.
    """
    if up is not None:
        groups = [list(surfaces.planes_across(up))]
    else:
        found = [list(surfaces.planes_near(direction)) for direction in surfaces.directions()]
        groups = [*found, *([plane.turned for plane in planes] for planes in found)]
    for group in groups:
        if seen := [plane for plane in group if eye is None or eye @ plane.up > plane.height]:
            yield seen


@dataclass(frozen=True, eq=False, slots=True)
class _Judged:
    """A plane that may be the support.

    Args:
        support: as it would be.
        worth: how much speaks for it.
        has_things: whether some stand on it.
    """

    support: SupportPlane
    worth: float
    has_things: bool


def _nearest(judged: list[_Judged]) -> _Judged:
    """Of parallel planes the highest with things on it, which is nearest to the camera; or else the worthiest.

    The tops of a few boxes are none where much more speaks for what these stand on.
    """
    least = LEAST_WORTH * max(one.worth for one in judged)
    usual = [one for one in judged if one.has_things and (one.support.area >= SMALL_AREA or one.worth >= least)]
    return max(usual, key=lambda one: one.support.height) if usual else max(judged, key=lambda one: one.worth)


def _judged(
    plane: Plane, surfaces: Surfaces, looked_at: NDArray[np.float32], viewpoints: Array, eye: Array | None
) -> _Judged | None:
    """What speaks for a plane that things can stand on, by the surfaces that it is one of and more points (N, 3)."""
    area = _area(plane, surfaces.points)
    if not _is_surface(plane, area, surfaces.points, eye):
        return None
    over = looked_at @ plane.up.astype(looked_at.dtype) - plane.height
    about = np.flatnonzero(np.abs(over) <= NEAR)
    about = about[within(looked_at[about], plane.sides)]
    noise = DepthNoise.of(looked_at[about], over[about], viewpoints)
    noise = DepthNoise(viewpoints, plane.noise_sd, 0.0) if noise is None else noise
    share = float(plane.own.mean())
    support = SupportPlane(plane.up, plane.height, share, area, plane.noise_sd, plane.sides, noise)
    things = _things(looked_at, support)
    has_things = things >= FEW_THINGS
    share_of_things = things / len(looked_at) if has_things else 1.0 / len(looked_at)
    return _Judged(support, float(np.sqrt(share * share_of_things)), has_things)


def _things(points: NDArray[np.float32], plane: SupportPlane) -> int:
    """How many of the points (N, 3) are of things on a plane: of its region, but of nothing that reaches higher."""
    over = points @ plane.up.astype(points.dtype) - plane.height
    above = points[over > LOWEST]
    things = region(above, plane)
    if not things.any():
        return 0
    squares, square_of, _ = cells(above @ basis(plane.up)[:, :2].astype(points.dtype), SQUARE)
    tall = np.bincount(square_of[over[over > LOWEST] > TALLEST], minlength=len(squares)) > 0
    return int((things & ~tall[square_of]).sum())


def _area(plane: Plane, points: Array) -> float:
    """Square metres of a plane that are covered by its own of the points (P, 3)."""
    squares, _, _ = cells(points[plane.own] @ basis(plane.up)[:, :2], SQUARE)
    return len(squares) * SQUARE**2


def _is_surface(plane: Plane, area: float, points: Array, eye: Array | None) -> bool:
    """Whether a plane among the points (P, 3) is one that things can stand on, where the eye is known seen from it."""
    height, own = points @ plane.up - plane.height, int(plane.own.sum())
    if area < LEAST_AREA:
        return False
    under = (height < -BELOW) & (height > -TALLEST)
    if area < SMALL_AREA and (within(points, plane.sides) & under).sum() > MOST_UNDER * own:
        return False
    return eye is None or _hides(plane, points, height, eye)


def _hides(plane: Plane, points: Array, height: Array, eye: Array) -> bool:
    """Whether hardly any of the points (P, 3) below it are seen through the plane, its recesses left out.

    Heights (P,) are over the plane.
    """
    own, most = int(plane.own.sum()), MOST_SEEN_THROUGH * plane.own.sum()
    through = _crossings(plane, points[height < -BELOW], eye)
    inside = within(through, plane.sides - np.array([0, 0, 0, SQUARE]))
    if inside.sum() <= most:
        return True
    near = within(through, plane.sides + np.array([0, 0, 0, 3 * SQUARE]))
    through, inside = through[near], inside[near]
    standing = (height > BELOW) & (height < min(TALLEST, float(eye @ plane.up - plane.height)))
    hidden = _crossings(plane, points[standing], eye)
    solid = np.concatenate([points[plane.own], hidden[within(hidden, plane.sides)]])
    in_recess = inside & _in_recess(plane, through, solid)
    return bool(in_recess.sum() <= own and (inside & ~in_recess).sum() <= most)


def _crossings(plane: Plane, points: Array, eye: Array) -> Array:
    """(N, 3) where the lines from the eye (3,) to points (N, 3) meet the plane."""
    sights = points - eye
    eye_height = eye @ plane.up - plane.height
    return eye - (eye_height / (sights @ plane.up))[:, None] * sights


def _in_recess(plane: Plane, through: Array, solid: Array) -> Mask:
    """Mask (K,) of the places of a plane that lie in holes without a way out, such as that of a sink.

    Out of its outline, that is, to where others are seen through it, too. What is no wider than two squares is a gap
    between things, and no way.

    Args:
        plane: the plane.
        through: (K, 3) places where others are seen through it.
        solid: (S, 3) places where it is seen, or hidden behind what stands on it.
    """
    across = basis(plane.up)[:, :2]
    index = np.floor(np.concatenate([through, solid]) @ across / SQUARE).astype(np.intp)
    corner = index.min(axis=0) - 2
    seen_through, is_solid = np.split(index - corner, [len(through)])
    shape = tuple(index.max(axis=0) - corner + 3)
    middles = (np.indices(shape).reshape(2, -1).T + corner + 0.5) * SQUARE
    known = within(middles @ across.T, plane.sides).reshape(shape)
    known[tuple(seen_through.T)] = True
    filled, outside = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    filled[tuple(is_solid.T)] = True
    outside[tuple(seen_through[~within(through, plane.sides + np.array([0, 0, 0, SQUARE]))].T)] = True
    holes = grown(left_out(known & ~grown(filled), outside)) & ~filled
    mask: Mask = holes[tuple(seen_through.T)]
    return mask
