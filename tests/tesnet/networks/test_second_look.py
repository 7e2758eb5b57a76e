"""What fingers will touch, against a loop over cells; and that it does not matter how one looks at a hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tesnet.candidates import CandidateConfig, Candidates, at_rest, generate
from tesnet.cloud import PreparedCloud
from tesnet.hands import HANDS
from tesnet.networks.second_look import AHEAD, CELL, COLUMNS, INPUTS, ROWS, SecondLook, seen_by_fingers, ways_to_look
from tests.tesnet.scenes import prepared, tabletop_query

PICTURE = ROWS * COLUMNS * 5


def example(name: str = "franka") -> tuple[PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=40, gripper=HANDS[name].gripper)
    cloud = prepared(query)
    return cloud, at_rest(cloud, generate(cloud, query, CandidateConfig())[0])


@pytest.mark.parametrize("name", ["franka", "rg2", "robotiq_2f140"])
def test_each_cell_of_a_pad_shows_the_outermost_point_before_it(name: str) -> None:
    cloud, found = example(name)
    hand, seen = found.gripper, seen_by_fingers(cloud, found).numpy()
    assert seen.shape == (len(found), INPUTS)
    points, normals = cloud.points.double().numpy(), cloud.normals.double().numpy()
    compared = 0
    for row in range(0, len(found), 5):
        T = found.Ts_canonical_grasp[row].double().numpy()
        local, facing = (points - T[:3, 3]) @ T[:3, :3], normals @ T[:3, :3]
        near = np.abs(local[:, 1]) < 0.6 * hand.max_width
        cell = np.column_stack([local[:, 0] / CELL + ROWS / 2, (hand.tip_offset + AHEAD - local[:, 2]) / CELL])
        on_edge = (np.abs(cell - cell.round()) < 1e-3).any(axis=1)
        for side, picture in ((1, seen[row, :PICTURE]), (-1, seen[row, PICTURE : 2 * PICTURE])):
            for i, j in np.ndindex(ROWS, COLUMNS):
                mine = near & (np.abs(cell - (i + 0.5, j + 0.5)) < 0.501).all(axis=1)
                told = picture.reshape(ROWS, COLUMNS, 5)[i, j]
                if not mine.any():
                    assert (told == 0).all()
                if not mine.any() or on_edge[mine].any():
                    continue
                outward = np.where(mine, side * local[:, 1], -np.inf)
                first = outward >= outward.max() - 0.003
                normal = (facing[first] * (1, side, 1)).mean(axis=0)
                np.testing.assert_allclose(told, [1, outward.max() / 0.04, *normal], atol=1e-3)
                compared += 1
    assert compared > 20


def test_what_is_told_about_the_hand_is_where_things_lie_as_the_hand_sees_them() -> None:
    cloud, found = example()
    about = seen_by_fingers(cloud, found).double().numpy()[:, 2 * PICTURE :]
    poses, hand = found.Ts_canonical_grasp.double().numpy(), found.gripper
    for row, T in enumerate(poses):
        local = (cloud.points.double().numpy() - T[:3, 3]) @ T[:3, :3]
        for number, radius in enumerate((0.03, 0.05, 0.08, 0.12)):
            within = np.linalg.norm(local, axis=1) < radius
            expected = local[within].mean(axis=0) / radius if within.any() else np.zeros(3)
            np.testing.assert_allclose(about[row, 4 * number : 4 * number + 3], expected, atol=2e-2)
            assert about[row, 4 * number + 3] == pytest.approx(within.sum() / 300, abs=0.01)
    assert cloud.up is not None
    assert cloud.support_height is not None
    up = cloud.up.double().numpy()
    np.testing.assert_allclose(about[:, 16:19], up @ poses[:, :3, :3], atol=1e-5)
    np.testing.assert_allclose(about[:, 19], (poses[:, :3, 3] @ up - cloud.support_height) / 0.1, atol=1e-4)
    np.testing.assert_allclose(about[:, 23], found.widths.numpy() / 0.08, atol=1e-6)
    sizes = [hand.finger_breadth / 0.02, (hand.tip_offset - hand.palm_front) / 0.05, 1.0, hand.travel / 0.02]
    np.testing.assert_allclose(about[:, 24:], np.tile(sizes, (len(found), 1)), atol=1e-5)
    unknown = seen_by_fingers(replace(cloud, up=None, support_height=None), found)[:, 2 * PICTURE :]
    assert (unknown[:, 16:20] == 0).all()


def assert_nearly_all_close(found: torch.Tensor, wanted: torch.Tensor) -> None:
    """But for points on the edge of a cell, which rounding puts on either side."""
    assert ((found - wanted).abs() < 1e-3).float().mean() > 0.998


def test_a_turned_hand_and_a_reflected_scene_are_seen_as_the_ways_to_look_say() -> None:
    cloud, found = example()
    seen = seen_by_fingers(cloud, found)
    order, signs = ways_to_look()
    poses = found.Ts_canonical_grasp.clone()
    poses[:, :3, :2] *= -1
    turned = seen_by_fingers(cloud, replace(found, Ts_canonical_grasp=poses))
    assert_nearly_all_close(turned, seen[:, order[2]] * signs[2])
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))  # the scene and the hand in a mirror: x of the hand turns round
    poses = found.Ts_canonical_grasp.clone()
    poses[:, :3, :3], poses[:, :3, 3] = flip @ poses[:, :3, :3] @ flip, poses[:, :3, 3] @ flip
    assert cloud.up is not None
    mirrored = replace(
        cloud, points=cloud.points @ flip, normals=cloud.normals @ flip, up=cloud.up @ flip,
        view_directions=cloud.view_directions @ flip,
    )  # fmt: skip
    reflected = seen_by_fingers(mirrored, replace(found, Ts_canonical_grasp=poses))
    assert_nearly_all_close(reflected, seen[:, order[1]] * signs[1])
    both = (seen[:, order[1]] * signs[1])[:, order[2]] * signs[2]
    torch.testing.assert_close(seen[:, order[3]] * signs[3], both)


def test_a_second_look_changes_nothing_at_first_and_does_not_depend_on_the_way_to_look() -> None:
    torch.manual_seed(0)
    look = SecondLook().eval()
    seen, logits = torch.randn(6, INPUTS), torch.randn(6)
    torch.testing.assert_close(look(seen, logits), logits)
    torch.nn.init.normal_(look.change.weight)
    with torch.inference_mode():
        found = look(seen, logits)
        assert (found - logits).abs().min() > 1e-3
        for order, signs in zip(*ways_to_look(), strict=True):
            torch.testing.assert_close(look(seen[:, order] * signs, logits), found)


def test_a_large_cloud_is_looked_at_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, found = example()
    whole = seen_by_fingers(cloud, found)
    monkeypatch.setattr("tesnet.networks.second_look._AT_ONCE", 3 * len(cloud))
    assert_nearly_all_close(seen_by_fingers(cloud, found), whole)
