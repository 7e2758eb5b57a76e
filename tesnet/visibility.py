"""What the camera saw, what lies hidden behind it, and what was left out.

Knows no hand. Vectorised torch; lengths in metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tesnet.cloud import PreparedCloud
from tesnet.ranges import range_image

SHADOW_MARGIN = 0.01
"""Metres: a place is hidden when it lies so far behind the surface that covers it."""

FINE_SHADOW_MARGIN = 0.003
"""The same where the cloud's cells are so fine that the surface stands at its place."""


def hidden(
    cloud: PreparedCloud,
    places: Tensor,
    margin: float = SHADOW_MARGIN,
    between: Callable[[], None] = lambda: None,
) -> Tensor:
    """Mask (...) of the places (..., 3) of which observed points block the sight of every viewpoint.

    Args:
        cloud: what was observed.
        places: anywhere.
        margin: a place no deeper than this behind what covers it counts as seen, metres.
        between: called between the viewpoints.
    """
    return depth_behind(cloud, places, between) > margin


def depth_behind(cloud: PreparedCloud, places: Tensor, between: Callable[[], None] = lambda: None) -> Tensor:
    """How far places (..., 3) lie behind the surface that covers them, seen from the viewpoint that sees them best.

    Negative in front of what is seen; -infinity where no observed point lies in that direction, so that the camera
    looked past the place. Positive for a place that every viewpoint's sight is blocked of. `between` is called
    between the viewpoints.
    """
    least = torch.full(places.shape[:-1], torch.inf, dtype=places.dtype, device=places.device)
    for viewpoint in cloud.viewpoints:  # one after the other: of all together they take hundreds of MB
        between()
        least = torch.minimum(least, _depth_behind(viewpoint, cloud.points, places))
    return least


def outside(cloud: PreparedCloud, places: Tensor) -> Tensor:
    """How far places (..., 3) lie outside the nearest side of the workspace; negative inside, -infinity without sides.

    Nothing is known of what stands there: its points were ignored.
    """
    if len(cloud.sides) == 0:
        return torch.full(places.shape[:-1], -torch.inf, dtype=places.dtype, device=places.device)
    return (places @ cloud.sides[:, :3].T - cloud.sides[:, 3]).amax(dim=-1)


def _depth_behind(viewpoint: Tensor, points: Tensor, places: Tensor) -> Tensor:
    image = range_image(viewpoint, points)
    if image is None:
        return torch.full(places.shape[:-1], -torch.inf, dtype=places.dtype, device=places.device)
    depth, first = image.look(places)
    return depth - image.depths[first]
