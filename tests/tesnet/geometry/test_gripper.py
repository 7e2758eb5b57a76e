from __future__ import annotations

import numpy as np
import pytest

from tesnet.geometry import PANDA


@pytest.mark.parametrize("width", [0.0, 0.03, 0.08])
def test_the_corners_are_the_pandas(width: float) -> None:
    corners = PANDA.corners(width)
    z = corners[:, 2] + PANDA.hand_to_tcp
    # From the hand's base: the body from -0.026 to 0.066, fingertips at 0.112.
    np.testing.assert_allclose([z.min(), z.max()], [-0.026, 0.112], atol=5e-4)
    np.testing.assert_allclose(PANDA.palm_front + PANDA.hand_to_tcp, 0.066, atol=5e-4)
    np.testing.assert_allclose(np.ptp(corners[:, :2], axis=0), [0.063, 0.204])
    tips = corners[corners[:, 2] > 0]
    assert np.abs(tips[:, 1]).min() == pytest.approx(width / 2)  # the pads


def test_the_open_hand_is_133_mm_wide_at_the_fingers() -> None:
    for finger, side in zip(PANDA.parts, (1, -1), strict=False):
        assert finger.corners(0.08)[:, 1].max() == pytest.approx(side * (0.133 if side > 0 else 0.08) / 2, abs=5e-4)


def test_fingers_taper_towards_the_tip() -> None:
    finger = PANDA.parts[0]
    assert [section.thickness for section in finger.sections] == sorted(s.thickness for s in finger.sections)
    assert finger.sections[0].thickness == pytest.approx(PANDA.finger_tip_thickness)
    assert finger.sections[0].breadth == PANDA.finger_tip_breadth
    assert finger.sections[-1].thickness == pytest.approx(PANDA.finger_thickness)
    assert finger.front - finger.back == pytest.approx(PANDA.finger_length)


def test_half_a_turn_about_z_maps_the_hand_onto_itself() -> None:
    corners = PANDA.corners(0.05)
    turned = corners * [-1, -1, 1]
    assert {tuple(corner) for corner in corners.round(9)} == {tuple(corner) for corner in turned.round(9)}


@pytest.mark.parametrize("name", sorted(PANDA.sizes().keys() - {"hand_yaw", "linkage_offset"}))
def test_lengths_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is 0"):
        PANDA.with_sizes({name: 0.0})


def test_a_part_whose_size_is_given_is_straight_unless_its_end_is_given_too() -> None:
    assert PANDA.with_sizes({}) == PANDA
    straight = PANDA.with_sizes({"finger_thickness": 0.02, "palm_breadth": 0.05})
    assert (straight.finger_tip_thickness, straight.palm_front_breadth) == (0.02, 0.05)
    tapered = PANDA.with_sizes({"finger_thickness": 0.02, "finger_tip_thickness": 0.01})
    assert tapered.finger_tip_thickness == 0.01


def test_a_taper_is_no_longer_than_its_part() -> None:
    short = PANDA.with_sizes({"finger_depth": 0.02, "palm_depth": 0.03})
    assert short.finger_taper == pytest.approx(short.finger_length)
    assert short.palm_taper == 0.03
    assert short.corners(0.08)[:, 2].min() == pytest.approx(short.palm_front - 0.03)


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ({"max_width": -1.0}, "max_width is -1.0"),
        ({"finger_tip_thickness": 0.03}, r"finger_tip_thickness is 0\.03, more than finger_thickness"),
        ({"finger_depth": 0.012}, "finger_depth is 0.012; it must exceed 0.0126"),
    ],
)
def test_a_hand_that_cannot_be_is_refused(lengths: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PANDA.with_sizes(lengths)
