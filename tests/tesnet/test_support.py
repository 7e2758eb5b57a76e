"""`support_height="auto"`: the height of tables that are there, and none where there is no table."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bench import rooms
from bench.solids import Block, Cylinder, Placed, standing
from tesnet import support
from tesnet.cloud import SUPPORT_NOISE
from tesnet.depth_noise import DepthNoise
from tesnet.geometry import Box, Pose
from tesnet.planes import SQUARE, Plane, basis
from tesnet.query import GraspQuery
from tests.tesnet.scenes import CAMERA, SUPPORT_HEIGHT, UP, ask, fresh_predictor, tabletop

Array = NDArray[np.float64]


def table(size: float = 0.3, height: float = 0.0, count: int = 30_000) -> Array:
    across = np.random.default_rng(3).uniform(-size, size, (count, 2))
    return np.column_stack([across, np.full(count, height)])


def auto(points: Array, **options: Any) -> GraspQuery:
    return ask(points, **{"viewpoints": CAMERA, "up": UP, "support_height": "auto", "max_candidates": 300, **options})


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.003])
def test_the_table_under_objects_is_found_to_a_millimetre_wherever_the_frame_lies(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate([tabletop(seed), table()])
    points += rng.normal(0, noise, points.shape)
    motion = Pose.random(rng, reach=0.5) if seed else Pose.identity()
    found = support.find(auto(motion.apply(points), viewpoints=motion.apply(CAMERA), up=motion.rotate(UP)))
    assert found is not None
    expected = float(motion.translation @ motion.rotate(UP))
    assert abs(found.height - expected) < 0.001
    assert found.share > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_tops_and_walls_of_objects_are_no_support(seed: int) -> None:
    assert support.find(auto(tabletop(seed))) is None
    above = Box(np.array([-1.0, -1.0, 0.03]), np.array([1.0, 1.0, 1.0]))
    assert support.find(auto(np.concatenate([tabletop(seed), table()]), workspace=above)) is None


def test_a_plane_that_is_not_across_up_is_no_support() -> None:
    tilted = np.array([np.sin(np.radians(4)), 0, np.cos(np.radians(4))])
    assert support.find(auto(np.concatenate([tabletop(0), table()]), up=tilted)) is None


@pytest.mark.parametrize("up", ["auto", UP])
def test_of_table_and_floor_the_table_with_things_is_the_support(up: Any) -> None:
    floor = table(1.2, height=-0.7, count=60_000)
    crossings = CAMERA + CAMERA[2] / (CAMERA[2] + 0.7) * (floor - CAMERA)
    floor = floor[(np.abs(crossings[:, :2]) > 0.3).any(axis=1)]  # the table hides the others
    points = np.concatenate([tabletop(0), table(), floor])
    everywhere = support.find(auto(points, up=up))
    assert everywhere is not None
    assert abs(everywhere.height) < 0.001


@pytest.mark.parametrize("room", list(rooms.KINDS.values()), ids=list(rooms.KINDS))
@pytest.mark.parametrize("seed", range(2))
def test_the_plane_that_things_stand_on_is_found_in_rooms(room: Callable[..., rooms.Room], seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = rooms.photograph(room(rng), (320, 240), 0.0015 * seed, rng)
    points, truth = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE), frame.truth
    motion = Pose.random(rng, reach=0.5)
    for up, moved in itertools.product(("auto", "given"), (False, True)):
        # In another frame than the camera's nothing speaks for what is up in the image.
        if up == "auto" and moved and room is rooms.shelf:
            continue
        pose = motion if moved else Pose.identity()
        true_up = pose.rotate(truth.up[None])[0]
        query = auto(pose.apply(points), viewpoints=pose.translation, up=up if up == "auto" else true_up)
        plane = support.find(query)
        assert plane is not None
        assert plane.up @ true_up > np.cos(np.deg2rad(1.0))
        assert plane.height == pytest.approx(truth.height + pose.translation @ true_up, abs=0.006)


@pytest.mark.parametrize("radius", [0.2, 0.6])
def test_nothing_stands_on_a_bent_floor_or_in_the_air(radius: float) -> None:
    points = table()
    points[:, 2] = radius - np.sqrt(np.maximum(radius**2 - points[:, 0] ** 2, 0))
    air = np.random.default_rng(0).uniform(-0.3, 0.3, (30_000, 3))
    for cloud in (points[np.abs(points[:, 0]) < 0.9 * radius], air):
        assert support.find(auto(cloud, up="auto")) is None


def test_the_region_is_what_stands_on_the_plane() -> None:
    things, beside = tabletop(0), np.array([[2.0, 0, 0.1], [0, 0, 0.5], [0, 0, -0.1], [0, 0, 0.001]])
    plane = support.find(auto(np.concatenate([things, table()])))
    assert plane is not None
    assert support.region(things[things[:, 2] > 0.004].astype(np.float32), plane).all()
    assert not support.region(beside.astype(np.float32), plane).any()


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_hardly_any_points_have_no_support_and_are_no_error(count: int) -> None:
    assert support.find(auto(np.zeros((count, 3)))) is None


@pytest.mark.parametrize("farthest", [1e4, 1e9, 1e30])
@pytest.mark.parametrize("up", ["auto", UP])
def test_points_that_fly_however_far_do_not_change_the_support(up: Any, farthest: float) -> None:
    points = np.concatenate([tabletop(0), table()])
    plain = support.find(auto(points, up=up))
    points[::4000] = farthest * np.array([[1, -1, -1]])
    points[2000::4000] = farthest * np.array([[1, 1, 1]])
    flying = auto(points, up=up)
    found = support.find(flying)
    assert plain is not None
    assert found is not None
    assert found.height == pytest.approx(plain.height, abs=1e-3)
    assert len(fresh_predictor().predict(flying).grasps) == 10


def test_grasps_with_auto_are_those_with_the_height_that_the_warning_names() -> None:
    """But for things that are lower than the noise of a support that has to be found."""
    things = tabletop(0)
    points = np.concatenate([things[things[:, 2] > SUPPORT_HEIGHT + SUPPORT_NOISE], table(0.2)])
    predictor = fresh_predictor()
    found = predictor.predict(auto(points))
    (note,) = [note for note in found.warnings if "support_height auto" in note]
    height = float(note.split(" m along up")[0].rpartition(" ")[2])
    given = predictor.predict(auto(points, support_height=height))
    np.testing.assert_allclose(found.grasps.Ts_cloud_grasp, given.grasps.Ts_cloud_grasp, atol=1e-5)
    assert len(found.grasps) == 10
    assert not [note for note in given.warnings if "support" in note]


def test_without_a_table_grasps_are_those_without_a_support_and_a_warning_says_so() -> None:
    predictor = fresh_predictor()
    found, none = predictor.predict(auto(tabletop(0))), predictor.predict(auto(tabletop(0), support_height=None))
    np.testing.assert_array_equal(found.grasps.Ts_cloud_grasp, none.grasps.Ts_cloud_grasp)
    assert any("no plane across up was found" in note for note in found.warnings)


@pytest.mark.parametrize("room", list(rooms.KINDS.values()), ids=list(rooms.KINDS))
@pytest.mark.parametrize("up", ["auto", "given"])
def test_a_query_that_is_kept_about_another_origin_finds_the_same_plane_and_tells_it_as_the_caller_has_it(
    room: Callable[..., rooms.Room], up: str
) -> None:
    """That a camera stands at the origin, which speaks for what is up, is asked of the caller's frame."""
    rng = np.random.default_rng(0)
    frame = rooms.photograph(room(rng), (240, 180), 0.0, rng)
    points = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE)
    origin = np.array([0.25, -0.5, 1.0])
    asked: dict[str, Any] = {
        "support_height": "auto",
        "max_candidates": 300,
        "up": "auto" if up == "auto" else frame.truth.up,
    }
    plain = ask(points, viewpoints=np.zeros(3), **asked)
    kept = ask((points - origin).astype(np.float32), viewpoints=-origin, origin=origin, **asked)
    (_, one, notes), (query, other, notes_of_kept) = support.settled(plain), support.settled(kept)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other.up, one.up, atol=1e-3)
    assert other.height + other.up @ origin == pytest.approx(one.height, abs=2e-3)
    assert query.support_height == other.height
    heights = [float(note.split(" m along up")[0].rpartition(" ")[2]) for (note,) in (notes, notes_of_kept)]
    assert heights == pytest.approx([one.height, one.height], abs=2e-3)


