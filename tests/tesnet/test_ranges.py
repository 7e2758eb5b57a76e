from __future__ import annotations

import numpy as np
import torch

from tesnet.ranges import PIXEL, range_image
from tests.tesnet.scenes import CAMERA, Array, tabletop


def of(array: Array | list[list[float]]) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32)


def test_a_pixel_holds_the_nearest_of_its_points_as_a_loop_finds_it() -> None:
    points, camera = of(tabletop(1)[::7]), of(CAMERA[None])[0]
    image = range_image(camera, points)
    assert image is not None
    depth, first = image.look(points)
    local = ((points - camera) @ image.axes).double()
    cells = ((local[:, :2] / local[:, 2:] - image.low) / image.pixel).floor()
    for index in range(0, len(points), 41):
        same = ((cells - cells[index]).abs() < 0.5).all(dim=1).nonzero()[:, 0]
        assert local[first[index], 2] == local[same, 2].min()
        torch.testing.assert_close(depth[index].double(), local[index, 2], atol=1e-6, rtol=0)


def test_a_pixel_is_as_wide_as_asked_where_the_points_are() -> None:
    grid = np.linspace(-0.1, 0.1, 101)
    points = of([[x, y, 0.0] for x in grid for y in grid])
    for width in (PIXEL, 0.02):
        image = range_image(of([[0.0, 0.0, 0.5]])[0], points, width)
        assert image is not None
        assert abs(float(image.pixel) * 0.5 - width) < 1e-4


def test_an_empty_pixel_one_beyond_the_image_and_one_behind_the_viewer_hold_nothing() -> None:
    ring = of([[np.cos(turn) * 0.1, np.sin(turn) * 0.1, 0.0] for turn in np.linspace(0, 6.28, 200)])
    image = range_image(of([[0.0, 0.0, 0.5]])[0], ring)
    assert image is not None
    _, first = image.look(of([[0.0, 0.0, -0.1], [0.4, 0.0, 0.0], [0.0, 0.0, 0.9], [0.1, 0.0, 0.0]]))
    assert first.tolist()[:3] == [len(ring)] * 3
    assert image.depths[first[0]] == torch.inf
    assert int(first[3]) < len(ring)


def test_a_place_behind_the_viewer_is_not_in_the_pixel_before_it() -> None:
    grid = np.linspace(-0.1, 0.1, 41)
    wall = of([[x, y, 0.0] for x in grid for y in grid])
    image = range_image(of([[0.0, 0.0, 0.5]])[0], wall)
    assert image is not None
    _, first = image.look(of([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9]]))
    assert int(first[0]) < len(wall)
    assert int(first[1]) == len(wall)


def test_there_is_no_image_of_what_lies_behind_the_viewer_alone() -> None:
    """Of points on all sides of a viewpoint in their middle, half have no pixel."""
    points = of([[0.0, 0.0, 1.0], [0.0, 0.1, -1.0], [0.1, 0.0, -1.0]])
    image = range_image(of([[0.0, 0.0, 0.0]])[0], points)
    assert image is not None
    assert image.look(points)[1].tolist()[0] == len(points)
    assert range_image(points[0], points[:1]) is None
