"""Raw points become a prepared cloud: cropped, on a voxel grid, without outliers, with normals and a kNN graph.

Everything is vectorised torch and runs on the device of its inputs. Lengths are metres. The work is done in the
cloud's canonical frame, which moves with the cloud; grid and order of the points therefore do too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tesnet import smoothing
from tesnet.depth_noise import NEAR, DepthNoise
from tesnet.geometry import Box, Pose
from tesnet.obstacles import Obstacles
from tesnet.orientation import orient
from tesnet.planes import basis, cells
from tesnet.points import (
    ROWS_AT_ONCE,
    drop_points,
    estimate_normals,
    in_box,
    members_of_cells,
    nearest_neighbours,
    statistical_outliers,
    voxel_downsample,
)
from tesnet.query import GraspQuery
from tesnet.support import SupportPlane, region

MINIMUM_POINTS = 32
"""Fewer prepared points than this describe no surface to grasp."""

SUPPORT_NOISE = 0.005
"""Points lower than this above the support plane are the plane's own, as a camera sees it, and are dropped."""

LEAST_SUPPORT_NOISE = 0.002
"""Where the support is seen about its known height, no less than this above it is dropped, however quiet the camera."""

MOST_SUPPORT_NOISE = 0.010
"""Where preparation follows the noise, no more than this above the support plane is dropped as its noise."""

_DEVIATIONS, _SURELY = 3.0, 4.0
"""Standard deviations that take most of a support's points away, and all but a few of ten thousand."""

_FEWEST_BELOW = 200
_GROWN = 1.4
"""Times the usual noise of a support, from which on it has grown with the distance."""
_MOST_NOISE = 0.0075
"""Standard deviation over which what lies about a height that was given is no plane with noise, but things."""

_COLUMN, _LEAST_HIGH = 0.0135, 0.1
"""Edge of the squares of a support in which so large a share of the points is over its noise where things are."""
_NEAR_SUPPORT = 0.03

MOST_ON_SUPPORT = 4_000
"""Of what stands on a support that was found, so many prepared points, the nearest to the camera: enough for any grasp,
in twice the time of a tabletop scene of 30 cm."""

_LONGEST_HAND = 0.35
"""Metres from a point within which lies all of a hand that approaches it."""

MOST_UNSOUGHT = 3_000_000
"""Points on which no grasp is looked for: of more, cells hold so many that some tell of all."""

_SURROUNDINGS = 3
_FEWEST_TOGETHER = 4

_UPRIGHT = 0.5
"""A side of the workspace stands upright, and bounds what was seen sideways, where the cosine of its normal with `up`
is at most this; the others are floor and ceiling."""


@dataclass(frozen=True, slots=True)
class PreparationConfig:
    """How a cloud is prepared; travels with the weights that were trained on it.

    Args:
        voxel_size: edge of the grid's cells.
        outlier_neighbours, outlier_std_ratio: a point whose mean distance to that many neighbours exceeds the
            cloud's mean by more than the ratio times the standard deviation is dropped.
        normal_neighbours, normal_radius: points that a normal is fitted to, the point itself included. More would blur
            the low walls of flat objects, whose normals then tilt the hand into the table.
        graph_neighbours: k of the kNN graph, the point itself included.
        max_points: larger prepared clouds are cropped to the points nearest their median.
        max_extent: points farther than this from the median of the cloud are ignored.
        smooth_above: standard deviation of the noise above which surfaces are smoothed; flying pixels are then looked
            for, and what the support's noise lifts is dropped, too. None: all that is left as it is.
    """

    voxel_size: float = 0.0045
    outlier_neighbours: int = 20
    outlier_std_ratio: float = 3.0
    normal_neighbours: int = 14
    normal_radius: float = 0.03
    graph_neighbours: int = 16
    max_points: int = 12_000
    max_extent: float = 10.0
    smooth_above: float | None = None


