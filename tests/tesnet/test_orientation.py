from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tesnet import points as pts
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Pose
from tesnet.orientation import orient, towards_who_saw
from tests.tesnet.raycast import THINGS, Can, Shape, Slab, Views, around, cast
from tests.tesnet.scenes import UP, Array, ask, prepared


def looked_at(things: tuple[Shape, ...], cameras: Array, seed: int = 0) -> tuple[PreparedCloud, Views]:
    views = cast(things, cameras, np.random.default_rng(seed))
    return prepared(ask(views.points, viewpoints=views.cameras, up=UP, support_height=0.0)), views


def cosines_with_truth(cloud: PreparedCloud, views: Views, normals: torch.Tensor) -> tuple[Array, Array]:
    """Of the points of walls whose normal lies near its line's: cosines with the true one, and which was nearest."""
    frame = cloud.T_cloud_canonical
    _, nearest = cKDTree(views.points).query(frame.apply(cloud.points.double().numpy()))
    true = views.normals[nearest]
    cosines = (frame.rotate(normals.double().numpy()) * true).sum(axis=1)
    counted = (np.abs(true[:, 2]) < 0.5) & (np.abs(cosines) > 0.7)
    return cosines[counted], nearest[counted]


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_walls_face_outward_when_cameras_face_each_other(count: int) -> None:
    """Boxes, cans, a board of 3 mm and a bowl of 4 mm; the viewpoint most nearly along the normal turns half inward."""
    cloud, views = looked_at(THINGS, around(count, start_deg=47))
    cosines, _ = cosines_with_truth(cloud, views, cloud.normals)
    assert (cosines < 0).mean() < 0.05
    most_along, _ = pts.orient_normals(cloud.points, cloud.normals, cloud.viewpoints)
    assert (cosines_with_truth(cloud, views, most_along)[0] < 0).mean() > 0.3


@pytest.mark.parametrize("thing", [Can((0.0, 0.0, 0.0), 0.025, 0.12), Slab((0.0, 0.0, 0.0), (0.05, 0.05, 0.05))])
def test_a_can_or_a_box_seen_all_round_faces_outward_everywhere(thing: Shape) -> None:
    cloud, views = looked_at((thing,), around(4, polar_deg=80))
    cosines, _ = cosines_with_truth(cloud, views, cloud.normals)
    assert (cosines < 0).mean() < 0.005


def test_the_direction_of_view_is_to_a_camera_on_the_outer_side_that_saw_the_point() -> None:
    cloud, views = looked_at(THINGS[:2], around(4))
    assert float((cloud.view_directions * cloud.normals).sum(dim=1).min()) >= -1e-6
    to_cameras = torch.nn.functional.normalize(cloud.viewpoints[None] - cloud.points[:, None], dim=2)
    chosen = (to_cameras * cloud.view_directions[:, None]).sum(dim=2)
    assert float(chosen.amax(dim=1).min()) > 0.99999
    frame = cloud.T_cloud_canonical
    positions = frame.apply(cloud.points.double().numpy())
    from_chosen = [cKDTree(views.points[views.view_index == camera]) for camera in range(4)]
    distances = np.stack([tree.query(positions)[0] for tree in from_chosen])
    nearest = distances[chosen.argmax(dim=1).numpy(), np.arange(len(positions))]
    assert (nearest < 0.005).mean() > 0.97


def test_a_viewpoint_straight_before_a_wall_is_not_chosen_where_a_screen_stands_between() -> None:
    """The screen hides the wall from the camera most nearly along its normal; two others see it past the screen."""
    screened = (Slab((0.0, 0.0, 0.0), (0.03, 0.10, 0.05)), Slab((0.07, 0.0, 0.0), (0.01, 0.20, 0.12)))
    cloud, _ = looked_at(screened, np.array([[0.6, 0.0, 0.1], [0.15, 0.3, 0.55], [0.15, -0.4, 0.5]]))
    positions = cloud.T_cloud_canonical.apply(cloud.points.double().numpy())
    of_wall = (np.abs(positions[:, 0] - 0.015) < 0.004) & (positions[:, 2] < 0.045)
    assert of_wall.sum() > 100
    to_cameras = torch.nn.functional.normalize(cloud.viewpoints[None] - cloud.points[:, None], dim=2)
    chosen = (to_cameras * cloud.view_directions[:, None]).sum(dim=2).argmax(dim=1).numpy()
    assert (chosen[of_wall] != 0).mean() > 0.95


