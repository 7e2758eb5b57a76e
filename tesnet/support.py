"""Where the support plane is: `support_height="auto"`. Exhaustive along `up`, so nothing is sampled at random.

Lengths in metres. The plane is across `up` by definition; what is looked for is its height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tesnet.cloud import crop
from tesnet.points import voxel_downsample
from tesnet.query import GraspQuery

CELL = 0.005
"""Cells of this size are counted, not points, or what is near the camera would count more."""
THICKNESS = 0.010
"""A slab of this thickness holds a plane with the noise of a usual depth camera."""
LEAST_SHARE = 0.10
LEAST_CELLS = 100
LEAST_CONTRAST = 2.0
"""Upright walls, and planes that are not across `up`, fill one slab like the next; a plane across `up` holds at least
this many times the cells of the slab above it and of the slab below it."""
MOST_BELOW = 0.2
"""Nothing is seen through a support; under the top of a box are its sides. A share of the plane's cells."""
BELOW = 0.015
FOOTPRINT_CELL = 0.02
_REACH = 10.0
_TRIES = 8


@dataclass(frozen=True, slots=True)
class SupportPlane:
    """A plane across `up`.

    Args:
        height: along `up`.
        share: of the cloud's occupied cells, 0 to 1.
    """

    height: float
    share: float


def settled(query: GraspQuery, device: torch.device) -> tuple[GraspQuery, str]:
    """The query with the height of its dominant plane, or without one if there is none; and a note for the caller."""
    plane = dominant_plane(query, device)
    if plane is None:
        note = "support_height auto: no plane across up was found, so no support is kept clear: give the height, or up"
        return replace(query, support_height=None), note
    assert query.up is not None, "GraspQuery sees to it"
    height = plane.height + float(query.up @ query.offset)
    note = f"support_height auto: the plane at {height:.4f} m along up, {plane.share:.0%} of what is seen"
    return replace(query, support_height=plane.height), note


def dominant_plane(query: GraspQuery, device: torch.device) -> SupportPlane | None:
    """The plane across `up` with the largest surface in the workspace under which nothing is seen, if there is one."""
    assert query.up is not None, "GraspQuery sees to it"
    up = torch.tensor(query.up, dtype=torch.float32, device=device)
    points = crop(torch.from_numpy(query.points.copy()).to(device), replace(query, support_height=None))
    if len(points) == 0:
        return None
    points = points[(points - points.median(dim=0).values).norm(dim=1) <= _REACH]
    cells = voxel_downsample(points @ _basis(up), CELL)
    free = torch.ones(len(cells), dtype=torch.bool, device=device)
    for _ in range(_TRIES):
        height = _fullest(cells[free, 2])
        slab = _slab(cells, height)
        size = int(slab.sum())
        if size < max(LEAST_CELLS, LEAST_SHARE * len(cells)):
            return None
        beside = max(int(_slab(cells, height + step).sum()) for step in (-THICKNESS, THICKNESS))
        if size >= LEAST_CONTRAST * beside and _seen_below(cells, slab, height) <= MOST_BELOW * size:
            return SupportPlane(height, size / len(cells))
        free &= ~slab
        if not bool(free.any()):
            return None
    return None


def _basis(up: Tensor) -> Tensor:
    """(3, 3) with two directions across `up` and, last, `up` as columns."""
    helper = torch.eye(3, dtype=up.dtype, device=up.device)[up.abs().argmin()]
    across = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=0)
    return torch.stack([across, torch.linalg.cross(up, across), up], dim=1)


def _fullest(heights: Tensor) -> float:
    """The median height in the slab that holds most of the heights (C,)."""
    ordered = heights.sort().values
    ends = torch.searchsorted(ordered, ordered + THICKNESS, right=True)
    counts = ends - torch.arange(len(ordered), device=heights.device)
    first = int(counts.argmax())
    return float(ordered[first : int(ends[first])].median())


def _slab(cells: Tensor, height: float) -> Tensor:
    """Mask (C,) of the cells in a slab about a height."""
    return (cells[:, 2] - height).abs() <= THICKNESS / 2


def _seen_below(cells: Tensor, slab: Tensor, height: float) -> int:
    """How many cells lie under the slab, within its outline."""
    squares = (cells[:, :2] / FOOTPRINT_CELL).floor().long()
    squares -= squares.min(dim=0).values
    keys = squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]
    below = cells[:, 2] < height - BELOW
    return int(torch.isin(keys[below], keys[slab]).sum())
