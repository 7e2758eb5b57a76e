"""Planes in a cloud, found from its local normals. Nothing is sampled at random.

Knows no query and no hand, nor which plane things stand on: `tesnet.support` chooses. numpy only; lengths in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

SAMPLE = 8_000
"""Points that are looked at; of more, so many spread evenly over their order."""
REACH = 10.0
"""Of the median; what is farther is none of the scene."""
PATCHES = (0.03, 0.06, 0.12)
"""Edge of the cells whose points make one local normal: wide against the noise of a depth camera. Each point is in the
first whose cell has twice the fewest points, so the nearer to the camera the narrower; none is wider than most need."""
FEWEST_OF_PATCH = 6
FLAT = 0.25
"""A patch is flat where its least spread, as a standard deviation, is at most this share of the next."""
DIRECTIONS = 500
"""Directions that are voted for; some 6 degrees lie between neighbours."""
MOST_DIRECTIONS, MOST_HEIGHTS = 5, 5
LEAST_SHARE = 0.01
"""Of the sample: fewer votes make no direction, and fewer points no plane."""
FEWEST_POINTS = 60
AGREEING, ALIGNED = np.cos(np.deg2rad([10.0, 20.0]))
"""Normals within 10 degrees count for a direction; a plane's own patches are within 20."""
BANDS = (0.03, 0.01, 0.01)
"""Half thickness of the slab that a plane is fitted in, from coarse to fine."""
DEVIATIONS = 3.0
"""A plane's own points lie within so many standard deviations of its noise."""
LEAST_BAND = 0.001
MOST_TILT = np.cos(np.deg2rad(2.5))
"""A plane across a given direction is tilted less than this."""
LEAST_RADIUS = 1.5
"""A surface that bends more than this is no plane, but the floor of a bin, say."""
SQUARE = 0.04
"""Edge of the squares of a footprint. A gap of one square, as behind things, does not part it."""
TALLEST = 0.35
"""Above a plane: what reaches higher does not stand on it for a hand to take."""
SIDES = 24
"""Of an outline."""
_FARTHEST_CELL = 1 << 19
_CELLS_COUNTED = 1_000_000
"""Of a grid of so many, all are counted; of a larger one those that are occupied are sorted."""
_TURNS = 90
"""Of a rectangle that are tried, over a right angle."""
_GOLDEN = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True, eq=False, slots=True)
class Plane:
    """A piece of a plane.

    Args:
        up: (3,) unit normal.
        height: along it.
        noise_sd: robust standard deviation of its points about it.
        sides: (S, 4) unit outward normals across `up`, and distances along them, of its convex outline.
        own: mask (P,) of the sampled points that are its own.
    """

    up: Array
    height: float
    noise_sd: float
    sides: Array
    own: Mask

    @property
    def turned(self) -> Plane:
        """The same, seen from its other side."""
        return Plane(-self.up, -self.height, self.noise_sd, self.sides, self.own)


