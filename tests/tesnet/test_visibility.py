from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tesnet.cloud import PreparedCloud
from tesnet.geometry import Box
from tesnet.visibility import FINE_SHADOW_MARGIN, SHADOW_MARGIN, depth_behind, hidden, outside
from tests.tesnet.scenes import CAMERA, UP, WORKSPACE, ask, prepared, tabletop


def wall() -> PreparedCloud:
    """A square wall of 0.2 m at z = 0, seen from 0.5 m above its middle."""
    grid = np.linspace(-0.1, 0.1, 101)
    x, y = np.meshgrid(grid, grid)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return prepared(ask(points, viewpoints=[[0.0, 0.0, 0.5]], up=[0.0, 0.0, 1.0]))


def places(cloud: PreparedCloud, positions: list[list[float]]) -> torch.Tensor:
    return torch.tensor(cloud.T_cloud_canonical.inverse().apply(np.array(positions)), dtype=torch.float32)


def test_depth_is_measured_from_the_surface_in_the_line_of_sight() -> None:
    cloud = wall()
    behind, before, beside = depth_behind(
        cloud, places(cloud, [[0, 0, -0.03], [0.01, 0, 0.04], [0.2, 0, -0.03]])
    ).tolist()
    assert abs(behind - 0.03) < 0.002
    assert abs(before + 0.04) < 0.002
    assert beside == -np.inf


def test_a_place_that_one_of_two_viewpoints_sees_is_not_hidden() -> None:
    cloud = wall()
    behind = places(cloud, [[0.0, 0.0, -0.05]])
    assert float(depth_behind(cloud, behind)) > 0.04
    from_below = places(cloud, [[0.0, 0.0, -0.5]])
    both = replace(cloud, viewpoints=torch.cat([cloud.viewpoints, from_below]))
    assert float(depth_behind(both, behind)) < -0.04


@pytest.mark.parametrize("margin", [SHADOW_MARGIN, FINE_SHADOW_MARGIN])
def test_hidden_is_what_lies_deeper_than_the_margin(margin: float) -> None:
    cloud = wall()
    shallow, deep, beside = [0, 0, 0.002 - margin], [0, 0, -0.002 - margin], [0.2, 0, -0.05]
    assert hidden(cloud, places(cloud, [shallow, deep, beside]), margin).tolist() == [False, True, False]


def test_how_far_outside_is_the_distance_from_the_nearest_side_of_the_workspace() -> None:
    box = Box(np.array([-0.05, -0.08, -0.02]), np.array([0.06, 0.07, 0.3]))
    cloud = prepared(ask(tabletop(), viewpoints=CAMERA, up=UP, workspace=box))
    positions = [[0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [-0.07, 0.05, 0.0], [0.0, 0.09, 0.2], [0.0, 0.0, 0.6]]
    expected = [-0.05, 0.04, 0.02, 0.02, -0.05]  # the last is outside above, where nothing is bounded
    np.testing.assert_allclose(outside(cloud, places(cloud, positions)), expected, atol=1e-6)


@pytest.mark.parametrize("options", [{"up": UP}, {"workspace": WORKSPACE}])
def test_without_workspace_or_up_nothing_is_outside(options: dict[str, Any]) -> None:
    cloud = prepared(ask(tabletop(), viewpoints=CAMERA, **options))
    assert outside(cloud, places(cloud, [[9.0, 9.0, 9.0]])).item() == -np.inf
