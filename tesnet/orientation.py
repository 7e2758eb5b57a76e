"""Which viewpoint saw each point of a cloud from several views, and so which way the surface faces there.

Knows bare points and no query. Vectorised torch on the device of its inputs; lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tesnet.points import LEAST_OUTWARD, orient_normals
from tesnet.ranges import range_image

_PIXEL = 0.009
"""Width of a pixel, metres: twice the spacing of prepared points, so that no sight passes between those of a wall."""

_IN_FRONT = 0.0015
"""A point hides another when it lies this far out of that one's surface, metres: walls may be as thin as twice this."""


def orient(
    points: Tensor,
    normals: Tensor,
    neighbours: Tensor,
    viewpoints: Tensor,
    outward: Tensor | None = None,
    between: Callable[[], None] = lambda: None,
) -> tuple[Tensor, Tensor]:
    """Normals (P, 3) turned outward, and unit directions (P, 3) to the viewpoint that saw each point.

    Args:
        points: (P, 3).
        normals: (P, 3) unit, of either sign.
        neighbours: (P, k) of each point, itself the first.
        viewpoints: (V, 3).
        outward: (P, 3) directions out of the surface where they are known, zeros elsewhere: given normals, or
            directions to the viewpoint that is known to have seen a point. There they decide.
        between: called between the viewpoints.
    """
    if len(viewpoints) > 1:
        seen_by = towards_who_saw(points, normals, neighbours, viewpoints, between)
        told = torch.zeros_like(points) if outward is None else outward
        outward = torch.where(told.norm(dim=1, keepdim=True) > LEAST_OUTWARD, told, seen_by)
    return orient_normals(points, normals, viewpoints, outward)


def towards_who_saw(
    points: Tensor,
    normals: Tensor,
    neighbours: Tensor,
    viewpoints: Tensor,
    between: Callable[[], None] = lambda: None,
) -> Tensor:
    """Unit directions (P, 3) from each point to the viewpoint that saw it.

    A viewpoint cannot have seen a point from whose surface others stand out in its line of sight. What hides a point
    from a camera is what that camera saw itself, so a surface is free on its outer side and, seen from behind, hidden
    by the other side of its thing. Of the two sides of a surface the one that is freer, to its neighbourhood's mean,
    is the outer one, and of the viewpoints there the one saw it that is least hidden and most along the normal.

    Args:
        points: (P, 3).
        normals: (P, 3) unit, of either sign.
        neighbours: (P, k) of each point, itself the first.
        viewpoints: (V, 3).
        between: called between the viewpoints.
    """
    to_viewpoints = viewpoints[None] - points[:, None]
    directions = to_viewpoints / to_viewpoints.norm(dim=2, keepdim=True).clamp(min=1e-9)
    along = (directions * normals[:, None]).sum(dim=2)
    views = []
    for viewpoint in viewpoints:
        between()
        views.append(_is_clear(points, normals, viewpoint))
    clear = torch.stack(views, dim=1)
    freedom = along * clear
    freer = freedom.amax(dim=1).clamp(min=0) + freedom.amin(dim=1).clamp(max=0)
    side = _mean_over_layer(freer, points, normals, neighbours)
    # Where both sides look alike, the viewpoint most nearly along the normal decides.
    strongest = along.gather(1, along.abs().argmax(dim=1, keepdim=True))[:, 0]
    sign = torch.where(torch.where(side == 0, strongest, side) < 0, -1.0, 1.0)
    facing = along * sign[:, None]
    best = torch.where(clear & (facing > 0), facing + 2, facing).argmax(dim=1)
    chosen: Tensor = directions[torch.arange(len(points), device=points.device), best]
    return chosen


def _is_clear(points: Tensor, normals: Tensor, viewpoint: Tensor) -> Tensor:
    """Mask (P,) of the points that none hides from the viewpoint (3,)."""
    image = range_image(viewpoint, points, _PIXEL)
    if image is None:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    _, first = image.look(points)
    ahead = first < len(points)  # else behind the viewer
    first = torch.where(ahead, first, 0)
    towards = ((viewpoint - points) * normals).sum(dim=1).sign()
    out_of_surface = ((points[first] - points) * normals).sum(dim=1) * towards
    return ahead & (out_of_surface <= _IN_FRONT)


def _mean_over_layer(signed: Tensor, points: Tensor, normals: Tensor, neighbours: Tensor) -> Tensor:
    """(P,) of values (P,) whose sign is that of the normals: mean over the neighbours on the same side of a wall."""
    offset = ((points[neighbours] - points[:, None]) * normals[:, None]).sum(dim=2)
    alike = (normals[neighbours] * normals[:, None]).sum(dim=2)
    weight = alike * alike.abs() * (offset.abs() <= _IN_FRONT)
    return (weight * signed[neighbours]).mean(dim=1)
