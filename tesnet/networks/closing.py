"""What lies about a candidate's hand: the points of a cloud in a box of its grasp frame.

Shared by the networks that look there and nowhere else, with the preparation that they need. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.networks.network import mirror_factors
from tesnet.points import points_in_grasp_frames

FINE = PreparationConfig(voxel_size=0.0025, normal_neighbours=40, graph_neighbours=1)
"""Cells of 2.5 mm: with the 4.5 mm of the other networks some sixty points lie between the fingers. Normals are fitted
to 40 points, which cover about the area that 14 points of the coarser grid do. No graph is used."""

_LARGEST_MASK = 2_000_000


@dataclass(frozen=True, slots=True)
class Box:
    """A box in the grasp frame.

    Args:
        breadth, length: half extents along x and y, about the TCP.
        behind, ahead: extents along -z and +z from the TCP.
    """

    breadth: float
    length: float
    behind: float
    ahead: float

    @property
    def low(self) -> Tensor:
        """(3,) the smallest coordinates."""
        return torch.tensor([-self.breadth, -self.length, -self.behind])

    @property
    def size(self) -> Tensor:
        """(3,) the extents."""
        return torch.tensor([2 * self.breadth, 2 * self.length, self.behind + self.ahead])


@dataclass(frozen=True, eq=False, slots=True)
class Members:
    """Points that lie in boxes, K in all, in the order of the boxes.

    Args:
        row: (K,) box.
        point: (K,) index of the point in its cloud.
        total: (C,) points in each box.
    """

    row: Tensor
    point: Tensor
    total: Tensor

    def table(self, count: int) -> Tensor:
        """(C, count) indices of the first `count` members of each box, repeated from the start where there are fewer.

        Rows of empty boxes hold 0.
        """
        if len(self.point) == 0:
            return torch.zeros(len(self.total), count, dtype=torch.long, device=self.row.device)
        first = self.total.cumsum(0) - self.total
        place = torch.arange(count, device=self.row.device) % self.total.clamp(min=1)[:, None]
        index = self.point[(first[:, None] + place).clamp(max=len(self.point) - 1)]
        return index * (self.total > 0)[:, None]


def judged_in_parts(
    judge: Callable[[PreparedCloud, Tensor, Tensor], Tensor],
    cloud: PreparedCloud,
    poses: Tensor,
    mirror: Tensor | None,
    at_once: int,
) -> Tensor:
    """Logits (C,) of the poses (C, 4, 4), of at most `at_once` at a time, so that memory does not grow with C.

    Args:
        judge: gives the logits of some poses, and of the signs of their mirror.
        cloud: that the poses are in.
        poses: of the hands.
        mirror: (C,) as `Network.score` takes it.
        at_once: poses in memory.
    """
    signs = torch.ones(len(poses), device=poses.device) if mirror is None else mirror
    parts = zip(poses.split(at_once), signs.split(at_once), strict=True)
    return torch.cat([judge(cloud, *part) for part in parts])


def members_of(points: Tensor, poses: Tensor, box: Box) -> Members:
    """The points (P, 3) in the box of each grasp frame (C, 4, 4); in each box in a fixed pseudo-random order."""
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0)).to(points.device)
    shuffled = points[order]
    rows, found, totals = [], [], []
    done = 0
    for some in poses.split(max(1, _LARGEST_MASK // max(1, len(points)))):
        x, y, z = points_in_grasp_frames(shuffled, some)
        within = (x.abs_() < box.breadth) & (y.abs_() < box.length) & (z > -box.behind) & (z < box.ahead)
        row, column = within.nonzero(as_tuple=True)
        rows.append(row + done)
        found.append(order[column])
        totals.append(within.sum(dim=1))
        done += len(some)
    return Members(torch.cat(rows), torch.cat(found), torch.cat(totals))


def seen_from_hand(
    cloud: PreparedCloud, poses: Tensor, mirror: Tensor | None, row: Tensor, point: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions and normals (K, 3) of points `point` (K,) in the grasp frames `row` (K,) of the poses (C, 4, 4).

    Where `mirror` (C,) is -1, reflected in the hand's plane: x changes its sign.
    """
    rotation = poses[:, :3, :3]
    if mirror is not None:
        rotation = rotation * mirror_factors(mirror)[:, None]
    rotation, origin = rotation[row], poses[row, :3, 3]
    positions = ((cloud.points[point] - origin)[:, None] @ rotation)[:, 0]
    normals = (cloud.normals[point][:, None] @ rotation)[:, 0]
    return positions, normals
