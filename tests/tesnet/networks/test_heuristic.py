from __future__ import annotations

import numpy as np
import pytest
import torch

from tesnet.cloud import PreparedCloud
from tesnet.networks.heuristic import Heuristic, HeuristicConfig, antipodal_quality, verticality
from tests.tesnet.scenes import bare_cloud, open_hands

DOWN = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""A hand that comes straight down and closes along y."""


def walls(*angles_deg: float) -> PreparedCloud:
    """Two walls at y = +-2 cm, whose outward normals deviate from the closing direction by these angles."""
    x, z = np.meshgrid(np.linspace(-0.008, 0.008, 5), np.linspace(-0.005, 0.03, 12))
    sides, normals = [], []
    for side, angle in zip((-1, 1), np.radians(angles_deg), strict=True):
        sides.append(np.stack([x.ravel(), np.full(x.size, side * 0.02), z.ravel()], axis=1))
        normals.append(np.tile([0, side * np.cos(angle), np.sin(angle)], (x.size, 1)))
    up = torch.tensor([0.0, 0.0, 1.0])
    return bare_cloud(np.concatenate(sides), normals=torch.tensor(np.concatenate(normals)).float(), up=up)


@pytest.mark.parametrize(("angles", "quality"), [((0, 0), 1.0), ((60, 60), 0.5), ((0, 90), 0.5), ((180, 180), 0.0)])
def test_walls_that_face_the_pads_squarely_are_best(angles: tuple[float, float], quality: float) -> None:
    assert float(antipodal_quality(walls(*angles), DOWN[None], 0.004)) == pytest.approx(quality, abs=1e-5)


def test_where_nothing_lies_between_the_fingers_there_is_nothing_to_hold() -> None:
    away = DOWN.clone()
    away[:3, 3] = 1.0
    assert float(antipodal_quality(walls(0, 0), away[None], 0.004)) == 0


def test_a_hand_from_above_scores_best_and_half_a_turn_about_its_travel_changes_nothing() -> None:
    cloud = walls(20, 20)
    tilt = torch.eye(4)
    tilt[:3, :3] = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    found = open_hands(torch.stack([DOWN, DOWN @ tilt, DOWN @ turn]))
    assert verticality(cloud, found).tolist() == pytest.approx([1.0, 0.9, 1.0])
    logits = Heuristic(HeuristicConfig()).score(None, cloud, found)
    assert float(logits[0]) > float(logits[1])
    assert float(logits[0]) == pytest.approx(float(logits[2]))
