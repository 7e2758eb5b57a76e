from __future__ import annotations

import numpy as np
import torch

from tesnet.patches import group, pool
from tesnet.points import sight_axes
from tests.tesnet.scenes import prepared, tabletop_query

SIZE = 0.011


def test_a_patch_is_the_mean_of_the_points_in_its_cell() -> None:
    ready = prepared(tabletop_query())
    patches = group(ready, SIZE)
    axes = sight_axes(ready.points, ready.viewpoints[0])
    cells = ((ready.points - ready.points.mean(dim=0)) @ axes / SIZE + 0.5).floor().long().numpy()
    assert len({tuple(cell) for cell in cells}) == len(patches)
    for number in range(0, len(patches), 7):
        members = (patches.member_of == number).numpy()
        assert len({tuple(cell) for cell in cells[members]}) == 1
        np.testing.assert_allclose(patches.points[number], ready.points.numpy()[members].mean(axis=0), atol=1e-6)
        normal = ready.normals.numpy()[members].mean(axis=0)
        np.testing.assert_allclose(patches.normals[number], normal / np.linalg.norm(normal), atol=1e-4)
    assert (patches.neighbours[:, 0] == torch.arange(len(patches))).all()


def test_pooling_takes_the_largest_of_each_feature_over_the_members() -> None:
    ready = prepared(tabletop_query())
    patches = group(ready, SIZE)
    features = torch.rand(len(ready), 5, generator=torch.Generator().manual_seed(1))
    pooled = pool(features, patches.member_of, len(patches))
    for number in range(0, len(patches), 5):
        torch.testing.assert_close(pooled[number], features[patches.member_of == number].amax(dim=0))
