"""Raw points become a prepared cloud: cropped, on a voxel grid, without outliers, with normals and a kNN graph.

Everything is vectorised torch and runs on the device of its inputs. Lengths are metres. The work is done in the
cloud's canonical frame, which moves with the cloud; grid and order of the points therefore do too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tesnet.geometry import Pose
from tesnet.query import Box, GraspQuery

MINIMUM_POINTS = 32
"""Fewer prepared points than this describe no surface to grasp."""

SUPPORT_CLEARANCE = 0.005
"""Points lower than this above the support plane belong to it."""

_LEVEL = 0.5
"""Of a side of the workspace: cosine of its normal with `up` from which on it lies across it, as a table does."""


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
    """

    voxel_size: float = 0.0045
    outlier_neighbours: int = 20
    outlier_std_ratio: float = 3.0
    normal_neighbours: int = 14
    normal_radius: float = 0.03
    graph_neighbours: int = 16
    max_points: int = 12_000
    max_extent: float = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class PreparedCloud:
    """P points on a surface, in the canonical frame.

    Args:
        points: (P, 3).
        normals: (P, 3) unit, outward: turned towards the viewpoint that sees the point best.
        neighbours: (P, k) indices of the nearest points, the point itself first.
        spectrum: (P, 2) the smaller two eigenvalues of the local covariance, each divided by the sum of the three.
        view_directions: (P, 3) unit, from the point to that viewpoint.
        viewpoints: (V, 3).
        up: (3,) or None.
        support_height: along `up`, in this frame, or None.
        sides: (S, 4) unit normals, outward, and distances from the origin along them, of the planes that bound what
            was observed sideways: those of the workspace that do not lie across `up`. None of them without `up`.
        T_cloud_canonical: back to the frame of the query.
        on_target: (P,) mask of the points that candidates may come from; None is all of them.
        dropped_far, dropped_surplus: points ignored because of `max_extent` and of `max_points`.
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
    dropped_far: int = 0
    dropped_surplus: int = 0

    def __len__(self) -> int:
        return len(self.points)


def prepare(query: GraspQuery, config: PreparationConfig, device: torch.device) -> PreparedCloud | None:
    """The prepared cloud of a query, or None when no point lies in the workspace above the support plane.

    A support height that is still to be found (`tesnet.support`) counts as none.
    """
    table = crop(_with_target(query).to(device), query)
    if len(table) == 0:
        return None
    near = (table[:, :3] - table[:, :3].median(dim=0).values).norm(dim=1) <= config.max_extent
    dropped_far = int((~near).sum())
    table = table[near] if dropped_far else table
    points = table[:, :3]

    viewpoints = torch.zeros(1, 3) if query.viewpoints is None else torch.tensor(query.viewpoints)
    up = None if query.up is None else torch.tensor(query.up)
    T_cloud_canonical = canonical_frame(points, viewpoints.to(device), None if up is None else up.to(device))
    rotation = torch.tensor(T_cloud_canonical.rotation)
    origin = torch.tensor(T_cloud_canonical.translation)

    def to_canonical(positions: Tensor) -> Tensor:
        return ((positions.double() - origin.to(positions.device)) @ rotation.to(positions.device)).float()

    table = voxel_downsample(torch.cat([to_canonical(points), table[:, 3:]], dim=1), config.voxel_size)
    viewpoints = to_canonical(viewpoints).to(device)
    on_target = _on_target(query, table, T_cloud_canonical)
    points = table[:, :3].contiguous()
    dropped_surplus = max(0, len(points) - config.max_points)
    if dropped_surplus:
        wanted = points if on_target is None or not bool(on_target.any()) else points[on_target]
        distance = (points - wanted.median(dim=0).values).norm(dim=1)
        kept = distance.argsort(stable=True)[: config.max_points].sort().values
        points, on_target = points[kept], None if on_target is None else on_target[kept]

    neighbours = nearest_neighbours(points, max(config.normal_neighbours, config.outlier_neighbours + 1))
    keep = ~statistical_outliers(points, neighbours[:, : config.outlier_neighbours + 1], config.outlier_std_ratio)
    points, neighbours = drop_points(points, neighbours, keep)
    on_target = None if on_target is None else on_target[keep]
    normals, spectrum = estimate_normals(points, neighbours[:, : config.normal_neighbours], config.normal_radius)
    normals, view_directions = orient_normals(points, normals, viewpoints)
    support_height = None
    if query.up is not None and isinstance(query.support_height, float):
        support_height = float(query.support_height - T_cloud_canonical.translation @ query.up)
    return PreparedCloud(
        points=points,
        normals=normals,
        neighbours=neighbours[:, : config.graph_neighbours],
        spectrum=spectrum,
        view_directions=view_directions,
        viewpoints=viewpoints,
        up=None if up is None else (up @ rotation).float().to(device),
        support_height=support_height,
        sides=_sides(query, T_cloud_canonical).to(device),
        T_cloud_canonical=T_cloud_canonical,
        on_target=on_target,
        dropped_far=dropped_far,
        dropped_surplus=dropped_surplus,
    )


def crop(points: Tensor, query: GraspQuery) -> Tensor:
    """Rows (N, 3 or more), beginning with x, y, z, inside the query's workspace and 5 mm or more above its support."""
    if query.workspace is not None:
        points = points[_inside(points, query.workspace)]
    if isinstance(query.support_height, float) and query.up is not None:
        heights = points[:, :3] @ torch.tensor(query.up, dtype=points.dtype, device=points.device)
        points = points[heights >= query.support_height + SUPPORT_CLEARANCE]
    return points


