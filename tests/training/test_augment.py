from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tesnet.networks import encode
from tesnet.points import estimate_normals
from tesnet.visibility import hidden, outside
from tests.tesnet.scenes import fresh_network
from tests.training.synthetic import labelled_view
from training import augment as augmenting
from training.augment import augment, vary
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


def cut_off(seed: int) -> LabelledView:
    return augmenting._cut_off(VIEW, np.random.default_rng(seed))


def test_a_new_side_leaves_what_lies_within_it_and_the_candidates_of_that() -> None:
    shares = []
    for seed in range(12):
        view = cut_off(seed)
        cloud, found = view.cloud, view.candidates
        side = cloud.sides[-1]
        assert len(cloud.sides) == len(VIEW.cloud.sides) + 1
        assert cloud.up is not None
        assert abs(float(side[:3] @ cloud.up)) < 1e-5
        assert (cloud.points @ side[:3] <= side[3]).all()
        dropped = (VIEW.cloud.points @ side[:3] > side[3]).sum()
        assert len(cloud) + int(dropped) == len(VIEW.cloud)
        kept = VIEW.cloud.points @ side[:3] <= side[3]
        for name in ("points", "normals", "spectrum", "view_directions"):
            assert torch.equal(getattr(cloud, name), getattr(VIEW.cloud, name)[kept])
        shares.append(int(dropped) / len(VIEW.cloud))
        exact = torch.cdist(cloud.points, cloud.points, compute_mode="donot_use_mm_for_euclid_dist")
        found_distances = exact.gather(1, cloud.neighbours)
        torch.testing.assert_close(found_distances, exact.topk(16, largest=False).values, atol=1e-6, rtol=0)
        before = {tuple(pose.flatten().tolist()): row for row, pose in enumerate(VIEW.candidates.Ts_canonical_grasp)}
        rows = [before[tuple(pose.flatten().tolist())] for pose in found.Ts_canonical_grasp]
        assert torch.equal(view.outcomes, VIEW.outcomes[rows])
        assert torch.equal(cloud.points[view.approach], VIEW.cloud.points[VIEW.approach[rows]])
        assert torch.equal(cloud.points[view.contact], VIEW.cloud.points[VIEW.contact[rows]])
    assert 0.2 < max(shares) <= 0.351


def test_a_view_of_which_no_candidate_would_stay_is_left_whole() -> None:
    alone = VIEW.only(torch.tensor([0]))
    for seed in range(12):
        view = augmenting._cut_off(alone, np.random.default_rng(seed))
        assert len(view.outcomes) == 1
        if len(view.cloud) == len(VIEW.cloud):
            assert view is alone


def test_the_table_is_seen_about_the_things_and_not_behind_them() -> None:
    before = VIEW.cloud
    after = augmenting._with_table(before, np.random.default_rng(0))
    assert before.up is not None
    assert before.support_height is not None
    assert after.support_height is None
    table = after.points[len(before) :]
    assert len(table) > 500
    assert torch.equal(after.points[: len(before)], before.points)
    assert float((table @ before.up - before.support_height).std()) < 0.002
    assert hidden(before, table).float().mean() < 0.02  # noise moves a place over the edge of a shadow
    on_grid = (after.points[after.neighbours[len(before) :]] - table[:, None]).norm(dim=2)
    assert float(on_grid[:, 1].median()) < 0.006
    torch.testing.assert_close(on_grid[:, 0], torch.zeros(len(table)))
    towards = torch.nn.functional.normalize(before.viewpoints[0] - table, dim=1)
    torch.testing.assert_close(after.view_directions[len(before) :], towards, atol=1e-5, rtol=0)
    assert ((after.normals[len(before) :] * towards).sum(dim=1) > 0).all()


def test_the_tables_points_are_as_noisy_as_their_spectrum_tells() -> None:
    """Which is that of the flattest of the things' own points: nothing shows a network what was added."""
    before = VIEW.cloud
    after = augmenting._with_table(before, np.random.default_rng(0))
    table = torch.arange(len(before), len(after))
    alone = table[(after.neighbours[table] >= len(before)).all(dim=1)]
    _, fitted = estimate_normals(after.points, after.neighbours, 1.0)
    told = after.spectrum[alone]
    assert len(alone) > 300
    torch.testing.assert_close(told[:, 0], before.spectrum[:, 0].quantile(0.25).expand(len(alone)))
    assert 0.5 < float(fitted[alone, 0].median() / told[0, 0]) < 1.0  # a plane through 16 points follows some noise
    assert float(fitted[alone, 1].median()) == pytest.approx(float(told[0, 1]), rel=0.3)


def test_views_are_varied_now_and_then_and_keep_what_they_tell_of_their_candidates() -> None:
    views = [vary(VIEW, np.random.default_rng(seed)) for seed in range(60)]
    cut = sum(len(view.cloud.sides) > len(VIEW.cloud.sides) for view in views)
    with_table = sum(view.cloud.support_height is None for view in views)
    assert 0 < cut < 25
    assert 0 < with_table < 20
    assert sum(view is VIEW for view in views) > 25
    for view in views:
        assert torch.isfinite(logits(augment(view, np.random.default_rng(0)))).all()


def test_a_view_without_up_or_table_is_left_as_it_is() -> None:
    bare = replace(VIEW, cloud=replace(VIEW.cloud, up=None, support_height=None, sides=VIEW.cloud.sides[:0]))
    for seed in range(30):
        varied = vary(bare, np.random.default_rng(seed))
        assert varied.cloud is bare.cloud
        assert torch.equal(varied.outcomes, bare.outcomes)


def test_no_table_is_shown_where_its_height_is_not_known() -> None:
    hanging = replace(VIEW, cloud=replace(VIEW.cloud, support_height=None))
    for seed in range(30):
        assert len(vary(hanging, np.random.default_rng(seed)).cloud) <= len(VIEW.cloud)


def test_augmentation_repeats_for_a_seed_and_leaves_the_view_alone() -> None:
    before = VIEW.cloud.points.clone()
    assert torch.equal(turned(3).cloud.points, turned(3).cloud.points)
    assert not torch.equal(turned(3).cloud.points, turned(4).cloud.points)
    assert torch.equal(VIEW.cloud.points, before)
    assert torch.equal(turned(3).outcomes, VIEW.outcomes)
