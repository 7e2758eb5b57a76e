"""The image of ranges that a viewpoint has of points: which of them it sees first in each direction.

Knows bare points and no query. Vectorised torch on the device of its inputs; lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tesnet.points import sight_axes

PIXEL = 0.006
"""Width of a pixel at the points' distance, metres: somewhat more than the spacing of prepared points."""

_LARGEST_IMAGE = 512


@dataclass(frozen=True, eq=False, slots=True)
class RangeImage:
    """Depths along the line from a viewpoint to the middle of its points, in pixels that move with both.

    Args:
        viewpoint: (3,).
        axes: (3, 3) columns x, y and, away from the viewer, z.
        low: (2,) corner of the first pixel, on the plane at depth 1.
        pixel: () width of a pixel, on that plane.
        first: (rows, columns) the nearest point; past the last one where there is none.
        depths: (P + 1,) of the points, and infinity.
    """

    viewpoint: Tensor
    axes: Tensor
    low: Tensor
    pixel: Tensor
    first: Tensor
    depths: Tensor

    def look(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Of places (..., 3): their depth, and the index of the nearest point in their pixel.

        The index is the number of points, one past the last, where the pixel is empty, beyond the image or behind the
        viewer.
        """
        plane, depth = _project(places - self.viewpoint, self.axes)
        rows, columns = self.first.shape
        cells = ((plane - self.low) / self.pixel).floor().long()
        inside = ((cells >= 0) & (cells < torch.tensor([rows, columns], device=places.device))).all(dim=-1)
        flat = (cells[..., 0] * columns + cells[..., 1]).clamp(0, rows * columns - 1)
        return depth, torch.where(inside & (depth > 0), self.first.flatten()[flat], len(self.depths) - 1)


def range_image(viewpoint: Tensor, points: Tensor, width: float = PIXEL) -> RangeImage | None:
    """The image that a viewpoint (3,) has of points (P, 3); None where all of them lie behind it.

    Args:
        viewpoint: where the camera stood.
        points: what it looks at.
        width: of a pixel at the points' median depth, metres; wider where the image would be too large.
    """
    axes = sight_axes(points, viewpoint)
    plane, depths = _project(points - viewpoint, axes)
    seen = (depths > 0).nonzero()[:, 0]
    plane, depth = plane[seen], depths[seen]
    if len(seen) == 0:
        return None
    # The spacing of the points is near constant, so its angle is spacing / depth.
    low, high = plane.min(dim=0).values, plane.max(dim=0).values
    pixel = torch.clamp((high - low).max() / _LARGEST_IMAGE, min=float(width / depth.median()))
    columns = int((high[1] - low[1]) / pixel) + 1
    rows = int((high[0] - low[0]) / pixel) + 1
    cells = ((plane - low) / pixel).long()
    flat = cells[:, 0] * columns + cells[:, 1]
    nearest = torch.full((rows * columns,), torch.inf, device=points.device).scatter_reduce(0, flat, depth, "amin")
    is_nearest = depth == nearest[flat]
    first = torch.full((rows * columns,), len(points), device=points.device)
    first = first.scatter_reduce(0, flat[is_nearest], seen[is_nearest], "amin").reshape(rows, columns)
    return RangeImage(viewpoint, axes, low, pixel, first, torch.cat([depths, depths.new_tensor([torch.inf])]))


def _project(rays: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays (..., 3) meet the plane at depth 1, (..., 2), and their depths (...)."""
    local = rays @ axes
    ahead = local[..., 2].clamp(min=1e-6)
    return local[..., :2] / ahead[..., None], local[..., 2]