@dataclass(frozen=True, eq=False, slots=True)
class PreparedCloud:
    """P points on a surface, in the canonical frame.

    Args:
        points: (P, 3).
        normals: (P, 3) unit, outward: turned as the query tells or else to the viewpoint that saw the point.
        neighbours: (P, k) indices of the nearest points, the point itself first.
        spectrum: (P, 2) the smaller two eigenvalues of the local covariance, each divided by the sum of the three.
        view_directions: (P, 3) unit, from the point to that viewpoint.
        viewpoints: (V, 3).
        up: (3,) or None.
        support_height: along `up`, in this frame, or None.
        sides: (S, 4) unit normals, outward, and distances from the origin along them, of the planes that bound what
            was observed sideways: those of the workspace that stand upright. None of them without `up`.
        T_cloud_canonical: back to the frame of the query.
        on_target: (P,) mask of the points that candidates may come from; None is all of them.
        unsought: what else was posted near the points, outside the workspace or beyond `max_points`, on the same grid:
            no grasp is looked for there, but the hand must not meet it.
        dropped_far, dropped_surplus: points ignored because of `max_extent` and of `max_points`.
        support_error: how far the support plane may be from where it is taken to be, metres; a height that was given is
            taken to be right.
        pose_in_doubt: whether the camera may not stand where it is said to, as who asks for `calibrate` fears.
    """

    points: Tensor
    normals: Tensor
    neighbours: Tensor
    spectrum: Tensor
    view_directions: Tensor
    viewpoints: Tensor
    up: Tensor | None
    support_height: float | None
    sides: Tensor
    T_cloud_canonical: Pose
    on_target: Tensor | None = None
    unsought: Obstacles | None = None
    dropped_far: int = 0
    dropped_surplus: int = 0
    support_error: float = 0.0
    pose_in_doubt: bool = False

    def __len__(self) -> int:
        return len(self.points)


