from __future__ import annotations

import numpy as np
import torch

from tesnet.networks import encode
from tesnet.visibility import outside
from tests.tesnet.scenes import fresh_network
from tests.training.synthetic import labelled_view
from training.augment import augment
from training.views import LabelledView

VIEW = labelled_view()


def turned(seed: int) -> LabelledView:
    return augment(VIEW, np.random.default_rng(seed))


@torch.inference_mode()
def logits(view: LabelledView) -> torch.Tensor:
    network = fresh_network()
    return network.score(encode(network, view.cloud), view.cloud, view.candidates)


def test_the_cloud_is_centred_and_turned_rigidly() -> None:
    before, after = VIEW.cloud, turned(0).cloud
    torch.testing.assert_close(after.points.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    distances = [torch.cdist(cloud.points[:50], cloud.points[50:99]) for cloud in (before, after)]
    torch.testing.assert_close(*distances, atol=1e-5, rtol=0)
    assert (after.points - before.points).abs().max() > 0.01
    back = after.T_cloud_canonical.apply(after.points.numpy())
    np.testing.assert_allclose(back, before.T_cloud_canonical.apply(before.points.numpy()), atol=1e-6)


def test_a_network_of_invariants_scores_what_withholds_nothing_the_same() -> None:
    unchanged = 0
    for seed in range(8):
        view = turned(seed)
        if view.cloud.support_height is not None and len(view.cloud.sides):
            unchanged += 1
            change = (logits(view) - logits(VIEW)).abs()
            assert change.median() < 1e-4
            assert change.max() < 0.3
    assert unchanged >= 4


def test_lines_of_sight_still_lead_to_the_viewpoint_that_saw_the_point() -> None:
    for seed in range(3):
        before, after = VIEW.cloud, turned(seed).cloud
        to_viewpoint = torch.nn.functional.normalize(after.viewpoints[0] - after.points, dim=1)
        torch.testing.assert_close(after.view_directions, to_viewpoint, atol=1e-5, rtol=0)
        facing = [(cloud.normals * cloud.view_directions).sum(dim=1) for cloud in (before, after)]
        torch.testing.assert_close(*facing, atol=1e-5, rtol=0)
        assert (after.view_directions - before.view_directions).abs().max() > 0.1


def test_the_sides_turn_with_the_cloud() -> None:
    before, after = (
        outside(view.cloud, view.candidates.Ts_canonical_grasp[:, :3, 3])
        for view in (VIEW, next(view for view in map(turned, range(9)) if len(view.cloud.sides)))
    )
    torch.testing.assert_close(after, before, atol=1e-6, rtol=0)
    assert before.max() > before.min()


def test_up_support_and_sides_are_withheld_now_and_then() -> None:
    views = [turned(seed).cloud for seed in range(60)]
    without_up = sum(cloud.up is None for cloud in views)
    without_support = sum(cloud.support_height is None for cloud in views)
    without_sides = sum(len(cloud.sides) == 0 for cloud in views)
    assert 0 < without_up < without_support < 30
    assert 0 < without_up < without_sides < 30
    assert all(cloud.support_height is None and len(cloud.sides) == 0 for cloud in views if cloud.up is None)


def test_augmentation_repeats_for_a_seed_and_leaves_the_view_alone() -> None:
    before = VIEW.cloud.points.clone()
    assert torch.equal(turned(3).cloud.points, turned(3).cloud.points)
    assert not torch.equal(turned(3).cloud.points, turned(4).cloud.points)
    assert torch.equal(VIEW.cloud.points, before)
    assert torch.equal(turned(3).outcomes, VIEW.outcomes)
