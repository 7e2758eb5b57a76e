from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tesnet.geometry import HAND_TO_TCP, PANDA, Gripper


@pytest.mark.parametrize("width", [0.0, 0.03, 0.08])
def test_the_corners_are_the_pandas(width: float) -> None:
    corners = PANDA.corners(width)
    z = corners[:, 2] + HAND_TO_TCP
    # From the hand's base: the body from -0.026 to 0.066, fingertips at 0.112.
    np.testing.assert_allclose([z.min(), z.max()], [-0.026, 0.112], atol=5e-4)
    np.testing.assert_allclose(PANDA.palm_front + HAND_TO_TCP, 0.066, atol=5e-4)
    np.testing.assert_allclose(np.ptp(corners[:, :2], axis=0), [0.063, 0.204])
    tips = corners[corners[:, 2] > 0]
    assert np.abs(tips[:, 1]).min() == pytest.approx(width / 2)  # the pads


def test_the_open_hand_is_133_mm_wide_at_the_fingers() -> None:
    assert 0.08 + 2 * PANDA.finger_thickness_at(0.04) == pytest.approx(0.133, abs=5e-4)


def test_fingers_taper_towards_the_tip() -> None:
    thickness = [PANDA.finger_thickness_at(behind) for behind in np.linspace(0, 0.046, 20)]
    assert thickness == sorted(thickness)
    assert thickness[0] == pytest.approx(PANDA.finger_tip_thickness)
    assert thickness[-1] == pytest.approx(PANDA.finger_thickness)


def test_half_a_turn_about_z_maps_the_hand_onto_itself() -> None:
    corners = PANDA.corners(0.05)
    turned = corners * [-1, -1, 1]
    assert {tuple(corner) for corner in corners.round(9)} == {tuple(corner) for corner in turned.round(9)}


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Gripper)])
def test_lengths_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is 0"):
        Gripper(**{name: 0.0})
