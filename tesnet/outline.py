"""The outline of faces: where a face ends, its wall is not seen, and the camera sees past the edge straight down.

Knows no hand and no candidate. Vectorised torch; lengths in metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from tesnet.cloud import SUPPORT_NOISE, PreparedCloud, posted_points
from tesnet.points import smallest_eigenvector
from tesnet.query import GraspQuery
from tesnet.ranges import RangeImage, range_image

_STEEPEST = math.cos(math.radians(20))
"""Faces are seen from straight above where the direction of view is this near to `up`."""

MOST_LEAN = math.tan(math.radians(20))
"""Across an edge the line of sight leans no farther off the travel: beside it a finger's place is seen, and no wall."""

_FLATTEST = 0.8
"""Faces lie across the travel: the cosine of their normal with its opposite is more."""

_ONE_SIDED = 0.45
"""Length of the mean offset of a point's neighbours, of their mean distance: 0 within a face, 0.3 a row inside a
straight edge, 0.6 on the edge, 0.9 in a corner."""

_SAME_FACE = 0.004
"""Neighbours this far above or below a point are not of its face."""

_ONE_EDGE = math.cos(math.radians(60))
"""Neighbours whose first directions agree better than this lie along one edge, not round a corner."""

_FEWEST_ON_LINE = 4

_BESIDE = (0.007, 0.011, 0.015)
"""How far outside of an edge one looks for what lies beyond: past the pixel of the edge itself."""

_DROP = 0.006
"""What lies beyond an edge is at least so much farther away than the face."""

_LOW_DROP, _LEAST_DROP = 0.6, 0.0015
"""Beyond the edge of a low face it is this share of the face's height over the support, and no less than so many
metres, where that is less than `_DROP`."""

_WALL = 0.5
"""A neighbour belongs to the wall under an edge where the cosine of its normal with the edge's direction is more."""

LOW = 0.017
"""Over the support: fingertips 7 mm past a contact point, 4 mm over the support and 3 mm under the approach point need
14 mm, and heights are noisy."""

_CUT = 0.01
"""Edges this near to an upright side of the workspace are where the cloud was cut."""

_OF_PLANE = SUPPORT_NOISE / 2
"""Points lower than this over the support plane are its own, and no remains of a thing that a crop has cut."""

_FEWEST_OF_PLANE = 0.01
"""Share of the posted points that lie on the support plane; with fewer the caller has removed it."""


@dataclass(frozen=True, eq=False, slots=True)
class Outline:
    """E points on the outline of faces.

    Args:
        points: (E,) indices in the cloud.
        outward: (E, 3) unit directions out of the face, across the travel.
        travel: (E, 3) unit, into the face: against `up` or, where that is not known, along the sight.
    """

    points: Tensor
    outward: Tensor
    travel: Tensor


def outline(cloud: PreparedCloud, query: GraspQuery) -> Outline:
    """The points where a face ends, its wall is not seen, and the camera saw that something lies farther away beyond.

    What lies beyond is looked up in all posted points, not in the prepared ones, so a face that the workspace or the
    cell limit cuts does not end there. Where no point was posted beyond, the image may have ended: such an edge counts
    only where a support plane is known whose own points the caller has removed, and not at a side of the workspace.
    What such a caller's image cut off cannot be told from an edge. Where the camera's pose is in doubt, faces have an
    outline only where they are seen from straight above.
    """
    travel = -(cloud.view_directions if cloud.up is None else cloud.up.expand_as(cloud.points))
    ends = _Ends.of(cloud, travel)
    found = (ends.one_sided & ((cloud.normals * -travel).sum(dim=1) > _FLATTEST)).nonzero()[:, 0]
    outward = _across_line(ends.level[found], ends.on_edge_of(cloud, found), ends.outward[found], travel[found])
    walls = (cloud.normals[cloud.neighbours[found]] * outward[:, None]).sum(dim=2) > _WALL
    sight = cloud.view_directions[found]
    lean, drop = (sight * outward).sum(dim=1), (sight * -travel[found]).sum(dim=1)
    seen_past = (lean.abs() <= MOST_LEAN * drop) & (drop >= (_STEEPEST if cloud.pose_in_doubt else 0.0))
    ends_in_air = ~walls.any(dim=1) & (seen_past | is_low(cloud)[found])
    found, outward = found[ends_in_air], outward[ends_in_air]
    if len(found):
        away = _falls_away(cloud, query, found, outward)
        found, outward = found[away], outward[away]
    return Outline(found, outward, travel[found])


def is_low(cloud: PreparedCloud) -> Tensor:
    """Mask (P,) of the points so near to the support that no wall of their thing is seen from anywhere."""
    if cloud.up is None or cloud.support_height is None:
        return torch.zeros(len(cloud), dtype=torch.bool, device=cloud.points.device)
    return cloud.points @ cloud.up - cloud.support_height < LOW


