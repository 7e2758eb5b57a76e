from __future__ import annotations

import numpy as np
import torch

from tesnet.geometry import PANDA, Gripper
from tesnet.swept import inside_hand, reach_of

BROAD = Gripper(max_width=0.06, palm_breadth=0.12, palm_front_breadth=0.08, palm_length=0.25)


def test_nothing_of_the_hand_lies_outside_its_reach() -> None:
    x, y, z = places = torch.from_numpy(np.random.default_rng(0).uniform(-0.3, 0.3, (3, 200_000)))
    for hand in (PANDA, BROAD):
        low, high = reach_of(hand, hand.max_width, 0.05)
        inside = inside_hand(x, y, z, hand, hand.max_width, 0.05)
        assert inside.any()
        within = ((torch.tensor(low) <= places.T) & (torch.tensor(high) >= places.T)).all(dim=1)
        assert bool(within[inside].all())


def test_a_way_of_no_length_is_the_hand_at_rest() -> None:
    x, y, z = torch.from_numpy(np.random.default_rng(1).uniform(-0.15, 0.15, (3, 100_000)))
    rest = inside_hand(x, y, z, PANDA, 0.08)
    behind = inside_hand(x, y, z - 0.03, PANDA, 0.08, 0.05)
    assert bool((behind | ~rest).all())  # where the hand is, 3 cm behind it is on its way
    assert int(behind.sum()) > int(rest.sum())


def test_half_the_width_belongs_to_each_side() -> None:
    y = torch.tensor([0.0299, 0.0301, -0.0299, -0.0301])
    assert inside_hand(torch.zeros(4), y, torch.zeros(4), PANDA, 0.06).tolist() == [False, True, False, True]
