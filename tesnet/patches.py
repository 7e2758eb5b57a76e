"""A cloud on a coarser level: the points of a cell as one patch. Knows no network and no grasp.

Vectorised torch; lengths in metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from tesnet.cloud import PreparedCloud
from tesnet.points import members_of_cells, nearest_neighbours, sight_axes


@dataclass(frozen=True, eq=False, slots=True)
class Patches:
    """The points of a prepared cloud in the cells of a grid.

    Args:
        points, normals, view_directions: (Q, 3) means over the members of each patch; the latter two of unit length.
        neighbours: (Q, k) nearest patches, each patch the first of its own.
        member_of: (P,) the patch of each point.
    """

    points: Tensor
    normals: Tensor
    view_directions: Tensor
    neighbours: Tensor
    member_of: Tensor

    def __len__(self) -> int:
        return len(self.points)


def pool(features: Tensor, member_of: Tensor, count: int) -> Tensor:
    """The largest of each feature (P, C) over the members of each of `count` patches, (count, C).

    Args:
        features: not negative.
        member_of: (P,) patch of each row.
        count: number of patches.
    """
    pooled = torch.zeros(count, features.shape[1], device=features.device)
    return pooled.scatter_reduce(0, member_of[:, None].expand_as(features), features, "amax")


def group(cloud: PreparedCloud, size: float) -> Patches:
    """The cloud in cells of edge `size`, whose grid is fixed to the cloud and its first viewpoint.

    Half a cell of shift keeps the point that the axes go through off every border.
    """
    axes = sight_axes(cloud.points, cloud.viewpoints[0])
    along_axes = (cloud.points - cloud.points.mean(dim=0)) @ axes
    member_of, counts = members_of_cells(along_axes, size, shift=0.5)
    sums = torch.zeros(len(counts), 9, device=member_of.device)
    sums.index_add_(0, member_of, torch.cat([cloud.points, cloud.normals, cloud.view_directions], dim=1))
    points, normals, view_directions = (sums / counts[:, None]).split(3, dim=1)
    return Patches(
        points=points,
        normals=functional.normalize(normals, dim=1),
        view_directions=functional.normalize(view_directions, dim=1),
        neighbours=nearest_neighbours(points, cloud.neighbours.shape[1]),
        member_of=member_of,
    )
