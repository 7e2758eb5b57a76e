from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import distance_transform_edt

from simharness.play import pictures
from simharness.play.pictures import (
    PICTURE_SIZE,
    close_up,
    cloud_picture,
    hand_lines,
    png,
    segmentation_colours,
    widen,
)
from tesnet.geometry import PANDA, CameraIntrinsics, Pose


def test_the_drawn_hand_is_as_wide_as_the_grasp_and_ends_at_the_fingertips() -> None:
    T_world_grasp = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3])  # top-down: half a turn about x
    lines = hand_lines(T_world_grasp.matrix, 0.06)
    tips = lines[:2, 1]
    assert np.linalg.norm(tips[0] - tips[1]) == pytest.approx(0.06)
    np.testing.assert_allclose(tips[:, 2], 0.3 - PANDA.tip_offset)


def test_objects_keep_their_colour_when_others_go() -> None:
    bodies = np.array([[-1, 0, 3, 5]], dtype=np.int32)
    before, after = segmentation_colours(bodies, [3, 5]), segmentation_colours(bodies, [5])
    np.testing.assert_array_equal(before[0, 3], after[0, 3])
    assert len({tuple(pixel) for pixel in before[0].tolist()}) == 4


def test_the_cloud_picture_shows_points_and_hand() -> None:
    points = np.array([[0.15, 0.15, 0.08]], dtype=np.float32)
    grey = np.full((1, 3), 100, dtype=np.uint8)
    pose = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.15, 0.15, 0.15]).matrix
    picture = np.asarray(cloud_picture(points, grey, pose, 0.08, (220, 38, 38), np.array([0.15, -0.4, 0.5])))
    assert (picture == (220, 38, 38)).all(axis=2).any()
    assert (picture == (100, 100, 100)).all(axis=2).any()


def test_the_cloud_picture_holds_all_points_and_is_as_large_as_they_allow() -> None:
    points = np.array([[x, y, 0.1] for x in (0.0, 0.3) for y in (0.0, 0.3)], dtype=np.float32)
    colours = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0]], dtype=np.uint8)
    pose = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.15, 0.15, 0.15]).matrix
    image = cloud_picture(points, colours, pose, 0.08, (220, 38, 38), np.array([0.15, -0.4, 0.5]))
    picture = np.asarray(image).astype(int)
    places = []
    for colour in colours:
        lit = colour > 0
        seen = (picture[..., lit] > 100).all(axis=2) & (picture[..., ~lit] < 5).all(axis=2)
        assert seen.any(), colour
        places.append(np.argwhere(seen).mean(axis=0))
    across = np.ptp(places, axis=0) / picture.shape[:2]
    assert 0.6 < across.max() < 1.0


@pytest.mark.parametrize("side", [(-1, 0), (1, 0), (0, -1), (0, 1)])
def test_what_lies_beside_the_picture_is_not_drawn_in_it(side: tuple[int, int]) -> None:
    view = CameraIntrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    canvas = np.full((48, 64, 3), 255, dtype=np.uint8)
    # One metre before the camera, a few pixels outside.
    place = np.array([[side[0] * 38 / 50, side[1] * 30 / 50, 1.0]], dtype=np.float32)
    nearest = pictures._splat(canvas, place, np.zeros((1, 3), dtype=np.uint8), Pose.identity(), view)
    assert (canvas == 255).all()
    assert np.isinf(nearest).all()


def test_an_empty_cloud_gives_a_picture_too() -> None:
    nothing = np.empty((0, 3))
    picture = cloud_picture(
        nothing.astype(np.float32), nothing.astype(np.uint8), np.eye(4), 0.08, (1, 2, 3), np.array([0.5, 0.5, 0.6])
    )
    assert Image.open(io.BytesIO(png(picture))).size == PICTURE_SIZE


@pytest.mark.parametrize("corner", [(0, 0), (200, 300), (470, 630)])
def test_a_close_up_holds_the_objects(corner: tuple[int, int]) -> None:
    bodies = np.full((480, 640), -1, dtype=np.int32)
    bodies[corner[0] : corner[0] + 10, corner[1] : corner[1] + 10] = 4
    part = bodies[close_up(bodies, [4, 5])]
    assert part.shape == (120, 160)
    assert (part == 4).sum() == (bodies == 4).sum()


def test_a_close_up_grows_with_the_objects_up_to_the_image() -> None:
    bodies = np.zeros((480, 640), dtype=np.int32)
    bodies[100:300, 200:300] = 4
    rows, columns = close_up(bodies, [4])
    assert rows.start < 100
    assert rows.stop > 300
    assert (columns.stop - columns.start) * 3 == pytest.approx((rows.stop - rows.start) * 4, abs=4)
    bodies[:] = 4
    assert bodies[close_up(bodies, [4])].shape == bodies.shape
    assert bodies[close_up(bodies, [])].shape == bodies.shape


def test_points_beside_an_object_get_its_colour() -> None:
    image = np.zeros((3, 4, 3), np.uint8)
    image[1, 1] = 200
    known = np.zeros((3, 4), dtype=bool)
    assert (widen(image, known) == image).all()
    known[1, 1] = True
    assert (widen(image, known) == 200).all()


@pytest.mark.parametrize(("shape", "share"), [((40, 30), 0.02), ((9, 25), 0.3), ((1, 7), 0.3), ((31, 1), 0.1)])
def test_an_image_is_widened_by_the_nearest_pixels(shape: tuple[int, int], share: float) -> None:
    rng = np.random.default_rng(4)
    known = rng.random(shape) < share
    known.flat[rng.integers(known.size)] = True
    numbered = np.stack([*np.indices(shape), np.zeros(shape)], axis=2).astype(np.uint8)
    rows, columns, _ = np.moveaxis(widen(numbered, known).astype(int), 2, 0)
    assert known[rows, columns].all()
    chosen = np.hypot(*(np.stack([rows, columns]) - np.indices(shape)))
    np.testing.assert_allclose(chosen, distance_transform_edt(~known))


def test_what_points_hide_of_the_hand_is_pale() -> None:
    # A wall before the hand, seen from the side of negative y.
    x, z = np.meshgrid(np.linspace(-0.1, 0.4, 400), np.linspace(0.05, 0.3, 200))
    wall = np.stack([x.ravel(), np.full(x.size, 0.15), z.ravel()], axis=1).astype(np.float32)
    grey = np.full((len(wall), 3), 100, dtype=np.uint8)
    pose = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.15, 0.2, 0.08]).matrix
    picture = np.asarray(cloud_picture(wall, grey, pose, 0.08, (220, 38, 38), np.array([0.15, -0.4, 0.3])))
    assert not (picture == (220, 38, 38)).all(axis=2).any()
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    assert ((red > green + 20) & (green == blue)).any()
