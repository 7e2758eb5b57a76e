"""What a training view is varied by: centred, turned at random, its options withheld now and then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tesnet.geometry import Pose
from training.views import LabelledView

WITHHOLD_UP = 0.1
WITHHOLD_SUPPORT = 0.1
WITHHOLD_SIDES = 0.1
"""Chances that a view is shown without `up` (and so without support plane and sides), without the plane, and without
the sides of the workspace."""


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
    shift = torch.stack([centre, centre, torch.zeros(3), torch.zeros(3)])  # two points and two directions
    return replace(view, cloud=turned, pairs=(view.pairs - shift) @ turn.T)