@dataclass(frozen=True, eq=False, slots=True)
class Surfaces:
    """A sample of a cloud and the flat patches of its surfaces.

    Args:
        points: (P, 3).
        patch_of: (P,) the patch of each.
        normals: (C, 3) unit, of unknown sign, of the patches.
        votes: (C,) how many points a patch has; 0 where it is not flat.
    """

    points: Array
    patch_of: Indices
    normals: Array
    votes: Array

    @classmethod
    def of(cls, cloud: NDArray[np.floating]) -> Surfaces:
        """Those of a cloud (N, 3) with at least one point, within `REACH` of its median."""
        points = spread(cloud, SAMPLE).astype(np.float64)
        points = points[((points - np.median(points, axis=0)) ** 2).sum(axis=1) <= REACH**2]
        patch_of = _patches(points)
        counts = np.bincount(patch_of).astype(np.float64)
        means = np.stack([np.bincount(patch_of, points[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
        deviations = points - means[patch_of]
        covariances = np.empty((len(counts), 3, 3))
        for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            sums = np.bincount(patch_of, deviations[:, row] * deviations[:, column])
            covariances[:, row, column] = covariances[:, column, row] = sums / counts
        spreads, axes = np.linalg.eigh(covariances)
        flat = (counts >= FEWEST_OF_PATCH) & (spreads[:, 0] <= FLAT**2 * spreads[:, 1])
        return cls(points, patch_of, axes[:, :, 0], np.where(flat, counts, 0.0))

    def directions(self) -> Iterator[Array]:
        """Unit normals (3,), of either sign, that many patches share, most first."""
        candidates, left = hemisphere(DIRECTIONS), self.votes.copy()
        agreeing = np.abs(candidates @ self.normals.T) >= AGREEING
        for _ in range(MOST_DIRECTIONS):
            sums = agreeing @ left
            best = int(sums.argmax())
            if sums[best] < LEAST_SHARE * len(self.points):
                return
            direction = candidates[best]
            for _ in range(3):  # to the mean of the normals about it
                cosines = self.normals @ direction
                weights = np.where(np.abs(cosines) >= AGREEING, np.sign(cosines), 0.0) * left
                direction = weights @ self.normals
                direction /= np.linalg.norm(direction)
            yield direction
            left[np.abs(self.normals @ direction) >= ALIGNED] = 0.0

    def planes_near(self, direction: Array) -> Iterator[Plane]:
        """The planes whose normal is about a unit direction (3,): each with the normal that fits its points best."""
        for height, able, sure in self._heights(direction, BANDS[0]):
            up, middle = direction, height
            for band in BANDS:
                residuals = self.points @ up - middle
                own = able & (np.abs(residuals) <= band)
                own &= np.abs(residuals) <= max(DEVIATIONS * robust_sd(residuals[own]), LEAST_BAND)
                (own,) = self._pieces(up, middle, own)
                if own.sum() < FEWEST_POINTS:
                    break
                up, middle = least_squares(self.points[own & sure if (own & sure).sum() >= FEWEST_POINTS else own], up)
            else:
                yield from self._plane(up, middle, able, sure)

    def planes_across(self, up: Array) -> Iterator[Plane]:
        """The planes whose normal is a unit direction (3,)."""
        for height, able, sure in self._heights(up, BANDS[-1]):
            residuals = np.abs(self.points @ up - height)
            own, wide = self._pieces(up, height, *(able & (residuals <= band) for band in (BANDS[-1], BANDS[0])))
            wide &= sure
            if min(own.sum(), wide.sum()) < FEWEST_POINTS:
                continue
            if least_squares(self.points[wide], up)[0] @ up >= MOST_TILT:
                yield from self._plane(up, float(np.median(self.points[own] @ up)), able, sure)

    def _heights(self, direction: Array, half: float) -> Iterator[tuple[float, Mask, Mask]]:
        """Heights of slabs, fullest first, with the masks (P,) of points that may and that do belong to such planes.

        Those that do lie in patches across the direction; those that may, also in patches that are not flat.
        """
        across = np.abs(self.normals @ direction) >= ALIGNED
        able, sure = (across | (self.votes == 0))[self.patch_of], (across & (self.votes > 0))[self.patch_of]
        heights, left = self.points @ direction, sure.copy()
        for _ in range(MOST_HEIGHTS):
            if left.sum() < max(FEWEST_POINTS, LEAST_SHARE * len(self.points)):
                return
            height = fullest(heights[left], half)
            yield height, able, sure
            left &= np.abs(heights - height) > 2 * half

    def _plane(self, up: Array, height: float, able: Mask, sure: Mask) -> Iterator[Plane]:
        """The plane there, unless it has too few points or is bent."""
        residuals = self.points @ up - height
        near = np.abs(residuals) <= BANDS[-1]
        noise = robust_sd(residuals[near & sure])
        (own,) = self._pieces(up, height, able & (np.abs(residuals) <= max(DEVIATIONS * noise, LEAST_BAND)))
        enough = own.sum() >= max(FEWEST_POINTS, LEAST_SHARE * len(self.points))
        if enough and (own & sure).any() and radius(self.points[own & sure], up) >= LEAST_RADIUS:
            yield Plane(up, height, noise, outline(self.points[own & sure], up), own)

    def _pieces(self, up: Array, height: float, *about: Mask) -> list[Mask]:
        """Of points about a plane, each mask (P,), those of the largest piece that hangs together.

        What stands on it, on either side and up to `TALLEST`, does not part it.
        """
        if not any(near.any() for near in about):
            return list(about)
        rows = np.flatnonzero(np.abs(self.points @ up - height) <= TALLEST)
        squares, square_of, _ = cells(self.points[rows] @ basis(up)[:, :2], SQUARE)
        label = np.full(len(self.points), -1)
        label[rows] = pieces(squares)[square_of]
        return [near & (label == np.bincount(label[near], minlength=1).argmax()) for near in about]


def _patches(points: Array) -> Indices:
    """(P,) number of the patch of each of the points (P, 3)."""
    patch_of, left, count = np.zeros(len(points), dtype=np.intp), np.arange(len(points)), 0
    for edge in PATCHES:
        _, cell_of, sizes = cells(points, edge)
        full = sizes[cell_of] >= 2 * FEWEST_OF_PATCH
        last = edge == PATCHES[-1] or full.mean() >= 0.5
        taken = left if last else left[full[left]]
        numbers, number_of = np.unique(cell_of[taken], return_inverse=True)
        patch_of[taken] = count + number_of
        if last:
            break
        left, count = left[~full[left]], count + len(numbers)
    return patch_of


def spread(cloud: NDArray[Any], most: int) -> NDArray[Any]:
    """At most so many rows of a cloud, one in each stretch of its order; of an image, from all columns."""
    if len(cloud) <= most:
        return cloud
    step = len(cloud) / most
    number = np.arange(most)
    turns = number * _GOLDEN
    rows: NDArray[Any] = cloud[((number + turns - np.floor(turns)) * step).astype(np.intp)]
    return rows


def cells(points: NDArray[np.floating], edge: float) -> tuple[Indices, Indices, Indices]:
    """Occupied cells (C, D) of a grid, the number (N,) of each point's (N, D) cell, and the cells' sizes (C,).

    What lies beyond the farthest cells from the origin counts as in them.
    """
    keys, extent = np.zeros(len(points), dtype=np.intp), []
    for column in points.T:
        index = np.clip(np.floor(column / edge), -_FARTHEST_CELL, _FARTHEST_CELL).astype(np.intp)
        index -= index.min()
        extent.append(int(index.max()) + 1)
        keys = keys * extent[-1] + index
    if math.prod(extent) > _CELLS_COUNTED:
        occupied, cell_of, sizes = np.unique(keys, return_inverse=True, return_counts=True)
    else:
        counts = np.bincount(keys)
        occupied = np.flatnonzero(counts)
        sizes, cell_of = counts[occupied], (np.cumsum(counts > 0) - 1)[keys]
    return np.stack(np.unravel_index(occupied, extent), axis=1), cell_of, sizes


def pieces(squares: Indices) -> Indices:
    """(C,) which piece each of the squares (C, 2) belongs to: those at most two apart hang together."""
    width = int(squares[:, 1].max()) + 5
    keys = squares[:, 0] * width + squares[:, 1]  # in order, as `cells` gives them
    steps = np.array([row * width + column for row in range(-2, 3) for column in range(-2, 3)])
    wanted = keys[:, None] + steps
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    neighbours = np.where(keys[place] == wanted, place, np.arange(len(keys))[:, None])
    label = np.arange(len(keys))
    while True:
        lower = label[neighbours].min(axis=1)
        lower = lower[lower]
        if (lower == label).all():
            return label
        label = lower


def grown(squares: Mask) -> Mask:
    """Mask (H, W) of squares, of those beside them and of those at their corners."""
    rows = squares.copy()
    rows[1:] |= squares[:-1]
    rows[:-1] |= squares[1:]
    both = rows.copy()
    both[:, 1:] |= rows[:, :-1]
    both[:, :-1] |= rows[:, 1:]
    return both


def left_out(free: Mask, starts: Mask) -> Mask:
    """Mask (H, W) of the free squares (H, W) to which no way from square to square beside it leads from the starts.

    Squares of the border count as not free.
    """
    inner = np.zeros_like(free)
    inner[1:-1, 1:-1] = free[1:-1, 1:-1]
    reached, count = starts & inner, 0
    while reached.sum() > count:
        count = reached.sum()
        reached = _along_rows(_along_rows(reached, inner).T, inner.T).T
    return inner & ~reached


def _along_rows(reached: Mask, free: Mask) -> Mask:
    """Mask (H, W) of the free squares that lie in one stretch of a row with a reached one; none is of the border."""
    stretch = np.cumsum(~free)
    reaches = np.zeros(stretch[-1] + 1, dtype=bool)
    reaches[stretch[reached.ravel()]] = True
    return free & reaches[stretch].reshape(free.shape)


def basis(up: Array) -> Array:
    """(3, 3) with two directions across `up` and, last, `up` as columns."""
    across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up], axis=1)


def hemisphere(count: int) -> Array:
    """Unit directions (count, 3) spread evenly over half a sphere, along a spiral."""
    z = (np.arange(count) + 0.5) / count
    angle = 2 * np.pi * _GOLDEN * np.arange(count)
    level = np.sqrt(1 - z**2)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def fullest(heights: Array, half: float) -> float:
    """The median height in the slab, of twice half a thickness, that holds most of the heights (C,)."""
    ordered = np.sort(heights)
    ends = np.searchsorted(ordered, ordered + 2 * half, side="right")
    first = int((ends - np.arange(len(ordered))).argmax())
    return median(ordered[first : ends[first]])


def least_squares(points: Array, up: Array) -> tuple[Array, float]:
    """The unit normal (3,), on the side of `up`, and the height of the plane with the least squared distances."""
    mean = points.mean(axis=0)
    normal = np.linalg.eigh((points - mean).T @ (points - mean))[1][:, 0]
    normal = normal if normal @ up >= 0 else -normal
    return normal, float(mean @ normal)


def robust_sd(residuals: NDArray[np.floating]) -> float:
    """The standard deviation of normal residuals (N,) that a few others do not change: 1.4826 median |r - median r|."""
    if len(residuals) == 0:
        return 0.0
    return 1.4826 * median(np.abs(residuals - median(residuals)))


def median(values: NDArray[np.floating]) -> float:
    """That of at least one value (N,), in a third of NumPy's time for a few thousand."""
    half = len(values) // 2
    parted = np.partition(values, half)
    return float(parted[half]) if len(values) % 2 else float(parted[:half].max() + parted[half]) / 2


def radius(points: Array, up: Array) -> float:
    """The radius of the strongest bend of a surface that is nearly across `up`: of a paraboloid fitted to its points.

    It is infinite for fewer points than make a paraboloid.
    """
    if len(points) < 6:
        return np.inf
    u, v, w = ((points - points.mean(axis=0)) @ basis(up)).T
    terms = np.stack([u * u / 2, u * v, v * v / 2, u, v, np.ones_like(u)], axis=1)
    xx, xy, yy = np.linalg.lstsq(terms, w, rcond=None)[0][:3]
    bend = float(np.abs(np.linalg.eigvalsh([[xx, xy], [xy, yy]])).max())
    return 1.0 / max(bend, 1e-9)


def outline(points: Array, up: Array) -> Array:
    """(SIDES, 4): the narrowest prism along `up`, of so many evenly turned sides, that holds the points.

    One of its sides lies along the smallest rectangle about the points, as most tables, boards and bins are rectangles.
    """
    level = basis(up)[:, :2].T @ points.T
    quarter = np.pi / 2 * np.arange(_TURNS) / _TURNS
    widths = [np.ptp(_directions(quarter + turn) @ level, axis=1) for turn in (0.0, np.pi / 2)]
    angle = quarter[(widths[0] * widths[1]).argmin()] + 2 * np.pi * np.arange(SIDES) / SIDES
    directions = _directions(angle)
    return np.column_stack([directions @ basis(up)[:, :2].T, (directions @ level).max(axis=1)])


def _directions(angle: Array) -> Array:
    """Unit directions (A, 2) at angles (A,)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def within(points: NDArray[np.floating], sides: Array) -> Mask:
    """Mask (N,) of points (N, 3) inside all sides (S, 4)."""
    directions, limits = sides[:, :3].astype(points.dtype), sides[:, 3:].astype(points.dtype)
    inside: Mask = np.all(directions @ points.T <= limits, axis=0)
    return inside