def _inside(points: Tensor, box: Box) -> Tensor:
    low = torch.tensor(box.minimum, dtype=points.dtype, device=points.device)
    high = torch.tensor(box.maximum, dtype=points.dtype, device=points.device)
    return ((points[:, :3] >= low) & (points[:, :3] <= high)).all(dim=1)


def _sides(query: GraspQuery, T_cloud_canonical: Pose) -> Tensor:
    """`PreparedCloud.sides` of a query."""
    planes = []
    if query.workspace is not None and query.up is not None:
        for axis in np.flatnonzero(np.abs(query.up) <= _LEVEL):
            for sign, end in ((-1.0, query.workspace.minimum[axis]), (1.0, query.workspace.maximum[axis])):
                normal = sign * np.eye(3)[axis]
                offset = sign * end - normal @ T_cloud_canonical.translation
                planes.append([*T_cloud_canonical.inverse().rotate(normal), offset])
    return torch.tensor(planes, dtype=torch.float32).reshape(-1, 4)


def _with_target(query: GraspQuery) -> Tensor:
    """The query's points (N, 3) or, where its target is a mask, (N, 4) with 1 in the last column for the target."""
    points = torch.from_numpy(query.points.copy())
    if query.target is None or isinstance(query.target, Box):
        return points
    return torch.cat([points, torch.from_numpy(query.target.copy()).to(points.dtype)[:, None]], dim=1)


def _on_target(query: GraspQuery, table: Tensor, T_cloud_canonical: Pose) -> Tensor | None:
    """Mask (V,) of rows that lie in the target's box, or whose cell has at least as many target points as others."""
    if query.target is None:
        return None
    if not isinstance(query.target, Box):
        return table[:, 3] >= 0.5
    in_cloud = torch.from_numpy(T_cloud_canonical.apply(table[:, :3].cpu().numpy()))
    return _inside(in_cloud, query.target).to(table.device)


def canonical_frame(points: Tensor, viewpoints: Tensor, up: Tensor | None) -> Pose:
    """T_cloud_canonical of a frame that moves with the cloud: origin at the centroid, z along `up`.

    Without `up`, z points to the first viewpoint. x is the direction perpendicular to z of the first viewpoint, or,
    where that is z itself, of the cloud's largest spread.
    """
    cloud = points.double()
    centroid = cloud.mean(dim=0)
    to_viewer = viewpoints[0].double() - centroid
    z = _unit_or_none(to_viewer) if up is None else up.double()
    if z is None:
        z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=points.device)
    x = _unit_or_none(to_viewer - (to_viewer @ z) * z)
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


def sight_axes(points: Tensor, viewpoint: Tensor) -> Tensor:
    """(3, 3) axes, as columns, that move with points (P, 3) and their viewpoint (3,): z points away from the viewer.

    z goes from the viewpoint to the points' centroid; x from there towards the point farthest across z.
    """
    rays = points - points.mean(dim=0)
    z = torch.nn.functional.normalize(points.mean(dim=0) - viewpoint, dim=0)
    across = rays - (rays @ z)[:, None] * z
    x = across[across.norm(dim=1).argmax()]
    if float(x.norm()) < 1e-6:  # all in one line of sight
        x = torch.linalg.cross(z, torch.eye(3, dtype=points.dtype, device=points.device)[z.abs().argmin()])
    x = torch.nn.functional.normalize(x, dim=0)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=1)


def _unit_or_none(vector: Tensor) -> Tensor | None:
    length = vector.norm()
    return None if float(length) < 1e-6 else vector / length


