"""Planes are found where they were put, with the noise that was added, and moved with the cloud; bent ones are none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tesnet import planes
from tesnet.geometry import Pose

Array = NDArray[np.float64]


def square(size: float, count: int = 20_000, noise: float = 0.0, seed: int = 0) -> Array:
    """Points (count, 3) of a square about the origin, across z."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-size / 2, size / 2, (count, 2)), rng.normal(0, noise, count)])


def found(points: Array) -> list[planes.Plane]:
    surfaces = planes.Surfaces.of(points)
    return [plane for direction in surfaces.directions() for plane in surfaces.planes_near(direction)]


@pytest.mark.parametrize("noise", [0.0005, 0.001, 0.003])
def test_the_noise_that_is_measured_is_the_noise_that_was_added(noise: float) -> None:
    (plane,) = found(square(0.6, noise=noise))
    assert plane.noise_sd == pytest.approx(noise, rel=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_moves_with_its_points(seed: int) -> None:
    motion = Pose.random(np.random.default_rng(seed), reach=2.0)
    (plane,) = found(motion.apply(square(0.6, noise=0.001)))
    up = motion.rotate(np.array([[0.0, 0.0, 1.0]]))[0]
    assert abs(plane.up @ up) > np.cos(np.deg2rad(0.2))
    assert plane.height * np.sign(plane.up @ up) == pytest.approx(motion.translation @ up, abs=0.002)


def test_planes_of_a_corner_are_three() -> None:
    turn = np.eye(3)[[1, 2, 0]]
    corner = np.concatenate(
        [(square(1.0) + np.array([0.5, 0.5, 0])) @ np.linalg.matrix_power(turn, k) for k in range(3)]
    )
    ups = np.abs([plane.up for plane in found(corner)])
    assert sorted(map(tuple, ups.round(3))) == [(0, 0, 1), (0, 1, 0), (1, 0, 0)]


@pytest.mark.parametrize("radius", [0.2, 0.5, 1.0])
def test_a_bent_surface_is_no_plane(radius: float) -> None:
    points = square(0.4)
    points[:, 2] = radius - np.sqrt(radius**2 - points[:, 0] ** 2)
    assert found(points) == []


def test_pieces_hang_together_across_a_gap_of_one_square() -> None:
    squares = np.array([[0, 0], [0, 2], [0, 5], [3, 0], [4, 1]])
    assert planes.pieces(squares).tolist() == [0, 0, 2, 3, 3]


def test_the_outline_holds_the_points_and_little_else() -> None:
    points, up = square(0.4), np.array([0.0, 0.0, 1.0])
    sides = planes.outline(points, up)
    assert planes.within(points, sides + np.array([0, 0, 0, 1e-9])).all()
    assert not planes.within(points * 1.05 + np.sign(points) * 0.012, sides)[
        np.abs(points[:, :2]).max(axis=1) > 0.195
    ].any()


@pytest.mark.parametrize("turn_deg", [3.0, 11.0, 38.0, 71.0])
def test_the_outline_of_a_board_ends_where_the_board_does_however_it_lies(turn_deg: float) -> None:
    """A wall 1 cm behind a board, of which twenty-four sides of any turn left 2 cm to the board."""
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    board = square(1.0) * np.array([0.9, 0.34, 1.0]) @ turn.T
    sides = planes.outline(board, np.array([0.0, 0.0, 1.0]))
    along = np.linspace(-0.44, 0.44, 89)
    for beyond in (-0.18, 0.18):
        wall = np.column_stack([along, np.full(89, beyond), np.zeros(89)]) @ turn.T
        assert not planes.within(wall, sides).any()


def test_the_spread_of_a_sample_is_even() -> None:
    rows = planes.spread(np.arange(300_000.0)[:, None], 1000)[:, 0]
    assert len(rows) == 1000
    assert (np.floor(rows / 300) == np.arange(1000)).all()
    assert len(np.unique(rows % 640)) > 300


@pytest.mark.parametrize("reach", [0.5, 30.0, 400.0], ids=["all cells counted", "some sorted", "most sorted"])
@pytest.mark.parametrize("dimensions", [2, 3])
def test_cells_are_those_of_a_loop_over_the_points(dimensions: int, reach: float) -> None:
    points = np.random.default_rng(dimensions).uniform(-reach, reach, (3000, dimensions))
    points[1000:] *= 0.02
    occupied, cell_of, sizes = planes.cells(points, 0.1)
    indices = [tuple(np.floor(point / 0.1).astype(int).tolist()) for point in points]
    ordered = sorted(set(indices))
    np.testing.assert_array_equal(occupied, np.array(ordered) - np.min(ordered, axis=0))
    assert [ordered[number] for number in cell_of] == indices
    assert sizes.tolist() == [indices.count(index) for index in ordered]


@pytest.mark.parametrize("farthest", [1e6, 1e9, 1e12, 1e30])
def test_points_that_fly_however_far_leave_the_other_cells_as_they_are(farthest: float) -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)).astype(np.float32)
    _, expected, _ = planes.cells(points, 0.1)
    flying = np.array([[farthest, 0, 0], [0, -farthest, farthest]], dtype=np.float32)
    _, cell_of, sizes = planes.cells(np.concatenate([points, flying]), 0.1)
    assert len(set(zip(cell_of[:500].tolist(), expected.tolist(), strict=True))) == len(set(expected.tolist()))
    assert sizes[cell_of[500:]].tolist() == [1, 1]


@pytest.mark.parametrize("count", [1, 2, 7, 100, 1001])
def test_the_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count).round(1)
    assert planes.median(values) == pytest.approx(np.median(values), abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_squares_that_are_left_out_are_those_that_no_walk_from_the_starts_reaches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(3, 14, 2))
    free, starts = rng.random(shape) < rng.uniform(0.4, 0.8), rng.random(shape) < 0.05
    rows, columns = shape
    inner = {(row, column) for row in range(1, rows - 1) for column in range(1, columns - 1) if free[row, column]}
    reached = {square for square in inner if starts[square]}
    fresh = set(reached)
    while fresh:
        beside = {
            (row + up, column + right) for row, column in fresh for up, right in ((0, 1), (1, 0), (0, -1), (-1, 0))
        }
        fresh = (beside & inner) - reached
        reached |= fresh
    assert set(zip(*np.nonzero(planes.left_out(free, starts)), strict=True)) == inner - reached
    around = [(row + up, column + right) for row, column in inner for up in (-1, 0, 1) for right in (-1, 0, 1)]
    cut = np.zeros(shape, dtype=bool)
    cut[1:-1, 1:-1] = free[1:-1, 1:-1]
    assert set(zip(*np.nonzero(planes.grown(cut)), strict=True)) == set(around)
