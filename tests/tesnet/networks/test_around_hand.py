from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from tesnet import candidates
from tesnet.candidates import Candidates
from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from tesnet.networks.around_hand import PROBES, Places, ends, probes, region_about
from tesnet.swept import inside_hand
from tests.tesnet.scenes import prepared, tabletop_query


@pytest.fixture(params=HANDS)
def hand(request: pytest.FixtureRequest) -> Gripper:
    return HANDS[request.param].gripper


@functools.cache
def found() -> Candidates:
    query = tabletop_query(max_candidates=12)
    return candidates.generate(prepared(query), query, candidates.CandidateConfig())[0]


def opened(hand: Gripper, widths: torch.Tensor) -> Candidates:
    return replace(found().select(torch.arange(len(widths))), widths=widths, gripper=hand)


def some_widths(hand: Gripper) -> torch.Tensor:
    return torch.linspace(0.005, 1.0, 9) * hand.max_width


@pytest.mark.parametrize("make", [ends, probes])
def test_places_follow_each_width_as_they_would_for_a_hand_that_opens_no_farther(
    make: Callable[[Gripper], Places], hand: Gripper
) -> None:
    widths = some_widths(hand)
    together = make(hand).of(opened(hand, widths))
    for width, places in zip(widths.tolist(), together, strict=True):
        torch.testing.assert_close(places, make(replace(hand, max_width=width)).open, atol=1e-8, rtol=1e-5)


@pytest.mark.parametrize("make", [ends, probes])
def test_places_of_an_open_hand_are_there_to_the_bit(make: Callable[[Gripper], Places], hand: Gripper) -> None:
    places = make(hand)
    assert torch.equal(places.of(opened(hand, torch.full((2,), hand.max_width)))[1], places.open)


def test_there_are_as_many_probes_as_said_on_both_sides_alike(hand: Gripper) -> None:
    places = probes(hand).open
    assert places.shape == (PROBES, 3)
    for flip in ([-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]):
        assert torch.cdist(places * torch.tensor(flip), places).amin(dim=1).max() < 1e-4


def in_hand(places: torch.Tensor, hand: Gripper, width: float) -> torch.Tensor:
    x, y, z = places.unbind(dim=1)
    return inside_hand(x, y, z, hand, width)


def test_probes_lie_in_fingers_and_palm_however_far_the_hand_is_open(hand: Gripper) -> None:
    inner = [row for row in range(60) if row % 3 == 0 and row % 15 not in (0, 12)]  # neither at the tip nor the root
    for width, places in zip(some_widths(hand).tolist(), probes(hand).of(opened(hand, some_widths(hand))), strict=True):
        assert in_hand(places[inner], hand, width).all()
        assert in_hand(places[-10:] * torch.tensor([0.5, 1.0, 1.0]), hand, width).all()
        assert not in_hand(places[60:90], hand, width).any()


def test_a_region_reaches_as_far_past_each_part_as_the_frankas(hand: Gripper) -> None:
    breadth, length, behind, ahead = region_about((0.012, 0.045, 0.042, 0.013), opened(hand, some_widths(hand)))
    torch.testing.assert_close(length - some_widths(hand) / 2, torch.full((9,), 0.005), atol=1e-7, rtol=0)
    assert breadth - hand.finger_breadth / 2 == pytest.approx(0.012 - PANDA.finger_breadth / 2)
    assert hand.palm_front + behind == pytest.approx(PANDA.palm_front + 0.042)
    assert ahead - hand.tip_offset == pytest.approx(0.013 - PANDA.tip_offset)