@pytest.mark.parametrize("noise_sd", [0.0, 0.0009, 0.004])
@pytest.mark.parametrize("seed", range(3))
def test_the_region_is_that_of_a_loop_over_its_points(seed: int, noise_sd: float) -> None:
    """On a board of 0.3 x 0.2 m that lies anywhere: 2 cm inside its edge, above its noise, to 0.35 m."""
    rng = np.random.default_rng(seed)
    pose = Pose.random(rng, reach=0.2)
    local = rng.uniform([-0.2, -0.15, -0.05], [0.2, 0.15, 0.45], (4000, 3))
    local[:1500, 2] = rng.uniform(-0.001, 0.02, 1500)
    up = pose.rotate(np.array([0.0, 0.0, 1.0]))
    normals = pose.rotate(np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]))
    sides = np.column_stack([normals, normals @ pose.translation + [0.15, 0.15, 0.1, 0.1]])
    noise = DepthNoise(np.zeros((1, 3)), noise_sd, 0.0)
    plane = support.SupportPlane(up, float(up @ pose.translation), 0.5, 0.06, noise_sd, sides, noise)
    lowest = max(0.003, 4 * noise_sd)
    distances = [[abs(abs(x) - 0.13), abs(abs(y) - 0.08), abs(z - lowest), abs(z - 0.35)] for x, y, z in local.tolist()]
    clear = np.min(distances, axis=1) > 1e-5  # of every limit, whichever way float32 rounds
    expected = [abs(x) < 0.13 and abs(y) < 0.08 and lowest < z < 0.35 for x, y, z in local.tolist()]
    found = support.region(pose.apply(local).astype(np.float32), plane)
    assert found[clear].tolist() == np.array(expected)[clear].tolist()
    assert 100 < found.sum() < 3000


