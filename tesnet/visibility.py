"""What the camera saw, what lies hidden behind it, by an image of ranges for each viewpoint, and what was left out.

Knows no hand. Vectorised torch; lengths in metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tesnet.cloud import PreparedCloud
from tesnet.points import sight_axes

_PIXEL = 0.006
"""Width of a pixel at the cloud's distance, metres: somewhat more than the spacing of prepared points."""

_LARGEST_IMAGE = 512


def depth_behind(cloud: PreparedCloud, places: Tensor) -> Tensor:
    """How far places (..., 3) lie behind the surface that covers them, seen from the viewpoint that sees them best.

    Negative in front of what is seen; -infinity where no observed point lies in that direction, so that the camera
    looked past the place. Positive for a place that every viewpoint's sight is blocked of.
    """
    depths = torch.stack([_depth_behind(viewpoint, cloud.points, places) for viewpoint in cloud.viewpoints])
    return depths.amin(dim=0)


def outside(cloud: PreparedCloud, places: Tensor) -> Tensor:
    """How far places (..., 3) lie outside the nearest side of the workspace; negative inside, -infinity without sides.

    Nothing is known of what stands there: its points were ignored.
    """
    if len(cloud.sides) == 0:
        return torch.full(places.shape[:-1], -torch.inf, dtype=places.dtype, device=places.device)
    return (places @ cloud.sides[:, :3].T - cloud.sides[:, 3]).amax(dim=-1)


def _depth_behind(viewpoint: Tensor, points: Tensor, places: Tensor) -> Tensor:
    rays = points - viewpoint
    basis = sight_axes(points, viewpoint)

    def project(vectors: Tensor) -> tuple[Tensor, Tensor]:
        local = vectors @ basis
        ahead = local[..., 2].clamp(min=1e-6)
        return local[..., :2] / ahead[..., None], local[..., 2]

    plane, depth = project(rays)
    seen = depth > 0
    plane, depth = plane[seen], depth[seen]
    unseen = torch.full(places.shape[:-1], -torch.inf, dtype=places.dtype, device=places.device)
    if len(depth) == 0:
        return unseen
    # The spacing of the prepared points is near constant, so its angle is spacing / depth.
    low, high = plane.min(dim=0).values, plane.max(dim=0).values
    pixel = torch.clamp((high - low).max() / _LARGEST_IMAGE, min=float(_PIXEL / depth.median()))
    columns = int((high[1] - low[1]) / pixel) + 1
    rows = int((high[0] - low[0]) / pixel) + 1
    cells = ((plane - low) / pixel).long()
    nearest = torch.full((rows * columns,), torch.inf, device=points.device)
    nearest = nearest.scatter_reduce(0, cells[:, 0] * columns + cells[:, 1], depth, "amin")
    place_plane, place_depth = project(places - viewpoint)
    place_cells = ((place_plane - low) / pixel).floor().long()
    inside = ((place_cells >= 0) & (place_cells < torch.tensor([rows, columns], device=places.device))).all(dim=-1)
    flat = (place_cells[..., 0] * columns + place_cells[..., 1]).clamp(0, rows * columns - 1)
    return torch.where(inside & (place_depth > 0), place_depth - nearest[flat], unseen)
