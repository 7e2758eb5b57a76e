from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from tesnet import candidates, cloud
from tesnet.candidates import Candidates
from tesnet.geometry import PANDA, Gripper, Pose
from tesnet.hands import HANDS
from tesnet.networks.told import SIZES, TOLD_INPUTS, hand_inputs, noise_of, room_between, told_inputs
from tests.tesnet.scenes import moved_cloud, prepared, tabletop, tabletop_query


@functools.cache
def example() -> tuple[cloud.PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=80)
    ready = prepared(query)
    return ready, candidates.generate(ready, query, candidates.CandidateConfig())[0]


def all_points(found: Candidates) -> torch.Tensor:
    """(C, P, 3) the example's points in every grasp frame."""
    poses = found.Ts_canonical_grasp
    return (example()[0].points - poses[:, None, :3, 3]) @ poses[:, :3, :3]


def told(found: Candidates) -> torch.Tensor:
    return told_inputs(example()[0], found, all_points(found), torch.ones(len(found), dtype=torch.bool))


def test_of_the_open_franka_hand_only_room_and_noise_are_told() -> None:
    inputs = told(example()[1])
    assert inputs.shape == (len(example()[1]), TOLD_INPUTS)
    assert (inputs[:, : len(SIZES) + 1] == 0).all()
    assert (inputs[:, len(SIZES) + 1] > 0).all()
    assert (inputs[:, len(SIZES) + 2] == 0).all()
    assert (inputs[:, -1] == 0).all()


@pytest.mark.parametrize("name", sorted(set(HANDS) - {"franka"}))
def test_inputs_of_known_hands_are_small_and_differ(name: str) -> None:
    inputs = hand_inputs(HANDS[name].gripper)
    assert max(map(abs, inputs)) < 3
    assert sum(abs(value) > 0.02 for value in inputs) >= 10
    assert (inputs[-1] > 0) == (HANDS[name].gripper.linkage_length is not None)


@pytest.mark.parametrize("size", SIZES)
def test_every_size_of_a_hand_is_told_by_itself(size: str) -> None:
    larger = PANDA.with_sizes({name: getattr(PANDA, name) for name in SIZES} | {size: 1.02 * getattr(PANDA, size)})
    changed = np.subtract(hand_inputs(larger), hand_inputs(PANDA))
    assert changed[SIZES.index(size)] == pytest.approx(0.02)
    assert np.count_nonzero(np.abs(changed) > 1e-9) == 1


@pytest.mark.parametrize("hand", [PANDA, HANDS["rg2"].gripper])
def test_room_is_what_a_loop_measures_from_either_pad(hand: Gripper) -> None:
    _, found = example()
    widths = torch.linspace(0.02, 1.0, len(found)) * hand.max_width
    room = room_between(hand, widths, all_points(found), torch.ones(len(found), dtype=torch.bool))
    narrower = 0
    for row, (pose, width) in enumerate(zip(found.Ts_canonical_grasp.double().numpy(), widths.tolist(), strict=True)):
        x, y, z = ((example()[0].points.double().numpy() - pose[:3, 3]) @ pose[:3, :3]).T
        y = y[(abs(x) < hand.finger_breadth / 2) & (abs(y) < width / 2) & (z > hand.palm_front) & (z < hand.tip_offset)]
        expected = [width / 2 - y.max(), width / 2 + y.min()] if len(y) else [width, width]
        narrower += len(y) > 0
        np.testing.assert_allclose(room[row], expected, atol=2e-3 if len(y) else 1e-6)
    assert narrower > len(found) // 2


def test_where_no_point_is_the_whole_opening_is_free() -> None:
    widths = torch.tensor([0.03, 0.08])
    nothing = torch.zeros(2, 5, 3)
    assert torch.equal(room_between(PANDA, widths, nothing, torch.tensor([False, False])), widths[:, None].expand(2, 2))


def test_tips_that_swing_advance_to_where_they_meet_something_and_others_do_not() -> None:
    _, found = example()
    hand = HANDS["rg2"].gripper
    advance = 0.02 * told(replace(found, gripper=hand, widths=torch.full((len(found),), hand.max_width)))[:, -1]
    assert (advance >= 0).all()
    assert float(advance.max()) <= hand.travel + 1e-6
    assert float(advance.max()) > 0.005


def test_noise_grows_with_the_sensors_and_stays_under_a_rigid_motion() -> None:
    levels = []
    for noise in (0.0, 0.0008, 0.002, 0.004):
        ready = prepared(tabletop_query(points=tabletop(noise=noise)))
        levels.append(float(noise_of(ready)))
        moved = moved_cloud(ready, Pose.random(np.random.default_rng(0), reach=0.5))
        assert float(noise_of(moved)) == pytest.approx(levels[-1])
    assert levels[0] < 0.05
    assert levels[1] > 0.2
    assert (np.diff(levels) > 0.1).all()


def test_tips_that_would_find_nothing_are_told_the_advance_of_the_closed_hand() -> None:
    hand = HANDS["rg2"].gripper
    ready, found = example()
    found = replace(found, gripper=hand, widths=torch.linspace(0.02, hand.max_width, len(found)))
    nowhere = torch.zeros(len(found), 1, 3)
    inputs = told_inputs(ready, found, nowhere, torch.zeros(len(found), dtype=torch.bool))
    expected = [(hand.tcp_at(0.0) - hand.tcp_at(width)) / 0.02 for width in found.widths.tolist()]
    torch.testing.assert_close(inputs[:, -1].double(), torch.tensor(expected, dtype=torch.float64), atol=1e-5, rtol=0)