def by_a_loop(plane: Plane, noise: float, points: Array, eye: Any) -> tuple[bool, int]:
    """`support._is_surface` and `support._things`, a point at a time."""
    across = basis(plane.up)
    uv, heights = points @ across[:, :2], points @ plane.up - plane.height
    squares = [tuple(square) for square in np.floor(uv / SQUARE).astype(int).tolist()]
    area = len({square for square, is_own in zip(squares, plane.own, strict=True) if is_own}) * SQUARE**2
    inside = [all(point @ side[:3] <= side[3] for side in plane.sides) for point in points]
    below = sum(one and -0.35 < h < -0.015 for one, h in zip(inside, heights, strict=True))
    is_surface = not (area < 0.008 or (area < 0.09 and below > 0.2 * plane.own.sum()))
    if eye is not None:
        over, through = eye @ plane.up - plane.height, 0
        for point, h in zip(points, heights, strict=True):
            crossing = eye + over / (over - h) * (point - eye)
            through += h < -0.015 and all(crossing @ side[:3] <= side[3] - SQUARE for side in plane.sides)
        is_surface = is_surface and through <= 0.15 * plane.own.sum()
    well_inside = [all(point @ side[:3] <= side[3] - 0.02 for side in plane.sides) for point in points]
    highest: dict[tuple[int, ...], float] = {}
    for square, h in zip(squares, heights, strict=True):
        highest[square] = max(highest.get(square, -np.inf), h)
    least = max(0.003, 4 * noise)
    things = zip(squares, well_inside, heights, strict=True)
    return is_surface, sum(one and h > least and highest[square] <= 0.35 for square, one, h in things)


@pytest.mark.parametrize("seed", range(40))
def test_what_speaks_for_a_plane_is_what_a_loop_over_the_points_counts(seed: int) -> None:
    """Of boards of many sizes with more or less on, below and behind them, from many sides."""
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.03, 0.25, 2)
    board = np.column_stack([rng.uniform(-half, half, (400, 2)), rng.normal(0, 0.001, 400)])
    things = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, rng.choice([0.1, 0.6])], (int(rng.choice([0, 12, 20, 90])), 3))
    below = rng.uniform([-0.3, -0.3, -0.4], [0.3, 0.3, 0.0], (int(rng.choice([0, 60, 90, 300])), 3))
    local = np.concatenate([board, things, below])
    own = np.zeros(len(local), dtype=bool)
    own[:400] = True
    pose = Pose.random(rng, reach=0.2)
    eye = None if seed % 4 == 0 else pose.apply(rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.6]))
    points, up = pose.apply(local), pose.rotate(np.array([0.0, 0.0, 1.0]))
    normals = pose.rotate(np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]))
    sides = np.column_stack([normals, normals @ pose.translation + np.repeat(half, 2)])
    noise, height = float(rng.choice([0.0005, 0.003])), float(up @ pose.translation)
    plane = Plane(up, height, noise, sides, own)
    place = support.SupportPlane(up, height, 0.5, 0.1, noise, sides, DepthNoise(np.zeros((1, 3)), noise, 0.0))
    is_surface, count = by_a_loop(plane, noise, points, eye)
    assert support._is_surface(plane, support._area(plane, points), points, eye) == is_surface
    assert support._things(points.astype(np.float32), place) == pytest.approx(count, abs=1)  # as float32 rounds


