"""What is done with bare points: voxel grid, neighbours, outliers, normals, and the frames that they are seen in.

Knows no query, no candidate and no hand. Vectorised torch on the device of its inputs; lengths in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from small_gicp import KdTree
from torch import Tensor

_QUERIES_AT_ONCE = 1_000
"""Neighbours of so many are looked for in one or two milliseconds, in which no other Python thread runs."""

ROWS_AT_ONCE = 500_000
"""Rows of a large cloud that are in memory in double precision, or counted, at a time: some tens of milliseconds."""
_CELLS_COUNTED = 16_000_000
"""Of a grid of so many, all are counted; of a larger one, or one of few points, those that are occupied are sorted."""

_SLAB_QUERIES, _STRIP_QUERIES = 768, 128

_NEARLY_FARTHEST = 0.7
"""Of the distance of the farthest point from those chosen: from here on a point is chosen in the same round."""

_LARGEST_TABLE = 4_000_000
"""Distances that are in memory at a time, at most."""


def voxel_downsample(points: Tensor, voxel_size: float, between: Callable[[], None] = lambda: None) -> Tensor:
    """The mean of the rows (N, 3 or more), which begin with x, y, z, in every occupied cell, in the order of the cells.

    The grid's corner lies half a cell below the smallest coordinates, as in Open3D.
    """
    return cells_of(points, voxel_size, between)[0]


def cells_of(points: Tensor, voxel_size: float, between: Callable[[], None] = lambda: None) -> tuple[Tensor, Tensor]:
    """The means of `voxel_downsample`, and how many rows each is of. `between` is called between blocks of rows."""
    corner = points[:, :3].min(dim=0).values
    member_of, counts = members_of_cells(points[:, :3], voxel_size, corner, shift=0.5, between=between)
    sums = torch.zeros(len(counts), points.shape[1], dtype=torch.float64, device=points.device)
    for rows, members in zip(points.split(ROWS_AT_ONCE), member_of.split(ROWS_AT_ONCE), strict=True):
        between()
        sums.index_add_(0, members, rows.double())
    return (sums / counts[:, None]).to(points.dtype), counts


def in_box(points: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Mask (N,) of the points (N, 3 or more) between two corners (3,)."""
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for axis in range(3):  # several times as fast as all axes at once
        inside &= (points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])
    return inside


def members_of_cells(
    points: Tensor,
    edge: float,
    origin: Tensor | None = None,
    *,
    shift: float = 0.0,
    between: Callable[[], None] = lambda: None,
) -> tuple[Tensor, Tensor]:
    """Of points (P, 3): the number (P,) of each one's cell among the occupied ones, in order, and their sizes.

    Args:
        points: at least one, of any frame.
        edge: of the cells, metres.
        origin: (3,) in the points' frame, unless it is theirs.
        shift: how many cells below the origin a corner of one lies.
        between: called between blocks of points.
    """
    origin = points.new_zeros(3) if origin is None else origin

    def index(some: Tensor) -> Tensor:
        found: Tensor = ((some - origin) / edge + shift).floor().long()
        return found

    first, last = index(torch.stack([points.amin(dim=0), points.amax(dim=0)]))
    extent = last - first + 1

    def keys(some: Tensor) -> Tensor:
        cells = index(some) - first
        numbers: Tensor = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
        return numbers

    blocks = points.split(ROWS_AT_ONCE)
    if math.prod(extent.tolist()) > min(_CELLS_COUNTED, 4 * len(points)):
        _, member_of, counts = torch.cat([keys(block) for block in blocks]).unique(
            return_inverse=True, return_counts=True
        )
        return member_of, counts
    counts = torch.zeros(int(extent.prod()), dtype=torch.int32, device=points.device)
    for block in blocks:
        between()
        counts.index_add_(0, keys(block), counts.new_ones(len(block)))
    number = (counts > 0).cumsum(0, dtype=torch.int32) - 1
    return torch.cat([number[keys(block)] for block in blocks]).long(), counts[counts > 0].long()


def nearest_neighbours(
    points: Tensor, k: int, queries: Tensor | None = None, between: Callable[[], None] = lambda: None
) -> Tensor:
    """Indices (Q, k) of the points (P, 3) nearest to each query (Q, 3), nearest first.

    Queries default to the points themselves; each is then its own first neighbour. With fewer than k points the last
    one is repeated. `between` is called between blocks of queries.
    """
    available = min(k, len(points))
    find = _by_distances if points.is_cuda else _by_tree
    neighbours = find(points, points if queries is None else queries, available, between)
    if queries is None:
        neighbours = _self_first(neighbours)
    return neighbours if available == k else torch.cat([neighbours, neighbours[:, -1:].expand(-1, k - available)], 1)


