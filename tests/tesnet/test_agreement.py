"""Candidates agree by a kernel over their poses: compared with a loop over all pairs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tesnet import agreement
from tesnet.agreement import AgreementConfig, agreed

CONFIG = AgreementConfig(distance=0.008, angle_deg=20.0, share=0.5)


def some_poses(count: int, seed: int = 0, extent: float = 0.03) -> Tensor:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.4, (count, 3))).as_matrix()
    poses[:, :3, 3] = rng.uniform(-extent, extent, (count, 3))
    return torch.from_numpy(poses).float()


def by_a_loop(logits: Tensor, poses: Tensor, config: AgreementConfig) -> list[float]:
    half_turn = np.diag([-1.0, -1.0, 1.0])
    found = []
    for i, (own, at) in enumerate(zip(logits.tolist(), poses.double().numpy(), strict=True)):
        total, weight = own, 1.0
        for j, (other, there) in enumerate(zip(logits.tolist(), poses.double().numpy(), strict=True)):
            apart = float(np.linalg.norm(at[:3, 3] - there[:3, 3])) / config.distance
            if i == j or apart > 3.0:
                continue
            turns = [
                Rotation.from_matrix(at[:3, :3].T @ there[:3, :3] @ turn).magnitude() for turn in (np.eye(3), half_turn)
            ]
            square = (2.0 - 2.0 * math.cos(min(turns))) / math.radians(config.angle_deg) ** 2
            kernel = math.exp(-(apart**2 + square) / 2.0)
            total, weight = total + kernel * min(max(other, -6.0), 6.0), weight + kernel
        found.append((1 - config.share) * own + config.share * total / weight)
    return found


@pytest.mark.parametrize("config", [CONFIG, AgreementConfig(0.015, 20.0, 1.0), AgreementConfig(0.008, 60.0, 0.2)])
def test_logits_are_those_of_a_loop_over_all_pairs(config: AgreementConfig) -> None:
    poses = some_poses(120)
    logits = torch.from_numpy(np.random.default_rng(1).normal(0.0, 5.0, 120)).float()
    np.testing.assert_allclose(agreed(logits, poses, config).numpy(), by_a_loop(logits, poses, config), atol=2e-4)


def test_one_that_is_far_from_the_others_keeps_its_logit() -> None:
    poses = some_poses(40, extent=0.01)
    poses[7, 0, 3] += 0.2
    logits = torch.linspace(-9.0, 9.0, 40)
    found = agreed(logits, poses, CONFIG)
    assert float(found[7]) == float(logits[7])
    assert int((found == logits).sum()) == 1


def test_a_hand_turned_by_half_a_turn_about_its_travel_is_the_same_one() -> None:
    poses = some_poses(30)
    turned = poses.clone()
    turned[::2, :3, :2] *= -1.0
    logits = torch.randn(30, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(agreed(logits, turned, CONFIG), agreed(logits, poses, CONFIG))


def test_of_two_equal_grasps_each_has_the_mean_and_none_decides_alone() -> None:
    poses = some_poses(1).expand(2, 4, 4)
    whole = AgreementConfig(0.008, 20.0, 1.0)
    assert agreed(torch.tensor([1.0, 3.0]), poses, whole).tolist() == pytest.approx([2.0, 2.0])
    assert agreed(torch.tensor([1.0, 3.0]), poses, CONFIG).tolist() == pytest.approx([1.5, 2.5])
    assert agreed(torch.tensor([1.0, -80.0]), poses, whole).tolist() == pytest.approx([-2.5, -39.5])


def test_the_order_of_candidates_does_not_matter() -> None:
    poses, logits = some_poses(600), torch.randn(600, generator=torch.Generator().manual_seed(4))
    order = torch.randperm(600, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(agreed(logits[order], poses[order], CONFIG), agreed(logits, poses, CONFIG)[order])


def test_of_very_many_candidates_some_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    poses, logits = some_poses(900), torch.randn(900, generator=torch.Generator().manual_seed(6))
    among_some = agreed(torch.cat([logits[::3], logits[1:2]]), torch.cat([poses[::3], poses[1:2]]), CONFIG)[-1]
    monkeypatch.setattr(agreement, "_MOST", 300)
    found = agreed(logits, poses, CONFIG)
    torch.testing.assert_close(found[::3], agreed(logits[::3], poses[::3], CONFIG))
    assert float(found[1]) == pytest.approx(float(among_some), abs=1e-5)


def test_nothing_agrees_with_nothing_and_headers_without_it_take_networks_at_their_word() -> None:
    assert agreed(torch.empty(0), torch.empty(0, 4, 4), CONFIG).shape == (0,)
    assert AgreementConfig.stored(None) is None
    assert AgreementConfig.stored({"distance": 0.01, "angle_deg": 5.0}) == AgreementConfig(0.01, 5.0, 0.5)


def test_work_is_cut_into_blocks() -> None:
    asked = []
    agreed(torch.zeros(1000), some_poses(1000), CONFIG, lambda: asked.append(1))
    assert len(asked) >= 2