def thing(x: float, y: float, size: float, height: float) -> Placed:
    return Block(np.full(3, size / 2)), standing(x, y, height + size / 2, 0.4)


def small_table(length: float, depth: float, height: float, things: tuple[Placed, ...]) -> rooms.Room:
    """A table with the floor in view, from a metre away."""
    eye = np.array([0, -0.7, height + 0.73])
    solids = (rooms._floor(), *rooms._desk(length, depth, height), *things)
    return rooms.Room(solids, eye, np.array([0, 0, height]), height, rooms._corners(length, depth))


@pytest.mark.parametrize("noise", [0.0, 0.0005, 0.001, 0.002])
@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize(
    "sizes", [(0.03,), (0.05, 0.04), (0.012, 0.05, 0.04)], ids=["one", "two", "three"]
)  # fmt: skip
def test_few_small_things_on_a_small_table_are_more_than_the_noise_of_the_floor(
    noise: float, up: str, sizes: tuple[float, ...]
) -> None:
    """Which grows with the square of the distance."""
    places = [(0.0, 0.0), (0.1, 0.08), (-0.15, 0.05)]
    things = tuple(thing(*place, size, 0.72) for place, size in zip(places, sizes, strict=False))
    room = small_table(0.6, 0.5, 0.72, things)
    frame = rooms.photograph(room, rooms.VGA, noise, np.random.default_rng(0))
    assert_support_is_the_truth(frame, up)


@pytest.mark.parametrize("focal_share", [0.5, 0.7, 0.95])
@pytest.mark.parametrize("kind", ["legs", "cabinet", "stairs"])
@pytest.mark.parametrize("up", ["auto", "given"])
def test_what_is_below_the_edge_of_a_nearer_plane_is_no_thing_on_the_floor(
    focal_share: float, kind: str, up: str
) -> None:
    rng = np.random.default_rng(1)
    room = {"legs": rooms.small_table, "cabinet": rooms.cabinet, "stairs": rooms.stairs}[kind](rng)
    assert_support_is_the_truth(rooms.photograph(room, rooms.VGA, 0.001, rng, focal_share), up)


@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize("radius", [0.14, 0.16])
def test_the_seat_of_a_stool_is_a_support_though_the_floor_shows_below_it(radius: float, up: str) -> None:
    """Under the top of a box are its sides; the floor is too far below to be one."""
    seat, column = Cylinder(radius, 0.015), Cylinder(0.03, 0.21)
    stool = [(seat, standing(0, 0, 0.435)), (column, standing(0, 0, 0.21))]
    things = [thing(-0.05, 0.02, 0.05, 0.45), thing(0.06, -0.03, 0.04, 0.45)]
    eye, corners = np.array([0, -0.55, 0.95]), rooms._corners(2 * radius, 2 * radius)
    room = rooms.Room((rooms._floor(), *stool, *things), eye, np.array([0, 0, 0.45]), 0.45, corners)
    assert_support_is_the_truth(rooms.photograph(room, rooms.VGA, 0.001, np.random.default_rng(0)), up)