def prepare(
    query: GraspQuery,
    config: PreparationConfig,
    device: torch.device,
    support: SupportPlane | None = None,
    between: Callable[[], None] = lambda: None,
) -> PreparedCloud | None:
    """The prepared cloud of a query, or None when no point lies in the workspace above the support plane.

    A support height that is still to be found (`tesnet.support`) counts as none.

    Args:
        query: with the height of its support, where one was found.
        config: how.
        device: where.
        support: the one that was found. Its measured noise is dropped with it; where the query has no target, grasps
            are looked for on what stands on it, the rest counts for collision.
        between: called between blocks of work of some tens of milliseconds.
    """
    posted = _columns(query).to(device)
    noise, support_sd = _support_noise(posted, query, config, support)
    posted = above_support(posted, query, noise)
    sought, on_things = in_workspace(posted, query), False
    if support is not None and query.target is None:
        things = sought & torch.from_numpy(region(posted[:, :3].cpu().numpy(), support)).to(device)
        on_things = int(things.sum()) >= MINIMUM_POINTS
        sought = things if on_things else sought
    table, outside = posted[sought], posted[~sought, :3]
    del posted  # of the largest images a tenth of a gigabyte
    if len(table) == 0:
        return None
    between()
    near = (table[:, :3] - table[:, :3].median(dim=0).values).norm(dim=1) <= config.max_extent
    dropped_far = int((~near).sum())
    table = table[near] if dropped_far else table
    points = table[:, :3]

    viewpoints = torch.zeros(1, 3) if query.viewpoints is None else torch.tensor(query.viewpoints)
    up = None if query.known_up is None else torch.tensor(query.known_up)
    between()
    T_cloud_canonical = canonical_frame(points, viewpoints.to(device), None if up is None else up.to(device))
    between()

    def to_canonical(positions: Tensor) -> Tensor:
        return in_canonical_frame(positions, T_cloud_canonical)

    table = _quieter(torch.cat([to_canonical(points), table[:, 3:]], dim=1), config, support_sd, between)
    table = voxel_downsample(table, config.voxel_size)
    between()
    a_cell = len(points) / len(table)
    viewpoints = to_canonical(viewpoints).to(device)
    on_target = _on_target(query, table, T_cloud_canonical)
    if on_things:
        kept = _within_limit(table[:, :3], viewpoints[0], min(config.max_points, MOST_ON_SUPPORT))
    else:
        kept = _within_limit(table[:, :3], _middle(query, table, on_target, T_cloud_canonical), config.max_points)
    surplus = table[~kept, :3]
    table, on_target = table[kept], None if on_target is None else on_target[kept]
    outward = None if _outward(query) is None else table[:, -3:] @ torch.tensor(T_cloud_canonical.rotation).to(table)
    points = table[:, :3].contiguous()

    neighbours = nearest_neighbours(
        points, max(config.normal_neighbours, config.outlier_neighbours + 1), between=between
    )
    keep = ~statistical_outliers(points, neighbours[:, : config.outlier_neighbours + 1], config.outlier_std_ratio)
    points, neighbours = drop_points(points, neighbours, keep, between)
    on_target = None if on_target is None else on_target[keep]
    outward = None if outward is None else outward[keep]
    normals, spectrum = estimate_normals(points, neighbours[:, : config.normal_neighbours], config.normal_radius)
    graph = neighbours[:, : config.graph_neighbours]
    normals, view_directions = orient(points, normals, graph, viewpoints, outward, between)
    support_height = None
    if query.known_up is not None and isinstance(query.support_height, float):
        support_height = float(query.support_height - T_cloud_canonical.translation @ query.known_up)
    return PreparedCloud(
        points=points,
        normals=normals,
        neighbours=graph,
        spectrum=spectrum,
        view_directions=view_directions,
        viewpoints=viewpoints,
        up=None if up is None else (up @ torch.tensor(T_cloud_canonical.rotation)).float().to(device),
        support_height=support_height,
        sides=_sides(query, T_cloud_canonical).to(device),
        T_cloud_canonical=T_cloud_canonical,
        on_target=on_target,
        unsought=_unsought(
            points,
            chain(map(to_canonical, outside.split(ROWS_AT_ONCE)), [surplus]),
            config.voxel_size,
            a_cell,
            between,
        ),
        pose_in_doubt=query.calibrate,
        dropped_far=dropped_far,
        dropped_surplus=int((~kept).sum()),
        support_error=0.0 if support is None else support.noise_sd,
    )


def _support_noise(
    points: Tensor, query: GraspQuery, config: PreparationConfig, support: SupportPlane | None
) -> tuple[float | Tensor, float]:
    """How high the noise of the support reaches, of all rows (N, 3 or more) or (N,) of each; and its deviation.

    The standard deviation is 0 where it is unknown.
    """
    if support is not None:
        clearance = torch.from_numpy(support.clearance(points[:, :3].cpu().numpy())).to(points)
        most = float(clearance.max()) if len(clearance) else 0.0
        reach = clearance if most > SUPPORT_NOISE else most
        return reach, 0.0 if config.smooth_above is None else support.noise_sd
    known = _heights(points, query)
    if known is None or config.smooth_above is None:
        return SUPPORT_NOISE, 0.0
    heights, support_height = known
    over = heights - support_height
    sd = _sd_under(over)
    everywhere = _reach_of_seen(over, max(SUPPORT_NOISE, min(_DEVIATIONS * sd, MOST_SUPPORT_NOISE)))
    return _reach_of_far(points, over, query, everywhere), sd


def _reach_of_far(points: Tensor, over: Tensor, query: GraspQuery, everywhere: float) -> float | Tensor:
    """How high the noise of a support reaches over each of the rows (N, 3 or more), whose heights over it are (N,).

    (N,) where it grows with the distance from the camera, to more than `everywhere`.
    """
    about = torch.nonzero(over.abs() <= NEAR)[:, 0]
    viewpoints = np.zeros((1, 3)) if query.viewpoints is None else query.viewpoints
    seen = points[about, :3].cpu().numpy()
    noise = DepthNoise.of(seen, over[about].cpu().numpy(), viewpoints)
    if noise is None:
        return everywhere
    usual, most = np.quantile(noise.at(seen), [0.5, 1.0])
    if most < _GROWN * usual or usual > _MOST_NOISE or _SURELY * most <= everywhere:
        return everywhere
    return (_SURELY * torch.from_numpy(noise.at(points[:, :3].cpu().numpy())).to(points)).clamp(min=everywhere)


