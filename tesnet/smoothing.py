"""What clouds of noisy cameras need before anything is made of them: lone points dropped, surfaces made thin again.

Knows no query and no sensor: how noisy a cloud is, is measured on its points. Vectorised torch on the device of its
inputs; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tesnet.points import cells_of, count_within, smallest_eigenvector, squared_distances, strips

MOST_LONE = 0.0125
"""Share of lone points from which on they are flying pixels. Of quiet clouds 0.4 % are lone, on surfaces at a slant."""

MOST_POINTS = 40_000
"""Larger clouds stay as they are: their neighbours would take longer to find than the answer."""

_SAMPLE, _BLOCK = 400, 20
_LONE_RADIUS = 0.006
_LONE_SHARE = 0.06
"""A lone point has at most so large a part of the median number of others within `_LONE_RADIUS`."""
_FLAT_RADIUS = 0.008
"""Wide against the noise that is worth smoothing, narrow against the bend of things that are grasped."""
_FEWEST = 12
_QUARTER = 0.25
"""Of the sampled residuals, from the least: that of surfaces which are flat there."""

_FINE, _COARSE = 0.003, 0.005
"""Edges of the cells that are moved, and of those that planes are fitted to."""
_WIDTHS = (0.006, 0.010)
_DEVIATIONS = 3.0
"""The window's standard deviation is so many of the noise's, within `_WIDTHS`."""
_LEAST_WEIGHT = 0.25
"""Of the median: points that weigh less in their own window fly."""


@dataclass(frozen=True, slots=True)
class Noise:
    """How noisy a cloud is.

    Args:
        sd: of points about their surface, metres: the lower quartile of what is left of planes in balls of 8 mm. Noise
            that is alike over more than that does not show.
        lone: share of points that have hardly another one nearby.
        crowd: others within 6 mm of a point, the median.
    """

    sd: float
    lone: float
    crowd: float


def measured(points: Tensor) -> Noise:
    """The noise of a cloud (P, 3), by a sample of its points spread evenly over their order along x.

    A block of the sample is compared with the slab of points around it only.
    """
    cloud = points[points[:, 0].argsort()].double() - points.double().mean(dim=0)
    by_x, places = cloud[:, 0].contiguous(), cloud.float()
    moments = torch.cat(
        [torch.ones_like(cloud[:, :1]), cloud, (cloud[:, :, None] * cloud[:, None, :]).flatten(1)], dim=1
    )
    sample = torch.linspace(0, len(points) - 1, min(_SAMPLE, len(points)), device=points.device).long()
    crowds, sums = [], []
    for block in sample.split(_BLOCK):
        ends = torch.stack([by_x[block[0]] - _FLAT_RADIUS, by_x[block[-1]] + _FLAT_RADIUS])
        first, last = torch.searchsorted(by_x, ends).tolist()
        distances = torch.cdist(places[block], places[first:last])
        crowds.append((distances <= _LONE_RADIUS).sum(dim=1) - 1)
        sums.append((distances <= _FLAT_RADIUS).double() @ moments[first:last])
    others = torch.cat(crowds).double()
    residuals = smallest_eigenvector(_covariances(torch.cat(sums)))[0][:, 0].sqrt()
    crowd = float(others.median())
    # Of a sparse cloud every point is alone.
    lone = float((others <= _LONE_SHARE * crowd).double().mean()) if _LONE_SHARE * crowd >= 1 else 0.0
    return Noise(float(residuals.quantile(_QUARTER)) if len(residuals) else 0.0, lone, crowd)


def _covariances(sums: Tensor) -> Tensor:
    """(B', 3, 3) of sums (B, 13) of ones, places and products; of enough points, as after a plane's three numbers."""
    sums = sums[sums[:, 0] >= _FEWEST]
    counts, (means, products) = sums[:, :1], (sums[:, 1:] / sums[:, :1]).split([3, 9], dim=1)
    spread = products.view(-1, 3, 3) - means[:, :, None] * means[:, None, :]
    unbiased: Tensor = spread * (counts / (counts - 3))[..., None]
    return unbiased


def without_lone(table: Tensor, noise: Noise, between: Callable[[], None] = lambda: None) -> Tensor:
    """The rows (N, 3 or more), which begin with x, y, z, without flying pixels, where there are any.

    `between` is called between blocks of work of some tens of milliseconds.
    """
    if noise.lone <= MOST_LONE:
        return table
    return table[count_within(table[:, :3], _LONE_RADIUS, between) - 1 > _LONE_SHARE * noise.crowd]


def smoothed(table: Tensor, sd: float) -> Tensor:
    """Rows (M, 3 or more) that lie on planes fitted to the rows (N, 3 or more) about them, a row for each cell of 3 mm.

    A window weighs cells of 5 mm by their rows and by their distance; its width follows the noise. Cells with little
    in their window are dropped.

    Args:
        table: begins with x, y, z; what follows is averaged.
        sd: of the noise, metres.
    """
    width = min(max(_DEVIATIONS * sd, _WIDTHS[0]), _WIDTHS[1])
    fine, _ = cells_of(table, _FINE)
    samples, sizes = cells_of(table[:, :3], _COARSE)
    points = fine[:, :3].double()
    means, covariances, total = _windows(points, samples.double(), sizes.double(), width)
    kept = total >= _LEAST_WEIGHT * total.median()
    _, normals = smallest_eigenvector(covariances[kept])
    moved = points[kept] + ((means - points)[kept] * normals).sum(dim=1, keepdim=True) * normals
    return torch.cat([moved.to(table.dtype), fine[kept, 3:]], dim=1)


def _windows(points: Tensor, samples: Tensor, sizes: Tensor, width: float) -> tuple[Tensor, Tensor, Tensor]:
    """Means (P, 3), covariances (P, 3, 3) and weights (P,) of the samples (S, 3) in a window about each point (P, 3).

    A sample weighs its size (S,); the window is a Gaussian of this width and ends at twice the width.
    """
    sums = points.new_zeros(len(points), 13)
    for rows, around in strips(samples, points, 2 * width):
        middle = points[rows].mean(dim=0)
        queries, near = points[rows] - middle, samples[around] - middle
        squares = squared_distances(queries, near)
        weights = torch.exp(squares / (-2 * width**2)) * (squares <= 4 * width**2)
        products = (near[:, :, None] * near[:, None, :]).flatten(1)
        columns = torch.cat([torch.ones_like(near[:, :1]), near, products], dim=1) * sizes[around, None]
        found = weights @ columns
        means = found[:, 1:4] / found[:, :1]
        spread = found[:, 4:] / found[:, :1] - (means[:, :, None] * means[:, None, :]).flatten(1)
        sums[rows] = torch.cat([found[:, :1], means + middle, spread], dim=1)
    return sums[:, 1:4], sums[:, 4:].view(-1, 3, 3), sums[:, 0]