@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize("seed", range(8))
def test_a_worktop_with_a_sink_is_a_support_also_where_the_image_cuts_the_sink(seed: int, up: str) -> None:
    rng = np.random.default_rng(seed)
    frame = rooms.photograph(rooms.worktop(rng), (320, 240), 0.001 * (seed % 2), rng, rooms.FOCAL_SHARES[seed // 4])
    assert_support_is_the_truth(frame, up)


def above(solids: list[Placed], height: float, level: float = 0.0) -> rooms.Room:
    """Solids on the floor, seen from 1.1 m; the truth is of a level of theirs, if it is not that of the floor."""
    eye = np.array([0, -0.55, height + 0.95])
    return rooms.Room((rooms._floor(), *solids), eye, np.array([0, 0, height]), level, rooms._corners(1.0, 1.0))


def walled(half: Array, opening: Array, bottom: float, height: float) -> list[Placed]:
    """Blocks about an opening of half so many metres, from a bottom to a height, half so wide together."""
    (x, y), (inner_x, inner_y), middle = half, opening, (bottom + height) / 2
    sizes = [((x - inner_x) / 2, y, (x + inner_x) / 2, 0.0), (inner_x, (y - inner_y) / 2, 0.0, (y + inner_y) / 2)]
    return [
        (Block(np.array([size_x, size_y, (height - bottom) / 2])), standing(sign * at_x, sign * at_y, middle))
        for size_x, size_y, at_x, at_y in sizes
        for sign in (-1, 1)
    ]


@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize("opening", [0.08, 0.14, 0.2])
def test_a_table_with_a_hole_is_a_support(opening: float, up: str) -> None:
    """Through which the floor is seen."""
    table_top = walled(np.array([0.5, 0.35]), np.full(2, opening), 0.69, 0.72)
    things = [thing(0.35, 0.1, 0.06, 0.72), thing(-0.3, -0.2, 0.05, 0.72), thing(0.1, -0.28, 0.04, 0.72)]
    frame = rooms.photograph(above([*table_top, *things], 0.72, 0.72), rooms.VGA, 0.001, np.random.default_rng(0))
    assert_support_is_the_truth(frame, up)


@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize("flange", [0.01, 0.02, 0.03])
def test_the_rim_of_a_bin_is_no_support_though_things_reach_over_it(flange: float, up: str) -> None:
    inside = np.array([0.2, 0.15])
    things = [(Block(np.array([0.03, 0.03, 0.1])), standing(x, y, 0.1, x)) for x, y in ((-0.1, 0.05), (0.05, -0.05))]
    solids = [*walled(inside + flange, inside, 0.0, 0.15), *things, thing(0.12, 0.08, 0.05, 0.0)]
    frame = rooms.photograph(above(solids, 0.1), rooms.VGA, 0.001, np.random.default_rng(0))
    assert_support_is_the_truth(frame, up)


@pytest.mark.parametrize("up", ["auto", "given"])
@pytest.mark.parametrize("gap", [0.03, 0.06, 0.1, 0.16])
@pytest.mark.parametrize("left_out", [(), ((0, 0),), ((0, 0), (0, 1))], ids=["all", "a ring", "a bay"])
def test_tops_of_boxes_are_no_support_though_things_stand_on_them(
    left_out: tuple[tuple[int, int], ...], gap: float, up: str
) -> None:
    """Nine boxes, as high as each other, or eight or seven about a place without one."""
    box = Block(np.array([0.08, 0.06, 0.07]))
    places = [place for place in itertools.product((-1, 0, 1), repeat=2) if place not in left_out]
    boxes = [(box, standing(i * (0.16 + gap), j * (0.12 + gap), 0.07)) for i, j in places]
    things = [thing(i * (0.16 + gap), j * (0.12 + gap), 0.05, 0.14) for i, j in ((-1, -1), (1, -1))]
    frame = rooms.photograph(above([*boxes, *things], 0.1), rooms.VGA, 0.001, np.random.default_rng(0))
    assert_support_is_the_truth(frame, up)


def assert_support_is_the_truth(frame: rooms.RoomFrame, up: str) -> None:
    points, truth = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE), frame.truth
    plane = support.find(auto(points, viewpoints=np.zeros(3), up="auto" if up == "auto" else truth.up))
    assert plane is not None
    assert plane.up @ truth.up > np.cos(np.deg2rad(1.5))
    assert plane.height == pytest.approx(truth.height, abs=0.006)


@pytest.mark.parametrize("noise", [0.001, 0.002, 0.004])
def test_hardly_a_point_of_an_empty_plane_is_in_its_region_however_its_noise_grows(noise: float) -> None:
    rng = np.random.default_rng(0)
    frame = rooms.photograph(rooms.empty(rng), rooms.VGA, noise, rng)
    points = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE)
    plane = support.find(auto(points, viewpoints=np.zeros(3), up="auto"))
    assert plane is not None
    assert support.region(points.astype(np.float32), plane).sum() < 3e-4 * len(points)


def test_up_alone_before_a_large_plane_has_the_remedy_named_and_before_things_alone_nothing() -> None:
    table_with_things = ask(np.concatenate([tabletop(0), table()]), viewpoints=CAMERA, up=UP)
    query, plane, (note,) = support.settled(table_with_things)
    assert query is table_with_things
    assert plane is None
    assert "the plane at 0.0000 m along up" in note
    assert 'give that height, or support_height: "auto"' in note
    assert support.settled(ask(tabletop(0), viewpoints=CAMERA, up=UP))[2] == []


@pytest.mark.parametrize("height", ["auto", None])
def test_an_up_that_points_away_from_the_camera_is_named_and_with_auto_left_out(height: Any) -> None:
    reversed_up = ask(np.concatenate([tabletop(0), table()]), viewpoints=CAMERA, up=-UP, support_height=height)
    query, plane, (note,) = support.settled(reversed_up)
    assert plane is None
    assert "reverse it" in note
    assert (query.up is None) == (height == "auto")
    assert query.support_height is None
