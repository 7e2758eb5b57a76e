from __future__ import annotations

import numpy as np
import pytest
import torch

from tesnet.geometry import PANDA, Gripper
from tesnet.swept import boxes_of, inside_hand
from tests.tesnet.hand_twin import HANDS_TO_TRY, depth_in_hand

BROAD = Gripper(max_width=0.06, palm_breadth=0.12, palm_front_breadth=0.08, palm_length=0.25)


def test_all_of_the_hand_lies_in_the_boxes_of_its_parts_and_fills_them() -> None:
    x, y, z = torch.from_numpy(np.random.default_rng(0).uniform(-0.3, 0.3, (3, 400_000)))
    for hand in (PANDA, BROAD):
        inside = inside_hand(x, y, z, hand, hand.max_width, 0.05)
        found = torch.stack([x.abs(), y.abs(), z], dim=1)[inside]
        boxes = boxes_of(hand, hand.max_width, hand.max_width, 0.05)
        in_box = torch.stack(
            [((found >= torch.tensor(box[0])) & (found <= torch.tensor(box[1]))).all(1) for box in boxes]
        )
        assert bool(in_box.any(dim=0).all())
        for mask, (low, high) in zip(in_box, boxes, strict=True):
            torch.testing.assert_close(found[mask].amin(dim=0), torch.tensor(low).double(), atol=0.004, rtol=0)
            torch.testing.assert_close(found[mask].amax(dim=0), torch.tensor(high).double(), atol=0.004, rtol=0)


def test_a_way_of_no_length_is_the_hand_at_rest() -> None:
    x, y, z = torch.from_numpy(np.random.default_rng(1).uniform(-0.15, 0.15, (3, 100_000)))
    rest = inside_hand(x, y, z, PANDA, 0.08)
    behind = inside_hand(x, y, z - 0.03, PANDA, 0.08, 0.05)
    assert bool((behind | ~rest).all())  # where the hand is, 3 cm behind it is on its way
    assert int(behind.sum()) > int(rest.sum())


@pytest.mark.parametrize("depth", [0.0, 0.002, 0.004, 0.009])
@pytest.mark.parametrize("name", HANDS_TO_TRY)
def test_a_place_counts_as_deep_in_the_hand_where_the_twin_says_so(name: str, depth: float) -> None:
    """Under every face of every part, the one behind included."""
    hand = HANDS_TO_TRY[name]
    for width in (0.0, hand.max_width):
        places = np.random.default_rng(2).uniform(-0.16, 0.16, (200_000, 3))
        x, y, z = torch.from_numpy(places).unbind(dim=1)
        deep = depth_in_hand(places, hand, width)
        inside = inside_hand(x, y, z, hand, width, 0.0, depth).numpy()
        certain = np.abs(deep - depth) > 1e-9
        np.testing.assert_array_equal(inside[certain], deep[certain] > depth)


def test_half_the_width_belongs_to_each_side() -> None:
    y = torch.tensor([0.0299, 0.0301, -0.0299, -0.0301])
    assert inside_hand(torch.zeros(4), y, torch.zeros(4), PANDA, 0.06).tolist() == [False, True, False, True]
