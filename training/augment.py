"""What a training view is varied by: centred, turned at random, its options withheld now and then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from tesnet.cloud import MINIMUM_POINTS, PreparedCloud
from tesnet.geometry import Pose
from tesnet.points import drop_points, nearest_neighbours, orient_normals
from tesnet.visibility import hidden
from training.views import LabelledView

WITHHOLD_UP = 0.1
WITHHOLD_SUPPORT = 0.1
WITHHOLD_SIDES = 0.1
"""Chances that a view is shown without `up` (and so without support plane and sides), without the plane, and without
the sides of the workspace."""

CUT_OFF = 0.15
SHOW_TABLE = 0.1
"""Chances in `vary`: that a new side of the workspace cuts something off; that the table is in the cloud."""

_MOST_CUT_OFF = 0.35
_TABLE_SPACING = 0.0045
_TABLE_BEYOND = (0.0, 0.06)


def vary(view: LabelledView, rng: np.random.Generator) -> LabelledView:
    """The view as other callers would have sent it, now and then.

    Some have a smaller workspace, which cuts off neighbours or part of what is grasped; some do not know the plane that
    things stand on, and send the table. Outcomes stay what they were: whoever asks, the same things stand there.
    """
    if rng.random() < CUT_OFF:
        view = _cut_off(view, rng)
    if rng.random() < SHOW_TABLE:
        view = replace(view, cloud=_with_table(view.cloud, rng))
    return view


def _cut_off(view: LabelledView, rng: np.random.Generator) -> LabelledView:
    """Without what lies beyond one more upright side, and without the candidates of it; the same if none would stay."""
    cloud = view.cloud
    if cloud.up is None:
        return view
    outward = torch.linalg.cross(cloud.up, torch.from_numpy(rng.normal(size=3)).float())
    outward = torch.nn.functional.normalize(outward, dim=0)
    along = cloud.points @ outward
    distance = along.quantile(1 - _MOST_CUT_OFF * rng.random())
    keep = along <= distance
    which = (keep[view.approach] & keep[view.contact]).nonzero()[:, 0]
    if int(keep.sum()) < max(MINIMUM_POINTS, cloud.neighbours.shape[1]) or len(which) == 0:
        return view
    points, neighbours = drop_points(cloud.points, cloud.neighbours, keep)
    row = keep.cumsum(0) - 1
    of_points = {name: getattr(cloud, name)[keep] for name in ("normals", "spectrum", "view_directions")}
    side = torch.cat([outward, distance[None]])
    cut = replace(cloud, points=points, neighbours=neighbours, sides=torch.cat([cloud.sides, side[None]]), **of_points)
    left = view.only(which)
    return replace(left, cloud=cut, approach=row[left.approach], contact=row[left.contact])


def _with_table(cloud: PreparedCloud, rng: np.random.Generator) -> PreparedCloud:
    """With the table as the camera sees it about the things, on a grid; its height is then not known.

    Points of the table have the noise of the cloud's flattest ones, which their share of the spectrum tells.
    """
    if cloud.up is None or cloud.support_height is None:
        return cloud
    up, height = cloud.up, cloud.support_height
    across = torch.linalg.cross(up, torch.eye(3)[up.abs().argmin()])
    axes = torch.stack([across / across.norm(), torch.linalg.cross(up, across / across.norm())])
    spread = cloud.points @ axes.T
    beyond = rng.uniform(*_TABLE_BEYOND)
    first, last = spread.amin(dim=0) - beyond, spread.amax(dim=0) + beyond
    u, v = (torch.arange(float(a), float(b), _TABLE_SPACING) for a, b in zip(first, last, strict=True))
    grid = torch.cartesian_prod(u, v)
    places = grid @ axes + height * up
    places = places[~hidden(cloud, places)]
    flat = cloud.spectrum[:, 0].quantile(0.25)
    radius = math.sqrt(cloud.neighbours.shape[1] / math.pi) * _TABLE_SPACING
    deviation = flat.sqrt() * radius / math.sqrt(2)
    places = places + deviation * torch.from_numpy(rng.normal(size=len(places))).float()[:, None] * up
    normals, to_viewer = orient_normals(places, up.expand(len(places), 3), cloud.viewpoints)
    points = torch.cat([cloud.points, places])
    spectrum = torch.stack([flat, (1 - flat) / 2]).expand(len(places), 2)
    return replace(
        cloud,
        points=points,
        normals=torch.cat([cloud.normals, normals]),
        neighbours=nearest_neighbours(points, cloud.neighbours.shape[1]),
        spectrum=torch.cat([cloud.spectrum, spectrum]),
        view_directions=torch.cat([cloud.view_directions, to_viewer]),
        support_height=None,
    )


def augment(view: LabelledView, rng: np.random.Generator) -> LabelledView:
    """The view with its cloud centred (the paper's eq. 9) and turned at random (eqs. 10 to 12).

    TES-Net's inputs do not change under this, other networks' do. `up`, the support plane and the sides
    of the workspace are withheld in some views, since a caller may not know them.
    """
    cloud = view.cloud
    rotation = Pose.random(rng).rotation
    turn = torch.tensor(rotation, dtype=torch.float32)
    centre = cloud.points.mean(dim=0)
    height = cloud.support_height
    if height is not None and cloud.up is not None:
        height -= float(centre @ cloud.up)
    chance = rng.random()
    keep_up = chance >= WITHHOLD_UP
    sides = torch.cat([cloud.sides[:, :3] @ turn.T, cloud.sides[:, 3:] - cloud.sides[:, :3] @ centre[:, None]], dim=1)
    keep_sides = keep_up and rng.random() >= WITHHOLD_SIDES
    turned = replace(
        cloud,
        points=(cloud.points - centre) @ turn.T,
        normals=cloud.normals @ turn.T,
        view_directions=cloud.view_directions @ turn.T,
        viewpoints=(cloud.viewpoints - centre) @ turn.T,
        up=turn @ cloud.up if cloud.up is not None and keep_up else None,
        support_height=height if keep_up and chance >= WITHHOLD_UP + WITHHOLD_SUPPORT else None,
        sides=sides if keep_sides else sides[:0],
        T_cloud_canonical=cloud.T_cloud_canonical @ Pose(rotation, rotation @ -centre.double().numpy()).inverse(),
    )
    poses = view.poses.clone()
    poses[:, :3, 3] -= centre
    poses[:, :3] = turn @ poses[:, :3]
    return replace(view, cloud=turned, poses=poses)
