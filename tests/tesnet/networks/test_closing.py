from __future__ import annotations

import functools

import numpy as np
import torch

from tesnet import candidates
from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.networks.closing import Box, judged_in_parts, members_of, seen_from_hand
from tests.tesnet.scenes import prepared, tabletop_query

BOX = Box(breadth=0.012, length=0.05, behind=0.04, ahead=0.015)


@functools.cache
def example() -> tuple[PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=90)
    ready = prepared(query)
    return ready, candidates.generate(ready, query, candidates.CandidateConfig())[0]


def local_coordinates(ready: PreparedCloud, pose: torch.Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    T = pose.double().numpy()
    return np.asarray((ready.points.double().numpy() - T[:3, 3]) @ T[:3, :3])


def test_a_box_holds_the_points_that_a_loop_finds_there() -> None:
    ready, found = example()
    members = members_of(ready.points, found.Ts_canonical_grasp, BOX)
    assert int(members.total.sum()) == len(members.row) == len(members.point)
    low, high = BOX.low.numpy(), (BOX.low + BOX.size).numpy()
    for row, pose in enumerate(found.Ts_canonical_grasp):
        local = local_coordinates(ready, pose)
        slack = np.minimum(local - low, high - local).min(axis=1)
        certain, possible = (set(np.flatnonzero(slack > limit).tolist()) for limit in (1e-6, -1e-6))
        chosen = members.point[members.row == row].tolist()
        assert len(chosen) == len(set(chosen)) == int(members.total[row])
        assert certain <= set(chosen) <= possible


def test_a_table_begins_with_the_members_and_repeats_them() -> None:
    ready, found = example()
    away = found.Ts_canonical_grasp.clone()
    away[3, :3, 3] += 10
    members = members_of(ready.points, away, BOX)
    table = members.table(64)
    assert int(members.total[3]) == 0
    assert not table[3].any()
    assert int(members.total.max()) > 64 or int(members.total.min()) < 64
    for row in range(len(found)):
        total = int(members.total[row])
        mine = members.point[members.row == row].tolist()
        if total:
            assert table[row].tolist() == [mine[place % total] for place in range(64)]


def test_boxes_without_any_point_have_a_table() -> None:
    ready, found = example()
    away = found.Ts_canonical_grasp.clone()
    away[:, :3, 3] += 10
    assert not members_of(ready.points, away, BOX).table(8).any()


def test_points_are_seen_in_the_grasp_frame_and_mirrored_where_asked_for() -> None:
    ready, found = example()
    members = members_of(ready.points, found.Ts_canonical_grasp, BOX)
    sign = torch.where(torch.arange(len(found)) % 2 == 0, 1.0, -1.0)
    positions, normals = seen_from_hand(ready, found.Ts_canonical_grasp, sign, members.row, members.point)
    for row in range(0, len(found), 7):
        mirror = np.array([float(sign[row]), 1, 1])
        mine = members.point[members.row == row].numpy()
        rotation = found.Ts_canonical_grasp[row, :3, :3].double().numpy()
        local = local_coordinates(ready, found.Ts_canonical_grasp[row])[mine] * mirror
        np.testing.assert_allclose(positions[members.row == row], local, atol=1e-6)
        turned = ready.normals[mine].double().numpy() @ rotation * mirror
        np.testing.assert_allclose(normals[members.row == row], turned, atol=1e-5)


def test_parts_are_judged_with_their_own_signs_and_put_together_in_order() -> None:
    ready, found = example()
    sign = torch.where(torch.arange(len(found)) % 3 == 0, 1.0, -1.0)
    sizes = []

    def judge(cloud: PreparedCloud, poses: torch.Tensor, mirror: torch.Tensor) -> torch.Tensor:
        assert cloud is ready
        sizes.append(len(poses))
        return poses[:, 0, 3] * mirror

    logits = judged_in_parts(judge, ready, found.Ts_canonical_grasp, sign, 20)
    torch.testing.assert_close(logits, found.Ts_canonical_grasp[:, 0, 3] * sign)
    assert max(sizes) <= 20
    assert sum(sizes) == len(found) > 20
    unmirrored = judged_in_parts(judge, ready, found.Ts_canonical_grasp, None, 20)
    torch.testing.assert_close(unmirrored, found.Ts_canonical_grasp[:, 0, 3])