def _heights(points: Tensor, query: GraspQuery) -> tuple[Tensor, float] | None:
    """Heights (N,) along `up` of rows (N, 3 or more), and the support's; None where that is not known."""
    if query.known_up is None or not isinstance(query.support_height, float):
        return None
    up = torch.tensor(query.known_up, dtype=points.dtype, device=points.device)
    return points[:, :3] @ up, query.support_height


def _sd_under(over: Tensor) -> float:
    """Standard deviation of a support about its known height, by the heights (N,) over that of what is under it.

    0 where it is not seen.
    """
    below = -over
    below = below[(below >= 0) & (below <= _NEAR_SUPPORT)]
    return 1.4826 * float(below.median()) if len(below) >= _FEWEST_BELOW else 0.0


def _reach_of_seen(over: Tensor, otherwise: float) -> float:
    """How high the noise of a support reaches that shows on both sides of its known height, by heights (N,) over that.

    So things of 3 to 5 mm are told from it. A support that lies somewhat beside that height looks noisier than it is.
    """
    away = over.abs()
    away = away[away <= SUPPORT_NOISE]
    if len(away) < _FEWEST_BELOW:
        return otherwise
    reach = _SURELY * 1.4826 * float(away.median())
    return otherwise if reach >= SUPPORT_NOISE else min(otherwise, max(reach, LEAST_SUPPORT_NOISE))


def _quieter(table: Tensor, config: PreparationConfig, support_sd: float, between: Callable[[], None]) -> Tensor:
    """Rows (N, 3 or more), beginning with x, y, z, as the configuration wants them where they are noisy."""
    if config.smooth_above is None or not MINIMUM_POINTS <= len(table) <= smoothing.MOST_POINTS:
        return table
    noise = smoothing.measured(table[:, :3])
    table = smoothing.without_lone(table, noise, between)
    sd = max(noise.sd, support_sd)
    return smoothing.smoothed(table, sd) if sd > config.smooth_above and len(table) else table


def _columns(query: GraspQuery) -> Tensor:
    """A row for each of the query's points: x, y, z; 1 on the target, where that is a mask; `_outward`, where known."""
    columns = [torch.from_numpy(query.points.copy())]
    if query.target is not None and not isinstance(query.target, Box):
        columns.append(torch.from_numpy(query.target.copy()).to(columns[0].dtype)[:, None])
    outward = _outward(query)
    if outward is not None:
        columns.append(outward)
    return torch.cat(columns, dim=1) if len(columns) > 1 else columns[0]


def _outward(query: GraspQuery) -> Tensor | None:
    """Directions (N, 3) out of the surface: the query's normals or, without these, from each point to who saw it."""
    if query.normals is not None:
        return torch.nn.functional.normalize(torch.from_numpy(query.normals.copy()), dim=1)
    if query.view_index is None or query.viewpoints is None:
        return None
    to_viewer = query.viewpoints[query.view_index] - query.points
    return torch.nn.functional.normalize(torch.from_numpy(to_viewer), dim=1).float()


def above_support(points: Tensor, query: GraspQuery, noise: float | Tensor = SUPPORT_NOISE) -> Tensor:
    """Rows (N, 3 or more), beginning with x, y, z, that are not lower than a noise above the query's support plane.

    The noise is that of all rows, or (N,) of each.
    """
    known = _heights(points, query)
    if known is None:
        return points
    heights, support_height = known
    over = heights - support_height
    above = heights >= support_height + noise
    if isinstance(noise, Tensor) and query.known_up is not None:
        above &= ~_lifted(points, over, noise, query.known_up)
    return points[above]