@dataclass(frozen=True, eq=False, slots=True)
class _Ends:
    """Where faces end, at first sight.

    Args:
        level: (P, k, 3) offsets of the neighbours, across the travel.
        same_face: (P, k) whether the neighbour is of the point's face.
        outward: (P, 3) unit directions away from the neighbours on the same face.
        one_sided: (P,) whether these are all on one side.
    """

    level: Tensor
    same_face: Tensor
    outward: Tensor
    one_sided: Tensor

    @classmethod
    def of(cls, cloud: PreparedCloud, travel: Tensor) -> _Ends:
        """Those of a cloud, for hands that travel (P, 3) that way."""
        offsets = cloud.points[cloud.neighbours] - cloud.points[:, None]
        rise = (offsets * travel[:, None]).sum(dim=2)
        level = offsets - rise[..., None] * travel[:, None]
        same_face = rise.abs() <= _SAME_FACE
        weight = same_face.to(level.dtype)[..., None]
        mean = (level * weight).sum(dim=1)
        one_sided = mean.norm(dim=1) > _ONE_SIDED * (level.norm(dim=2, keepdim=True) * weight).sum(dim=1)[:, 0]
        return cls(level, same_face, normalize(-mean, dim=1), one_sided)

    def on_edge_of(self, cloud: PreparedCloud, rows: Tensor) -> Tensor:
        """Mask (R, k) of the neighbours that are on the same edge as the points `rows` (R,)."""
        neighbours = cloud.neighbours[rows]
        alike = (self.outward[neighbours] * self.outward[rows][:, None]).sum(dim=2) > _ONE_EDGE
        return self.one_sided[neighbours] & alike & self.same_face[rows]


def _across_line(level: Tensor, on_line: Tensor, outward: Tensor, travel: Tensor) -> Tensor:
    """Unit directions (P, 3) across the line through the neighbours on the same edge, on the side of `outward`.

    The mean offset alone is good to 30 degrees.

    Args:
        level: (P, k, 3) offsets of the neighbours, across the travel.
        on_line: (P, k) which of them are on the edge; where fewer than `_FEWEST_ON_LINE`, `outward` remains.
        outward: (P, 3) the direction at first sight.
        travel: (P, 3) unit.
    """
    weight = on_line.double()[..., None]
    count = weight.sum(dim=1)
    offsets = level.double()
    centred = (offsets - ((offsets * weight).sum(dim=1) / count.clamp(min=1))[:, None]) * weight
    covariance = centred.transpose(1, 2) @ centred
    along_travel = travel.double()[:, :, None] * travel.double()[:, None, :]
    spread = covariance.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    _, across = smallest_eigenvector(covariance + (spread + 1e-9) * along_travel)
    across = across.to(outward.dtype)
    across = torch.where((across * outward).sum(dim=1, keepdim=True) < 0, -across, across)
    across = normalize(across - (across * travel).sum(dim=1, keepdim=True) * travel, dim=1)
    return torch.where(count >= _FEWEST_ON_LINE, across, outward)


def _falls_away(cloud: PreparedCloud, query: GraspQuery, edge: Tensor, outward: Tensor) -> Tensor:
    """Mask (E,) of edge points beyond which every posted point is farther away, and one is, or the removed plane."""
    steps = torch.tensor(_BESIDE, device=edge.device)
    places = cloud.points[edge][:, None] + steps[:, None] * outward[:, None]
    posted = posted_points(query, cloud.T_cloud_canonical, edge.device)
    to_viewpoints = normalize(cloud.viewpoints[None] - cloud.points[edge][:, None], dim=2)
    viewer = (to_viewpoints * cloud.view_directions[edge][:, None]).sum(dim=2).argmax(dim=1)
    gap = torch.full(places.shape[:2], torch.nan, device=edge.device)
    for number in viewer.unique().tolist():
        rows = viewer == number
        image = _image(cloud.viewpoints[number], posted, places[rows])
        if image is not None:
            depth, first = image.look(places[rows])
            gap[rows] = image.depths[first] - depth
    empty = ~gap.isfinite()
    farther = (gap > _drop(cloud, edge)) | empty
    seen_beyond = ~empty.all(dim=1)
    return farther.all(dim=1) & (seen_beyond | _where_plane_was_removed(cloud, posted, edge))


def _drop(cloud: PreparedCloud, edge: Tensor) -> Tensor:
    """(E, 1) how much farther away what lies beyond the edge points is, at least."""
    drop = cloud.points.new_full((len(edge), 1), _DROP)
    if cloud.up is None or cloud.support_height is None:
        return drop
    height = cloud.points[edge] @ cloud.up - cloud.support_height
    return drop.minimum(_LOW_DROP * height[:, None]).clamp(min=_LEAST_DROP)


def _image(viewpoint: Tensor, posted: Tensor, places: Tensor) -> RangeImage | None:
    """What the viewpoint saw in the directions of the places (E, B, 3)."""
    rays = normalize(places.reshape(-1, 3) - viewpoint, dim=1)
    middle = normalize(rays.mean(dim=0), dim=0)
    widest = torch.acos((rays @ middle).clamp(-1, 1).min()) + 0.02
    within = normalize(posted - viewpoint, dim=1) @ middle >= torch.cos(widest)
    return range_image(viewpoint, posted[within]) if bool(within.any()) else None


def _where_plane_was_removed(cloud: PreparedCloud, posted: Tensor, edge: Tensor) -> Tensor:
    """Mask (E,) of edges beyond which nothing was posted because the caller removed the support plane."""
    if cloud.up is None or cloud.support_height is None:
        return torch.zeros(len(edge), dtype=torch.bool, device=edge.device)
    on_plane = (posted @ cloud.up - cloud.support_height).abs() < _OF_PLANE
    removed = float(on_plane.float().mean()) < _FEWEST_OF_PLANE
    distance = cloud.points[edge] @ cloud.sides[:, :3].T - cloud.sides[:, 3]
    return (distance.abs() >= _CUT).all(dim=1) & removed
