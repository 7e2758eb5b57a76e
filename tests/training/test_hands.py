from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tesnet.geometry import PANDA, Gripper
from tesnet.hands import HANDS
from training import hands as training_hands
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


@pytest.mark.parametrize("name", HANDS)
def test_of_the_known_hands_only_franka_would_be_kept_if_it_were_drawn(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = random_hand(np.random.default_rng(3)).gripper
    coming = [HANDS[name].gripper, other]
    monkeypatch.setattr(training_hands, "_draw", lambda rng: coming.pop(0))
    assert random_hand(np.random.default_rng(0)).gripper == (HANDS["franka"].gripper if name == "franka" else other)


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


RANGES: dict[str, tuple[float, float, Callable[[Gripper], float]]] = {
    "opening": (0.03, 0.16, lambda hand: hand.max_width),
    "taper of the fingers": (0.3, 0.95, lambda hand: hand.finger_taper / hand.finger_length),
    "tips before the TCP": (0.15, 0.45, lambda hand: hand.tip_offset / hand.finger_depth),
    "tips' breadth": (0.5, 1.0, lambda hand: hand.finger_tip_breadth / hand.finger_breadth),
    "body's depth": (0.09, 0.22, lambda hand: hand.palm_depth),
    "body beside the opening": (0.02, 0.125, lambda hand: hand.palm_length - hand.max_width),
    "body's breadth": (0.045, 0.085, lambda hand: hand.palm_breadth),
    "body's breadth at its front": (0.4, 1.0, lambda hand: hand.palm_front_breadth / hand.palm_breadth),
    "taper of the body": (0.1, 0.7, lambda hand: hand.palm_taper / hand.palm_depth),
}


@pytest.mark.parametrize("name", RANGES)
def test_what_is_drawn_evenly_fills_its_range_and_leaves_it_nowhere(name: str) -> None:
    least, most, size = RANGES[name]
    shares = [(size(hand) - least) / (most - least) for hand in hands_of(400)]
    assert -1e-9 <= min(shares) < 0.03
    assert 0.97 < max(shares) <= 1 + 1e-9
    assert np.mean(shares) == pytest.approx(0.5, abs=0.07)


def test_cranks_fill_their_ranges() -> None:
    swinging = [hand for hand in hands_of(400) if hand.linkage_length is not None]
    lengths = [(hand.linkage_length or 0.0) / hand.max_width for hand in swinging]
    offsets = [hand.linkage_offset for hand in swinging]
    assert 0.53 - 1e-9 <= min(lengths) < 0.54
    assert 0.77 < max(lengths) <= 0.78 + 1e-9
    assert -0.001 <= min(offsets) < -0.0007
    assert 0.0087 < max(offsets) <= 0.009
    assert all(hand.linkage_offset == 0 for hand in hands_of(400) if hand.linkage_length is None)


CLIPPED: dict[str, tuple[float, float, Callable[[float], float], float]] = {
    "finger_depth": (0.030, 0.085, lambda width: 0.030 + 0.21 * width, 0.2),
    "finger_thickness": (0.008, 0.040, lambda width: 0.010 + 0.13 * width, 0.3),
    "finger_breadth": (0.012, 0.036, lambda width: 0.022, 0.22),
}
"""Of sizes that scatter about what the opening lets expect: the least, the most, what is expected, and by how much."""


@pytest.mark.parametrize("name", CLIPPED)
def test_what_scatters_does_so_about_its_middle_and_is_cut_at_both_ends(name: str) -> None:
    least, most, expected, spread = CLIPPED[name]
    hands = hands_of(400)
    sizes = np.array([getattr(hand, name) for hand in hands])
    assert (sizes.min(), sizes.max()) == (least, most)
    logs = np.log(sizes / [expected(hand.max_width) for hand in hands])
    assert np.median(logs) == pytest.approx(0.0, abs=0.05)
    inside = logs[(sizes > least) & (sizes < most)]
    assert 0.7 * spread < np.quantile(np.abs(inside), 0.68) < 1.15 * spread


def test_tips_are_thinner_than_fingers_but_not_under_5_mm() -> None:
    hands = hands_of(400)
    shares = [hand.finger_tip_thickness / hand.finger_thickness for hand in hands if hand.finger_tip_thickness > 0.005]
    assert 0.2 - 1e-9 <= min(shares) < 0.35
    assert 0.87 < max(shares) <= 0.9 + 1e-9
    assert min(hand.finger_tip_thickness for hand in hands) == 0.005


@pytest.mark.parametrize("name", ["max_width", "finger_depth", "finger_thickness", "finger_breadth"])
@pytest.mark.parametrize(("factor", "same"), [(1.149, True), (1 / 1.149, True), (1.151, False), (1 / 1.151, False)])
def test_hands_are_alike_that_differ_by_less_than_15_percent_in_every_size(
    name: str, factor: float, same: bool
) -> None:
    """Smaller or larger; that of no other size counts."""
    sizes = dict.fromkeys(("max_width", "finger_depth", "finger_thickness", "finger_breadth"), 0.05)
    one = PANDA.with_sizes(sizes)
    other = PANDA.with_sizes({**sizes, name: factor * 0.05, "palm_depth": 0.2, "hand_to_tcp": 0.3})
    assert alike(one, other) == alike(other, one) == same


@cache
def hands_of(count: int) -> list[Gripper]:
    """Random hands of so many seeds."""
    return [random_hand(np.random.default_rng(seed)).gripper for seed in range(count)]