def members_of_cells(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Of integer cells (P, 3): the number (P,) of each row among the occupied cells, in order, and their sizes."""
    cells = cells - cells.min(dim=0).values
    extent = cells.max(dim=0).values + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, member_of, counts = keys.unique(return_inverse=True, return_counts=True)
    return member_of, counts


def voxel_downsample(points: Tensor, voxel_size: float) -> Tensor:
    """The mean of the rows (N, 3 or more), which begin with x, y, z, in every occupied cell, in the order of the cells.

    The grid's corner lies half a cell below the smallest coordinates, as in Open3D.
    """
    corner = points[:, :3].min(dim=0).values
    cells = ((points[:, :3] - corner) / voxel_size + 0.5).floor().long()
    cell_of_point, counts = members_of_cells(cells)
    sums = torch.zeros(len(counts), points.shape[1], dtype=torch.float64, device=points.device)
    sums.index_add_(0, cell_of_point, points.double())
    means: Tensor = (sums / counts[:, None]).to(points.dtype)
    return means


def nearest_neighbours(points: Tensor, k: int, queries: Tensor | None = None) -> Tensor:
    """Indices (Q, k) of the points (P, 3) nearest to each query (Q, 3), nearest first.

    Queries default to the points themselves; each is then its own first neighbour. With fewer than k points the last
    one is repeated.

    Points and queries are sorted along x, and a block of queries is compared with the slab of points around it only;
    the few queries whose k-th neighbour may lie outside the slab, and all queries of few points, are compared with all.
    """
    sources = points if queries is None else queries
    available = min(k, len(points))
    # Squared distances come from an expanded square, whose terms cancel: float64.
    exact, wanted = points.double(), sources.double()
    by_x, order = exact[:, 0].sort()
    sorted_points = exact[order]
    query_order = wanted[:, 0].argsort()
    neighbours = torch.empty(len(sources), available, dtype=torch.long, device=points.device)
    few = len(points) <= _FEW_POINTS
    unsure = [query_order] if few else []
    for rows in () if few else query_order.split(_SLAB_QUERIES):
        block = wanted[rows]
        ends = torch.stack([block[0, 0] - _SLAB_MARGIN, block[-1, 0] + _SLAB_MARGIN])
        first, last = torch.searchsorted(by_x, ends).tolist()
        if last - first < available:
            unsure.append(rows)
            continue
        squares, found = _nearest(block, sorted_points[first:last], available)
        neighbours[rows] = order[found + first]
        unsure.append(rows[squares[:, -1] >= _SLAB_MARGIN**2])
    for rows in torch.cat(unsure).split(max(1, _LARGEST_TABLE // len(points))) if unsure else ():
        neighbours[rows] = _nearest(wanted[rows], exact, available)[1]
    if queries is None:
        neighbours = _self_first(neighbours)
    return neighbours if available == k else torch.cat([neighbours, neighbours[:, -1:].expand(-1, k - available)], 1)


_FEW_POINTS = 700
_SLAB_QUERIES = 192
_SLAB_MARGIN = 0.02
_LARGEST_TABLE = 4_000_000


def _nearest(queries: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Squared distances and indices (Q, k) of the nearest points, both in ascending order of distance."""
    # |q - p|^2 = [q, |q|^2, 1] . [-2 p, 1, |p|^2]; only the sum is small enough for float32.
    left = torch.cat([queries, queries.square().sum(dim=1, keepdim=True), torch.ones_like(queries[:, :1])], dim=1)
    right = torch.cat([-2 * points, torch.ones_like(points[:, :1]), points.square().sum(dim=1, keepdim=True)], dim=1)
    nearest = (left @ right.T).float().topk(k, largest=False)
    return nearest.values, nearest.indices


def _self_first(neighbours: Tensor) -> Tensor:
    """Puts each row's own index first; coincident points may otherwise come before it or crowd it out."""
    own = torch.arange(len(neighbours), device=neighbours.device)
    position = torch.where(neighbours == own[:, None], 0, 1)
    order = position.sort(dim=1, stable=True).indices
    neighbours = neighbours.gather(1, order)
    neighbours[:, 0] = own
    return neighbours


def statistical_outliers(points: Tensor, neighbours: Tensor, std_ratio: float) -> Tensor:
    """Mask (P,) of points whose mean distance to their neighbours (P, k), themselves included, is unusually large.

    Unusual is above mean + std_ratio * standard deviation over the cloud (as Open3D's remove_statistical_outlier).
    """
    mean_distances = (points[neighbours] - points[:, None]).norm(dim=2).mean(dim=1)
    if len(points) < 2:
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    outliers: Tensor = mean_distances > mean_distances.mean() + std_ratio * mean_distances.std()
    return outliers


def drop_points(points: Tensor, neighbours: Tensor, keep: Tensor) -> tuple[Tensor, Tensor]:
    """Points (P', 3) and exact neighbours (P', k) after dropping the points where `keep` (P,) is false.

    Only rows that had a dropped neighbour are searched again.
    """
    if bool(keep.all()):
        return points, neighbours
    new_index = keep.cumsum(0) - 1
    kept_points, kept_neighbours = points[keep], neighbours[keep]
    stale = (~keep[kept_neighbours]).any(dim=1)
    renumbered = new_index[kept_neighbours]
    if len(kept_points) < neighbours.shape[1]:
        return kept_points, nearest_neighbours(kept_points, neighbours.shape[1])
    if bool(stale.any()):
        fresh = nearest_neighbours(kept_points, neighbours.shape[1], kept_points[stale])
        own = stale.nonzero()[:, 0]
        moved = torch.where(fresh == own[:, None], 0, 1).sort(dim=1, stable=True).indices
        fresh = fresh.gather(1, moved)
        fresh[:, 0] = own
        renumbered[stale] = fresh
    return kept_points, renumbered


def estimate_normals(points: Tensor, neighbours: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Unit normals (P, 3) of unknown sign and spectra (P, 2), fitted to the neighbours (P, k) within `radius`.

    The normal is the eigenvector of the smallest eigenvalue of the neighbours' covariance, found in closed form; the
    spectrum is (smallest, middle) / sum of the eigenvalues.
    """
    offsets = (points[neighbours] - points[:, None]).double()
    weights = (offsets.square().sum(dim=2) <= radius * radius).double()
    total = weights.sum(dim=1).clamp(min=1)
    mean = (offsets * weights[..., None]).sum(dim=1) / total[:, None]
    centred = (offsets - mean[:, None]) * weights[..., None]
    covariance = centred.transpose(1, 2) @ centred / total[:, None, None]
    eigenvalues, normals = smallest_eigenvector(covariance)
    spectrum = eigenvalues[:, :2] / eigenvalues.sum(dim=1, keepdim=True).clamp(min=1e-18)
    return normals.to(points.dtype), spectrum.to(points.dtype)


def smallest_eigenvector(symmetric: Tensor) -> tuple[Tensor, Tensor]:
    """Ascending eigenvalues (B, 3) and the unit eigenvector (B, 3) of the smallest, of symmetric matrices (B, 3, 3).

    Eigenvalues by the trigonometric solution of the characteristic polynomial (Smith 1961, "Eigenvalues of a
    symmetric 3 x 3 matrix"); the eigenvector is the longest cross product of two rows of A - lambda I. Where the
    smallest eigenvalue is not distinct, it is some unit vector of its eigenspace.
    """
    identity = torch.eye(3, dtype=symmetric.dtype, device=symmetric.device)
    scale = symmetric.abs().amax(dim=(1, 2)).clamp(min=torch.finfo(symmetric.dtype).tiny)
    a = symmetric / scale[:, None, None]
    mean = a.diagonal(dim1=1, dim2=2).mean(dim=1)
    deviator = a - mean[:, None, None] * identity
    p = (deviator.square().sum(dim=(1, 2)) / 6).sqrt().clamp(min=1e-150)
    half_determinant = (torch.linalg.det(deviator / p[:, None, None]) / 2).clamp(-1, 1)
    angle = half_determinant.acos() / 3
    turns = torch.tensor([2.0, 4.0, 0.0], dtype=a.dtype, device=a.device) * (torch.pi / 3)
    eigenvalues = mean[:, None] + 2 * p[:, None] * torch.cos(angle[:, None] + turns)
    eigenvalues = eigenvalues.sort(dim=1).values
    shifted = a - eigenvalues[:, :1, None] * identity
    products = torch.linalg.cross(shifted, shifted[:, [1, 2, 0]], dim=2)
    lengths = products.norm(dim=2)
    best = lengths.argmax(dim=1)
    rows = torch.arange(len(a), device=a.device)
    vector, length = products[rows, best], lengths[rows, best]
    # With two equal eigenvalues every row is a multiple of the third eigenvector, and any vector across it is right.
    row = shifted[rows, shifted.norm(dim=2).argmax(dim=1)]
    across = torch.linalg.cross(row, identity[row.abs().argmin(dim=1)], dim=1)
    across_length = across.norm(dim=1)
    fallback = torch.where(
        (across_length < 1e-14)[:, None], identity[2], across / across_length.clamp(min=1e-300)[:, None]
    )
    vector = torch.where((length < 1e-14)[:, None], fallback, vector / length.clamp(min=1e-300)[:, None])
    return eigenvalues.clamp(min=0) * scale[:, None], vector


def orient_normals(points: Tensor, normals: Tensor, viewpoints: Tensor) -> tuple[Tensor, Tensor]:
    """Normals (P, 3) turned towards, and unit directions (P, 3) to, the viewpoint (of V, 3) most nearly along each."""
    to_viewpoints = viewpoints[None] - points[:, None]
    directions = to_viewpoints / to_viewpoints.norm(dim=2, keepdim=True).clamp(min=1e-9)
    alignment = (directions * normals[:, None]).sum(dim=2)
    best = alignment.abs().argmax(dim=1)
    rows = torch.arange(len(points), device=points.device)
    sign = torch.where(alignment[rows, best] < 0, -1.0, 1.0)
    return normals * sign[:, None], directions[rows, best]