def _lifted(points: Tensor, over: Tensor, noise: Tensor, up: NDArray[np.float64]) -> Tensor:
    """Mask (N,) of rows that a support's noise may have lifted over its usual reach.

    Those that are not over twice as high, and with few others beside them over that reach.

    Args:
        points: (N, 3 or more), beginning with x, y, z.
        over: (N,) heights over the support.
        noise: (N,) its usual reach.
        up: (3,).
    """
    low = torch.nonzero(over.abs() < 2 * noise)[:, 0]
    across = torch.from_numpy(basis(up)[:, :2]).to(points)
    _, column_of, sizes = cells((points[low, :3] @ across).cpu().numpy(), _COLUMN)
    high = (over[low] >= noise[low]).cpu().numpy()
    few = np.bincount(column_of, high) < _LEAST_HIGH * sizes
    mask = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    mask[low] = torch.from_numpy(high & few[column_of]).to(mask.device)
    return mask


def in_workspace(points: Tensor, query: GraspQuery) -> Tensor:
    """Mask (N,) of the rows inside the query's workspace."""
    if query.workspace is None:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    return _inside(points, query.workspace)


def _middle(query: GraspQuery, table: Tensor, on_target: Tensor | None, T_cloud_canonical: Pose) -> Tensor:
    """Where grasps matter most, (3,): the middle of the target, or of the workspace, or of all rows (V, 3 or more)."""
    if on_target is not None and bool(on_target.any()):
        return table[on_target, :3].median(dim=0).values
    if query.workspace is None:
        return table[:, :3].median(dim=0).values
    middle = torch.tensor((query.workspace.minimum + query.workspace.maximum) / 2, device=table.device)
    return in_canonical_frame(middle[None], T_cloud_canonical)[0]


def _within_limit(points: Tensor, middle: Tensor, limit: int) -> Tensor:
    """Mask (V,) of the points (V, 3) nearest to the middle, so many as may be."""
    kept = torch.ones(len(points), dtype=torch.bool, device=points.device)
    if len(points) > limit:
        kept[(points - middle).norm(dim=1).argsort(stable=True)[limit:]] = False
    return kept


def _unsought(
    points: Tensor,
    blocks: Iterable[Tensor],
    voxel_size: float,
    a_cell: float,
    between: Callable[[], None] = lambda: None,
) -> Obstacles | None:
    """The cells of other points that a hand at the points may meet, but none of isolated points (flying pixels).

    Isolated are those whose surroundings, a cube of `_SURROUNDINGS` cells' edge, hold fewer than `_FEWEST_TOGETHER`
    points, or under a tenth of what a surface that crosses it holds where there are `a_cell` points in a cell. Of more
    than `MOST_UNSOUGHT` points every second or third is looked at; ranked grasps are tried with all.
    """
    low, high = points.amin(dim=0) - _LONGEST_HAND, points.amax(dim=0) + _LONGEST_HAND
    others = _near(blocks, low, high, between)
    if len(others) == 0:
        return None
    step = 1 + len(others) // MOST_UNSOUGHT
    others = others[::step]
    least = min(_FEWEST_TOGETHER, 0.1 * _SURROUNDINGS**2 * a_cell) / step
    surroundings, counts = members_of_cells(others, _SURROUNDINGS * voxel_size, between=between)
    others = others[(counts >= least)[surroundings]]
    del surroundings
    return Obstacles.of(voxel_downsample(others, voxel_size, between)) if len(others) else None


def _near(blocks: Iterable[Tensor], low: Tensor, high: Tensor, between: Callable[[], None]) -> Tensor:
    """Those points (N, 3) of the blocks that lie between two corners (3,)."""
    near = []
    for block in blocks:
        between()
        near.append(block[in_box(block, low, high)])
    return torch.cat(near)