def test_the_chosen_viewpoints_do_not_depend_on_signs_and_move_with_the_cloud() -> None:
    cloud, _ = looked_at(THINGS, around(3))
    signs = torch.from_numpy(np.random.default_rng(0).choice([-1.0, 1.0], (len(cloud), 1))).float()
    plain = towards_who_saw(cloud.points, cloud.normals, cloud.neighbours, cloud.viewpoints)
    flipped = towards_who_saw(cloud.points, cloud.normals * signs, cloud.neighbours, cloud.viewpoints)
    torch.testing.assert_close(plain, flipped)
    motion = Pose.random(np.random.default_rng(1), reach=0.3)
    turn, shift = torch.tensor(motion.rotation), torch.tensor(motion.translation)
    moved = towards_who_saw(
        (cloud.points.double() @ turn.T + shift).float(),
        (cloud.normals.double() @ turn.T).float(),
        cloud.neighbours,
        (cloud.viewpoints.double() @ turn.T + shift).float(),
    )
    # Rounding takes single points over a pixel's border.
    assert (((moved.double() @ turn) * plain).sum(dim=1) > 0.9999).double().mean() > 0.99


def test_a_viewpoint_saw_nothing_that_lies_behind_it() -> None:
    """A camera looks down at a floor, with its back to a shelf that another one sees from above, less squarely."""
    grid = torch.linspace(-0.1, 0.1, 45)
    floor = torch.cartesian_prod(grid, grid, torch.zeros(1))
    shelf = torch.cartesian_prod(grid[::2], grid[::2], torch.full((1,), 0.5))
    points = torch.cat([shelf, floor])
    normals = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    viewpoints = torch.tensor([[0.0, 0.0, 0.3], [0.3, 0.0, 0.9]])
    towards = towards_who_saw(points, normals, pts.nearest_neighbours(points, 16), viewpoints)
    expected = torch.nn.functional.normalize(viewpoints[1] - shelf, dim=1)
    torch.testing.assert_close(towards[: len(shelf)], expected)
    assert float(towards[len(shelf) :, 2].min()) > 0


@pytest.mark.parametrize("count", [1, 3])
def test_directions_that_are_told_decide_over_what_is_seen(count: int) -> None:
    cloud, _ = looked_at(THINGS, around(count))
    inside_out = -cloud.normals
    told = torch.arange(len(cloud)) % 2 == 0
    normals, _ = orient(
        cloud.points, cloud.normals, cloud.neighbours, cloud.viewpoints, torch.where(told[:, None], inside_out, 0.0)
    )
    seen, _ = orient(cloud.points, cloud.normals, cloud.neighbours, cloud.viewpoints)
    torch.testing.assert_close(normals[told], inside_out[told], rtol=0, atol=0)
    torch.testing.assert_close(normals[~told], seen[~told], rtol=0, atol=0)
    torch.testing.assert_close(seen, cloud.normals, rtol=0, atol=0)


def test_who_saw_a_point_as_told_turns_even_the_walls_of_a_board_of_2_mm() -> None:
    board = Slab((0.0, 0.0, 0.0), (0.10, 0.002, 0.08))
    cameras = around(2, start_deg=90, polar_deg=70)
    cloud, views = looked_at((board,), cameras)
    positions = cloud.T_cloud_canonical.apply(cloud.points.double().numpy())
    _, nearest = cKDTree(views.points).query(positions)
    towards = cameras[views.view_index[nearest]] - positions
    outward = torch.from_numpy(cloud.T_cloud_canonical.inverse().rotate(towards)).float()
    outward = torch.nn.functional.normalize(outward, dim=1)
    normals, directions = orient(cloud.points, cloud.normals, cloud.neighbours, cloud.viewpoints, outward)
    cosines, _ = cosines_with_truth(cloud, views, normals)
    assert (cosines > 0).all()
    assert float((directions * outward).sum(dim=1).min()) > 0.9999
