"""Dropout and flying pixels: how many, where, how deep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simharness.sim.sensors.losses import Dropout, FlyingPixels, cut_ellipse
from tesnet.geometry import CameraIntrinsics

Array = npt.NDArray[np.float64]


def test_dropout_loses_the_mean_area_of_its_ellipses(camera: CameraIntrinsics, plane: Callable[..., Array]) -> None:
    rng = np.random.default_rng(0)
    lost = [(Dropout()(plane(0.7), camera, rng) == 0).sum() for _ in range(200)]
    # The radii are independent: the mean area is pi times the product of their means.
    assert np.mean(lost) == pytest.approx(10 * np.pi * 5.0 * 5.0, rel=0.1)
    assert np.mean([number == 0 for number in lost]) < 0.01


def test_an_ellipse_has_its_area_and_its_axes_at_whatever_angle(camera: CameraIntrinsics) -> None:
    radii = np.array([20.0, 8.0])
    for angle in (0.0, 0.7, 2.0):
        image = np.ones((camera.height, camera.width))
        cut_ellipse(image, 200, 300, radii, angle)
        rows, columns = np.nonzero(image == 0)
        assert len(rows) == pytest.approx(np.pi * 20.0 * 8.0, rel=0.03)
        assert (rows.mean(), columns.mean()) == pytest.approx((200.0, 300.0), abs=0.1)
        along = (columns - 300) * np.cos(angle) + (rows - 200) * np.sin(angle)
        assert np.abs(along).max() == pytest.approx(20.0, abs=1.0)


@given(row=st.integers(0, 29), column=st.integers(0, 39), angle=st.floats(0, 3.2), radius=st.floats(0.5, 50))
def test_the_pixels_of_an_ellipse_are_those_within_it_wherever_it_lies(
    row: int, column: int, angle: float, radius: float
) -> None:
    image = np.ones((30, 40))
    cut_ellipse(image, row, column, np.array([radius, 4.0]), angle)
    down, across = np.indices(image.shape) - np.array([row, column])[:, None, None]
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    along, beside = np.tensordot(turn, np.stack([across, down]), axes=1)
    np.testing.assert_array_equal(image == 0, (along / radius) ** 2 + (beside / 4.0) ** 2 <= 1.0)


def test_an_ellipse_at_the_border_is_cut_off_there(camera: CameraIntrinsics) -> None:
    image = np.ones((camera.height, camera.width))
    cut_ellipse(image, 0, 639, np.array([10.0, 10.0]), 0.0)
    assert (image == 0).sum() == pytest.approx(np.pi * 100 / 4, rel=0.2)


def test_what_remains_is_as_it_was_and_an_empty_image_stays_empty(camera: CameraIntrinsics, block: Array) -> None:
    measured = Dropout()(block, camera, np.random.default_rng(1))
    np.testing.assert_array_equal(measured[measured > 0], block[measured > 0])
    assert (Dropout()(np.zeros_like(block), camera, np.random.default_rng(1)) == 0).all()


def test_half_of_the_pixels_at_breaks_fly_between_the_two_surfaces(camera: CameraIntrinsics, block: Array) -> None:
    measured = FlyingPixels()(block, camera, np.random.default_rng(0))
    flying = measured != block
    rows = flying[185:295]
    assert np.flatnonzero(rows.any(axis=0)).tolist() == [259, 260, 379, 380]
    assert rows[:, [259, 260, 379, 380]].mean() == pytest.approx(0.5, abs=0.08)
    depths = measured[flying]
    assert ((depths >= 0.6) & (depths <= 0.8)).all()
    assert depths.mean() == pytest.approx(0.7, abs=0.01)
    assert depths.std() == pytest.approx(0.2 / np.sqrt(12), rel=0.1)


def test_planes_and_the_border_of_what_is_seen_have_no_flying_pixels(
    camera: CameraIntrinsics, plane: Callable[..., Array]
) -> None:
    depth = plane(0.7, 60.0)
    depth[:, :50] = 0.0
    np.testing.assert_array_equal(FlyingPixels()(depth, camera, np.random.default_rng(0)), depth)


def test_nothing_flies_towards_pixels_that_see_nothing(camera: CameraIntrinsics, block: Array) -> None:
    holed = block.copy()
    holed[181:299:4, [258, 381]] = 0.0  # their neighbours along a corner stand at the break
    measured = FlyingPixels(share=1.0)(holed, camera, np.random.default_rng(0))
    flying = measured != holed
    assert flying[182:298, [259, 380]].sum() > 40
    assert (measured[flying] >= 0.6).all()
    assert (measured[holed == 0] == 0).all()