def _by_tree(points: Tensor, queries: Tensor, k: int, between: Callable[[], None]) -> Tensor:
    """On the CPU, by a k-d tree."""
    found = [np.empty((0, k), dtype=np.uint64)]
    if len(points):
        tree = KdTree(points.double().numpy())
        for block in queries.double().split(_QUERIES_AT_ONCE):
            between()
            found.append(tree.batch_knn_search(block.numpy(), k, num_threads=torch.get_num_threads())[0])
    return torch.from_numpy(np.concatenate(found).astype(np.int64))


def _by_distances(points: Tensor, queries: Tensor, k: int, between: Callable[[], None]) -> Tensor:
    """On a GPU, by all distances."""
    exact, wanted = points.double(), queries.double()
    found = [torch.empty(0, k, dtype=torch.long, device=points.device)]
    for block in wanted.split(max(1, _LARGEST_TABLE // len(points))):
        between()
        found.append(squared_distances(block, exact).topk(k, largest=False).indices)
    return torch.cat(found)


def count_within(points: Tensor, radius: float, between: Callable[[], None] = lambda: None) -> Tensor:
    """How many points (P, 3) lie within the radius of each, itself included: (P,). `between` as above."""
    exact = points.double()
    counts = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for rows, around in strips(exact, exact, radius, between):
        counts[rows] = (squared_distances(exact[rows], exact[around]) <= radius**2).sum(dim=1)
    return counts


def strips(
    points: Tensor, queries: Tensor, margin: float, between: Callable[[], None] = lambda: None
) -> Iterator[tuple[Tensor, Tensor]]:
    """The rows (R,) of some dozens of queries (Q, 3) near each other, and indices (A,) of the points (P, 3) about them.

    Queries are cut into slabs along the points' longest axis, slabs into strips along the second longest. All points
    at most `margin` from one of a strip's queries are about them. `between` is called between the slabs.
    """
    second, longest = (points.amax(dim=0) - points.amin(dim=0)).argsort()[1:].tolist()
    places, order = points[:, longest].sort()
    across_points = points[order, second]
    for slab in queries[:, longest].argsort().split(_SLAB_QUERIES):
        between()
        ends = torch.stack([queries[slab[0], longest] - margin, queries[slab[-1], longest] + margin])
        first, last = torch.searchsorted(places, ends).tolist()
        across = across_points[first:last]
        for rows in slab[queries[slab, second].argsort()].split(_STRIP_QUERIES):
            low, high = queries[rows[0], second] - margin, queries[rows[-1], second] + margin
            yield rows, order[first + ((across >= low) & (across <= high)).nonzero()[:, 0]]


def squared_distances(queries: Tensor, points: Tensor) -> Tensor:
    """(Q, P) of queries (Q, 3) from points (P, 3): float64, or their terms cancel."""
    # |q - p|^2 = [q, |q|^2, 1] . [-2 p, 1, |p|^2]
    left = torch.cat([queries, queries.square().sum(dim=1, keepdim=True), torch.ones_like(queries[:, :1])], dim=1)
    right = torch.cat([-2 * points, torch.ones_like(points[:, :1]), points.square().sum(dim=1, keepdim=True)], dim=1)
    return left @ right.T


def _self_first(neighbours: Tensor) -> Tensor:
    """Puts each row's own index first; coincident points may otherwise come before it or crowd it out."""
    own = torch.arange(len(neighbours), device=neighbours.device)
    position = torch.where(neighbours == own[:, None], 0, 1)
    order = position.sort(dim=1, stable=True).indices
    neighbours = neighbours.gather(1, order)
    neighbours[:, 0] = own
    return neighbours


def farthest_points(points: Tensor, count: int, start: int) -> Tensor:
    """Indices (min(count, P),) of points (P, 3) spread evenly, by farthest-point sampling with several points a round.

    In a round every chosen point's Voronoi cell offers its point farthest from it, and those are taken that are at
    least `_NEARLY_FARTHEST` times as far as the farthest of all; where fewer are wanted, the farthest ones. Plain
    farthest-point sampling (Gonzalez 1985) takes one point a round; here fewer rounds leave no point farther than 1.7
    times as far from the chosen ones (measured for 128 of them).
    """
    chosen = torch.tensor([start], device=points.device)
    distance = (points - points[start]).norm(dim=1)
    cell = torch.zeros(len(points), dtype=torch.long, device=points.device)
    count = min(count, len(points))
    while len(chosen) < count:
        reach = torch.zeros(len(chosen), device=points.device).scatter_reduce(0, cell, distance, "amax")
        is_farthest = (distance == reach[cell]) & (distance > 0)
        index = torch.where(is_farthest, torch.arange(len(points), device=points.device), len(points))
        first = torch.full((len(chosen),), len(points), device=points.device).scatter_reduce(0, cell, index, "amin")
        new = first[(first < len(points))]
        if len(new) == 0:  # the remaining points coincide with chosen ones
            break
        new = new[distance[new] >= _NEARLY_FARTHEST * distance.max()]
        new = new[distance[new].argsort(descending=True, stable=True)[: count - len(chosen)]]
        to_new = torch.cdist(points, points[new])
        nearest = to_new.min(dim=1)
        closer = nearest.values < distance
        cell = torch.where(closer, nearest.indices + len(chosen), cell)
        distance = torch.where(closer, nearest.values, distance)
        distance[new] = 0
        chosen = torch.cat([chosen, new])
    return chosen


def statistical_outliers(points: Tensor, neighbours: Tensor, std_ratio: float) -> Tensor:
    """Mask (P,) of points whose mean distance to their neighbours (P, k), themselves included, is unusually large.

    Unusual is above mean + std_ratio * standard deviation over the cloud (as Open3D's remove_statistical_outlier).
    """
    mean_distances = (points[neighbours] - points[:, None]).norm(dim=2).mean(dim=1)
    if len(points) < 2:
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    outliers: Tensor = mean_distances > mean_distances.mean() + std_ratio * mean_distances.std()
    return outliers


def drop_points(
    points: Tensor, neighbours: Tensor, keep: Tensor, between: Callable[[], None] = lambda: None
) -> tuple[Tensor, Tensor]:
    """Points (P', 3) and exact neighbours (P', k) after dropping the points where `keep` (P,) is false.

    Only rows that had a dropped neighbour are searched again, in blocks between which `between` is called.
    """
    if bool(keep.all()):
        return points, neighbours
    new_index = keep.cumsum(0) - 1
    kept_points, kept_neighbours = points[keep], neighbours[keep]
    stale = (~keep[kept_neighbours]).any(dim=1)
    renumbered = new_index[kept_neighbours]
    if len(kept_points) < neighbours.shape[1]:
        return kept_points, nearest_neighbours(kept_points, neighbours.shape[1], between=between)
    if bool(stale.any()):
        fresh = nearest_neighbours(kept_points, neighbours.shape[1], kept_points[stale], between)
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


LEAST_OUTWARD = 0.1
"""Length of the mean of unit vectors that say nothing together."""


def orient_normals(
    points: Tensor, normals: Tensor, viewpoints: Tensor, outward: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Normals (P, 3) turned outward, and unit directions (P, 3) to the viewpoint that sees each point.

    Where a direction out of the surface is given (`outward` (P, 3), zeros where not), normals are turned along it and
    the viewpoint (of V, 3) is the one most nearly in it; elsewhere both are those of the viewpoint most nearly along
    the normal's line.
    """
    to_viewpoints = viewpoints[None] - points[:, None]
    directions = to_viewpoints / to_viewpoints.norm(dim=2, keepdim=True).clamp(min=1e-9)
    alignment = (directions * normals[:, None]).sum(dim=2)
    best = alignment.abs().argmax(dim=1)
    rows = torch.arange(len(points), device=points.device)
    along = alignment[rows, best]
    if outward is not None:
        told = outward.norm(dim=1) > LEAST_OUTWARD
        best = torch.where(told, (directions * outward[:, None]).sum(dim=2).argmax(dim=1), best)
        along = torch.where(told, (normals * outward).sum(dim=1), along)
    sign = torch.where(along < 0, -1.0, 1.0)
    return normals * sign[:, None], directions[rows, best]


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


def points_in_grasp_frames(points: Tensor, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z, each (C, P), of the points (P, 3) in the grasp frames of the poses (C, 4, 4)."""
    rotations, origins = poses[:, :3, :3], poses[:, :3, 3]
    shifts = (origins[:, None, :] @ rotations)[:, 0]
    x, y, z = (torch.addmm(-shifts[:, axis : axis + 1], rotations[:, :, axis], points.T) for axis in range(3))
    return x, y, z