def _inside(points: Tensor, box: Box) -> Tensor:
    low = torch.tensor(box.minimum, dtype=points.dtype, device=points.device)
    high = torch.tensor(box.maximum, dtype=points.dtype, device=points.device)
    return in_box(points, low, high)


def posted_points(query: GraspQuery, T_cloud_canonical: Pose, device: torch.device) -> Tensor:
    """Every point (N, 3) of the query, its support's included, in the canonical frame."""
    return in_canonical_frame(torch.from_numpy(query.points.copy()).to(device), T_cloud_canonical)


def in_canonical_frame(points: Tensor, T_cloud_canonical: Pose) -> Tensor:
    """Points (N, 3) of the query's frame in the canonical one."""
    rotation = torch.tensor(T_cloud_canonical.rotation, device=points.device)
    translation = torch.tensor(T_cloud_canonical.translation, device=points.device)
    moved = torch.empty(points.shape, device=points.device)
    for block, to in zip(points.split(ROWS_AT_ONCE), moved.split(ROWS_AT_ONCE), strict=True):
        to.copy_((block.double() - translation) @ rotation)
    return moved


def canonical_frame(points: Tensor, viewpoints: Tensor, up: Tensor | None) -> Pose:
    """T_cloud_canonical of a frame that moves with the cloud: origin at the centroid, z along `up`.

    Without `up`, z points to the first viewpoint. x is the direction perpendicular to z of the first viewpoint, or,
    where that is z itself, of the cloud's largest spread.
    """
    cloud = points.double()
    centroid = cloud.mean(dim=0)
    to_viewer = viewpoints[0].double() - centroid
    rounding = 1e-12 * float(to_viewer.norm())  # of a far cloud, which is no direction
    z = _unit_or_none(to_viewer) if up is None else up.double()
    if z is None:
        z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=points.device)
    x = _unit_or_none(to_viewer - (to_viewer @ z) * z, rounding)
    if x is None:
        centred = cloud - centroid
        flat = centred - (centred @ z)[:, None] * z
        spread = torch.linalg.eigh(flat.T @ flat).eigenvectors[:, 2]
        x = _unit_or_none(spread - (spread @ z) * z)
        if x is None:  # every point on one line along z
            x = _unit_or_none(
                torch.linalg.cross(z, torch.eye(3, dtype=torch.float64, device=z.device)[z.abs().argmin()])
            )
            assert x is not None
        third_moment = float(((centred @ x) ** 3).sum())
        x = -x if third_moment < 0 else x
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    return Pose(rotation.cpu().numpy(), centroid.cpu().numpy())


def _unit_or_none(vector: Tensor, rounding: float = 0.0) -> Tensor | None:
    length = vector.norm()
    return None if float(length) < max(1e-6, rounding) else vector / length


def _on_target(query: GraspQuery, table: Tensor, T_cloud_canonical: Pose) -> Tensor | None:
    """Mask (V,) of rows that lie in the target's box, or whose cell has at least as many target points as others."""
    if query.target is None:
        return None
    if not isinstance(query.target, Box):
        return table[:, 3] >= 0.5
    in_cloud = torch.from_numpy(T_cloud_canonical.apply(table[:, :3].cpu().numpy()))
    return _inside(in_cloud, query.target).to(table.device)


def _sides(query: GraspQuery, T_cloud_canonical: Pose) -> Tensor:
    """`PreparedCloud.sides` of a query."""
    planes = []
    if query.workspace is not None and query.known_up is not None:
        for axis in np.flatnonzero(np.abs(query.known_up) <= _UPRIGHT):
            for sign, end in ((-1.0, query.workspace.minimum[axis]), (1.0, query.workspace.maximum[axis])):
                normal = sign * np.eye(3)[axis]
                offset = sign * end - normal @ T_cloud_canonical.translation
                planes.append([*T_cloud_canonical.inverse().rotate(normal), offset])
    return torch.tensor(planes, dtype=torch.float32).reshape(-1, 4)
