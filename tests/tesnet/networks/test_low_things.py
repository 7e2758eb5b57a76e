"""Heights along the line on which the fingers close, against a loop over cells, and as they mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Pose
from tesnet.networks.low_things import LOW, unevenness
from tests.tesnet.scenes import bare_cloud, moved_cloud, open_hands

SUPPORT = 0.1
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def tops(*slabs: tuple[float, float, float]) -> PreparedCloud:
    """Flat tops between y and y, so high over a support at `SUPPORT`, a point every 2 mm."""
    points = [
        (x, y, SUPPORT + height)
        for begin, end, height in slabs
        for x in np.arange(-0.01, 0.0101, 0.002)
        for y in np.arange(begin + 0.001, end, 0.002)
    ]
    up = torch.tensor([0.0, 0.0, 1.0])
    return bare_cloud(np.array(points), np.array([[0.0, 0.0, 1.0]]), up=up, support_height=SUPPORT)


def above(width: float = 0.08, tilt_deg: float = 0.0) -> Candidates:
    """A hand over the middle, closing along y, opened so wide."""
    turn = np.deg2rad(tilt_deg)
    tilted = Pose(np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]), np.zeros(3))
    pose = torch.tensor(tilted.matrix).float() @ DOWN
    pose[:3, 3] = torch.tensor([0.0, 0.0, SUPPORT + 0.011])
    return replace(open_hands(pose[None]), widths=torch.tensor([width]))


def of(cloud: PreparedCloud, candidates: Candidates) -> float:
    every = torch.arange(len(cloud))[None].expand(len(candidates), -1)
    return float(unevenness(cloud, candidates, every)[0])


ONE, HIGHER = (-0.02, 0.0, 0.005), (0.0, 0.02, 0.009)


def test_one_flat_thing_is_even_and_so_is_what_deviates_by_a_millimetre() -> None:
    assert of(tops((-0.03, 0.02, 0.006)), above()) == 0
    assert of(tops((-0.02, 0.0, 0.006), (0.0, 0.02, 0.007)), above()) == 0


def test_two_of_other_heights_are_uneven_by_the_share_of_the_lower() -> None:
    assert of(tops(ONE, HIGHER), above()) == pytest.approx(0.5)
    assert of(tops((-0.032, 0.0, 0.005), (0.0, 0.008, 0.009)), above()) == pytest.approx(0.8)


def test_a_gap_between_two_of_one_height_counts_by_its_width() -> None:
    assert of(tops((-0.02, -0.008, 0.006), (0.008, 0.02, 0.006)), above()) == pytest.approx(4 / 8)


def test_what_the_hand_does_not_close_on_does_not_count() -> None:
    both = tops(ONE, (0.02, 0.032, 0.009))
    assert of(both, above()) > 0
    assert of(both, above(width=0.04)) == 0
    assert of(tops((0.05, 0.07, 0.009), (0.07, 0.09, 0.005)), above()) == 0


@pytest.mark.parametrize("height", [LOW - 0.001, LOW + 0.001])
def test_only_low_things_are_looked_at(height: float) -> None:
    low_first = tops(ONE, (0.0, 0.02, height))
    assert (of(low_first, above()) > 0) == (height < LOW)
    high_first = tops((0.0, 0.02, height), ONE)  # the approach point is the first
    assert (of(high_first, above()) > 0) == (height < LOW)


def test_hands_that_do_not_come_from_above_are_left_alone() -> None:
    assert of(tops(ONE, HIGHER), above(tilt_deg=20)) > 0
    assert of(tops(ONE, HIGHER), above(tilt_deg=30)) == 0


def test_without_up_or_support_nothing_is_known() -> None:
    assert of(replace(tops(ONE, HIGHER), support_height=None), above()) == 0
    assert of(replace(tops(ONE, HIGHER), up=None, support_height=None), above()) == 0


def test_it_is_what_a_loop_over_cells_finds_wherever_the_hands_are() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-0.03, 0.03, 300), rng.uniform(-0.06, 0.06, 300), rng.uniform(0, 0.012, 300)], 1)
    up = torch.tensor([0.0, 0.0, 1.0])
    cloud = bare_cloud(points, up=up, support_height=-0.001)
    turns = torch.eye(4).repeat(40, 1, 1)
    angle = torch.from_numpy(rng.uniform(0, 2 * np.pi, 40)).float()
    turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    poses = turns @ DOWN
    poses[:, :2, 3] = torch.from_numpy(rng.uniform(-0.02, 0.02, (40, 2))).float()
    widths = torch.from_numpy(rng.choice([0.02, 0.05, 0.08], 40)).float()
    index = torch.from_numpy(rng.integers(0, 300, (40, 30)))
    found = unevenness(cloud, replace(open_hands(poses), widths=widths), index)
    for row in range(40):
        cells: dict[int, float] = {}
        for point in cloud.points[index[row]]:
            y = float((point - poses[row, :3, 3]) @ poses[row, :3, 1])
            if abs(y) < float(widths[row]) / 2:
                cell = int((y + float(widths[row]) / 2) // 0.004)
                cells[cell] = max(cells.get(cell, 0.0), float(point[2]) + 0.001)
        lower = sum(height < max(cells.values()) - 0.002 for height in cells.values()) / max(len(cells), 1)
        empty = max(cells) - min(cells) + 1 - len(cells) if cells else 0
        assert float(found[row]) == pytest.approx(lower + empty / 8, abs=1e-6), row


def test_it_stays_where_everything_is_moved_alike() -> None:
    cloud, hands = tops(ONE, HIGHER), above()
    motion = Pose.from_quaternion([0.1, -0.5, 0.3, 0.8], [0.3, -0.2, 0.5])
    pose = (torch.tensor(motion.matrix) @ hands.Ts_canonical_grasp[0].double()).float()[None]
    assert of(moved_cloud(cloud, motion), replace(hands, Ts_canonical_grasp=pose)) == pytest.approx(0.5)
