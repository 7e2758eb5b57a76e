from __future__ import annotations

import numpy as np
import pytest

from tesnet.hands import HANDS
from training.hands import alike, drawn_hand, random_hand


def test_openings_spread_over_those_of_real_hands() -> None:
    widths = np.array([random_hand(np.random.default_rng(seed)).gripper.max_width for seed in range(300)])
    assert widths.min() >= 0.03
    assert widths.max() <= 0.16
    counts, _ = np.histogram(widths, bins=5, range=(0.03, 0.16))
    assert counts.min() > 30


def test_some_hands_slide_and_some_swing() -> None:
    swinging = [random_hand(np.random.default_rng(seed)).gripper.travel > 0 for seed in range(300)]
    assert 0.3 < np.mean(swinging) < 0.8


def test_sizes_stay_among_those_of_real_hands() -> None:
    hands = [random_hand(np.random.default_rng(seed)).gripper for seed in range(300)]
    known = [known.gripper for known in HANDS.values()]
    for name in ("finger_depth", "finger_thickness", "finger_breadth", "tip_offset", "palm_depth", "palm_breadth"):
        real = [getattr(hand, name) for hand in known]
        made = [getattr(hand, name) for hand in hands]
        assert np.quantile(made, 0.05) <= min(real) * 1.35
        assert np.quantile(made, 0.95) >= max(real) * 0.75
        assert min(made) > 0.4 * min(real)
        assert max(made) < 1.6 * max(real)


@pytest.mark.parametrize("name", [name for name in HANDS if name != "franka"])
def test_hands_that_are_measured_are_not_met(name: str) -> None:
    assert alike(HANDS[name].gripper, HANDS[name].gripper)
    assert not any(alike(random_hand(np.random.default_rng(seed)).gripper, HANDS[name].gripper) for seed in range(300))


def test_known_hands_come_by_their_names_and_draw_nothing() -> None:
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    assert drawn_hand("rg2", rng) is HANDS["rg2"]
    assert rng.bit_generator.state == before
    assert drawn_hand("random", rng) != drawn_hand("random", rng)


def test_sizes_of_a_drawn_hand_go_together() -> None:
    """A body is 20 to 125 mm longer than the opening; of hands that open 60 mm and more, 0.7 swing."""
    hands = [random_hand(np.random.default_rng(seed)).gripper for seed in range(400)]
    for hand in hands:
        assert 0.02 - 1e-9 <= hand.palm_length - hand.max_width <= 0.125 + 1e-9
        assert hand.hand_to_tcp == pytest.approx(hand.palm_depth + hand.finger_depth - hand.tip_offset)
        assert 0.15 - 1e-9 <= hand.tip_offset / hand.finger_depth <= 0.45 + 1e-9
        assert hand.finger_tip_thickness <= max(0.005, hand.finger_thickness)
        assert 0.5 - 1e-9 <= hand.finger_tip_breadth / hand.finger_breadth <= 1 + 1e-9
        assert hand.finger_taper < hand.finger_depth
        assert 0.4 - 1e-9 <= hand.palm_front_breadth / hand.palm_breadth <= 1 + 1e-9
        assert hand.palm_taper <= 0.7 * hand.palm_depth + 1e-9
        if hand.linkage_length is not None:
            assert 0.53 - 1e-9 <= hand.linkage_length / hand.max_width <= 0.78 + 1e-9
            assert -0.001 <= hand.linkage_offset <= 0.009
    wide = [hand for hand in hands if hand.max_width >= 0.06]
    assert all(hand.linkage_length is None for hand in hands if hand.max_width < 0.06)
    assert 0.63 < np.mean([hand.linkage_length is not None for hand in wide]) < 0.77
