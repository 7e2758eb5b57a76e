"""Rims: what fingers meet first, as it is meant, and against a loop over candidates, fingers and points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.hands import HANDS
from tesnet.networks.rims import poor_pinch
from tests.tesnet.scenes import bare_cloud, open_hands

HAND = HANDS["rg2"].gripper
WIDTH = 0.06


def face(
    side: int, at: float, lean_deg: float, from_tip: tuple[float, float] = (0.0, 0.02)
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a plane that faces the finger at the side `side` of y, in the grasp frame.

    Args:
        side: of y, +1 or -1.
        at: |y| where the fingertip's end is.
        lean_deg: how far it leans towards the palm.
        from_tip: how far behind the end of the tip it begins and ends.
    """
    behind = np.arange(*from_tip, 0.001)
    x = np.arange(-0.006, 0.0061, 0.002)
    lean = np.deg2rad(lean_deg)
    points = [(across, side * (at - back * np.tan(lean)), HAND.tip_offset - back) for back in behind for across in x]
    normal = (0.0, side * np.cos(lean), -np.sin(lean))
    return np.array(points), np.tile(normal, (len(points), 1))


def seen(*faces: tuple[np.ndarray, np.ndarray]) -> PreparedCloud:
    points, normals = (np.concatenate(parts) for parts in zip(*faces, strict=True))
    return bare_cloud(points, normals=torch.from_numpy(normals).float())


def hands(poses: torch.Tensor | None = None) -> Candidates:
    poses = torch.eye(4)[None] if poses is None else poses
    return replace(open_hands(poses), widths=torch.full((len(poses),), WIDTH), gripper=HAND)


def of(cloud: PreparedCloud) -> float:
    return float(poor_pinch(cloud, hands(), torch.arange(len(cloud))[None])[0])


@pytest.mark.parametrize("side", [1, -1])
def test_a_slope_that_the_tip_meets_counts_and_a_wall_does_not(side: int) -> None:
    wall = face(-side, 0.02, 0)
    assert of(seen(wall, face(side, 0.01, 0))) == 0
    assert of(seen(wall, face(side, 0.02, 40))) == 1
    steeper, flatter = (of(seen(wall, face(side, 0.02, lean))) for lean in (15, 20))
    assert 0 < steeper < flatter < 1


def test_a_slope_that_the_middle_of_the_pad_meets_does_not_count() -> None:
    wall = face(-1, 0.02, 0)
    amounts = [of(seen(wall, face(1, 0.02, 40, (back, 0.02)))) for back in (0.0, 0.003, 0.006)]
    assert amounts[0] == 1
    assert 0 < amounts[1] < 1
    assert amounts[2] == 0


def test_only_what_a_finger_meets_first_counts() -> None:
    wall = face(-1, 0.02, 0)
    assert of(seen(wall, face(1, 0.015, 40), face(1, 0.025, 0))) == 0
    assert of(seen(wall, face(1, 0.025, 40), face(1, 0.015, 0))) == 1


def test_what_is_seen_from_behind_is_no_slope() -> None:
    wall, (points, normals) = face(-1, 0.02, 0), face(1, 0.02, 40)
    assert of(seen(wall, (points, normals * [1, -1, 1]))) == 0
    assert of(seen(wall, (points, normals * [1, 1, -1]))) == 0


@pytest.mark.parametrize("side", [1, -1])
def test_a_thin_wall_counts_of_which_one_face_was_seen(side: int) -> None:
    near, far = face(side, 0.008, 0), face(-side, 0.004, 0)
    points, normals = far
    back = points, normals * [1, -1, 1]  # what the camera saw of the far side is the inside of the near one
    assert of(seen(near, far)) == 0
    assert of(seen(near, back)) == 1
    assert of(seen(near)) == 1
    thicker = [of(seen(face(side, at, 0), back)) for at in (0.012, 0.017, 0.023)]
    assert thicker[0] == 1
    assert 0 < thicker[1] < 1
    assert thicker[2] == 0


def test_where_nothing_lies_between_the_fingers_nothing_is_met() -> None:
    points, normals = face(1, 0.02, 40)
    for aside in ([0.02, 0, 0], [0, 0.03, 0], [0, 0, 0.05], [0, 0, -0.3]):
        assert of(seen((points + aside, normals))) == 0


@pytest.mark.parametrize(
    ("name", "swings"), [("rg2", True), ("rg6", True), ("robotiq_2f140", False), ("franka", False)]
)
def test_it_concerns_hands_alone_whose_tips_swing_far(name: str, swings: bool) -> None:
    hand = HANDS[name].gripper
    points, normals = (np.concatenate(parts) for parts in zip(face(1, 0.02, 40), face(-1, 0.02, 0), strict=True))
    points[:, 2] += hand.tip_offset - HAND.tip_offset
    cloud = seen((points, normals))
    candidates = replace(hands(), gripper=hand)
    assert float(poor_pinch(cloud, candidates, torch.arange(len(cloud))[None])[0]) == swings


def test_it_is_what_a_loop_finds_wherever_the_hands_are() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.02, -0.04, -0.01], [0.02, 0.04, 0.02], (400, 3))
    normals = np.sign(points) * [0, 1, 0] + rng.normal(scale=0.3, size=(400, 3)) + [0, 0, -0.5]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = bare_cloud(points, normals=torch.from_numpy(normals).float())
    poses = torch.eye(4).repeat(60, 1, 1)
    angle = torch.from_numpy(rng.normal(scale=0.3, size=60)).float()
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    poses[:, :3, 3] = torch.from_numpy(rng.uniform(-0.01, 0.01, (60, 3))).float()
    index = torch.from_numpy(rng.integers(0, 400, (60, 12)))
    found = poor_pinch(cloud, hands(poses), index)
    assert (found > 0).sum() > 10
    thin = 0
    for row in range(60):
        expected, firsts, towards = 0.0, [], []
        for side in (1, -1):
            met: list[tuple[float, float, float, float]] = []
            for point in index[row].tolist():
                x, y, z = ((cloud.points[point] - poses[row, :3, 3]) @ poses[row, :3, :3]).tolist()
                _, n_y, n_z = (cloud.normals[point] @ poses[row, :3, :3]).tolist()
                if (
                    abs(x) < HAND.finger_tip_breadth / 2 + 0.001
                    and abs(y) < WIDTH / 2
                    and HAND.palm_front < z < HAND.tip_offset + 0.001
                ):
                    met.append((side * y, HAND.tip_offset - z, -n_z, side * n_y))
            if met:
                firsts.append(max(outward for outward, *_ in met))
                near = np.array([rest for outward, *rest in met if outward >= firsts[-1] - 0.003])
                behind, leaning, facing = near.mean(axis=0)
                amount = np.clip((0.006 - behind) / 0.004, 0, 1) * np.clip((leaning - 0.15) / 0.25, 0, 1)
                expected = max(expected, float(amount * (facing > 0.3)))
                towards.append(facing)
        if firsts:
            wall = np.clip((0.026 - sum(firsts)) / 0.008, 0, 1) * np.clip((-min(towards) - 0.4) / 0.4, 0, 1)
            thin += wall > expected
            expected = max(expected, float(wall))
        assert float(found[row]) == pytest.approx(expected, abs=1e-4)
    assert thin > 2
