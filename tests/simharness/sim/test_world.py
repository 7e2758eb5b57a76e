"""The layer over Bullet: what is loaded, touched, remembered and seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from simharness.errors import LoadError
from simharness.sim.world import BASE_LINK, GRAVITY, TIMESTEP, World, data_path
from tesnet.geometry import Pose

pytestmark = pytest.mark.sim

CUBE = data_path() / "cube_small.urdf"
HALF = 0.025
WHITE = (1.0, 1.0, 1.0, 1.0)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def world() -> Iterator[World]:
    """Nothing but gravity."""
    with World() as world:
        yield world


def add_cube(world: World, x: float, y: float, z: float) -> int:
    return world.load_object(CUBE, Pose(np.eye(3), np.array([x, y, z])), scale=1.0, mass=0.5, friction=1.0)


def test_a_body_that_cannot_be_loaded_is_named(world: World) -> None:
    with pytest.raises(LoadError, match=r"nowhere\.urdf: no such file"):
        world.load_urdf("nowhere.urdf", Pose.identity())


def test_a_body_falls_as_gravity_says(world: World) -> None:
    cube = add_cube(world, 0.0, 0.0, 1.0)
    world.step(24)
    seconds = 24 * TIMESTEP
    assert world.speed(cube) == pytest.approx(GRAVITY * seconds, rel=0.01)
    assert world.position(cube)[2] == pytest.approx(1.0 - GRAVITY * seconds**2 / 2, abs=0.003)


def test_only_graspable_bodies_are_objects_and_they_keep_their_order(world: World) -> None:
    world.add_static_box((0.1, 0.1, 0.1), (0.0, 0.0, -0.1), colour=WHITE)
    first, second, third = (add_cube(world, x, 0.0, 0.5) for x in (0.0, 0.2, 0.4))
    world.remove(second)
    assert world.objects == (first, third)


def test_contacts_are_told_from_the_side_of_the_body_that_was_asked_about(world: World) -> None:
    floor = world.add_static_box((0.5, 0.5, 0.05), (0.0, 0.0, -0.05), colour=WHITE)
    cube = add_cube(world, 0.0, 0.0, HALF - 0.002)
    world.find_contacts()
    of_cube, of_floor = world.contacts(cube), world.contacts(floor)
    assert {contact.other for contact in of_cube} == {floor}
    assert {contact.other for contact in of_floor} == {cube}
    # Each position lies on the other body's surface: the floor's top is at 0, the cube's base 2 mm lower.
    assert {round(contact.position[2], 4) for contact in of_cube} == {0.0}
    assert {round(contact.position[2], 4) for contact in of_floor} == {-0.002}
    assert all(contact.distance == pytest.approx(-0.002, abs=1e-4) for contact in of_cube)


def test_distances_are_those_of_the_surfaces(world: World) -> None:
    floor = world.add_static_box((0.5, 0.5, 0.05), (0.0, 0.0, -0.05), colour=WHITE)
    cube = add_cube(world, 0.0, 0.0, HALF + 0.1)
    assert world.distance(cube, floor, limit=0.2) == pytest.approx(0.1, abs=1e-4)
    assert world.distance(cube, floor, limit=0.05) is None


def test_rays_tell_what_they_meet_first_and_where(world: World) -> None:
    """A cube before another one; more rays than Bullet takes at a time."""
    front, _ = add_cube(world, 0.0, 0.0, 0.0), add_cube(world, 0.3, 0.0, 0.0)
    count = 20_000
    beside = np.where(np.arange(count) % 2 == 0, 0.0, 5.0)
    starts, ends = (np.column_stack([np.full(count, x), beside, np.zeros(count)]) for x in (-1.0, 1.0))
    bodies, way = world.first_hits(starts, ends)
    assert set(bodies[::2]) == {front}
    assert set(bodies[1::2]) == {-1}
    np.testing.assert_allclose(-1 + 2 * way[::2], -HALF, atol=2e-3)
    np.testing.assert_allclose(way[1::2], 1.0)


def test_a_remembered_state_comes_back_and_goes_on_alike(world: World) -> None:
    world.add_static_box((0.5, 0.5, 0.05), (0.0, 0.0, -0.05), colour=WHITE)
    cube = add_cube(world, 0.0, 0.0, 0.1)
    world.step(10)
    state, before = world.save(), world.pose(cube).matrix
    world.step(100)
    once = world.pose(cube).matrix
    world.restore(state)
    np.testing.assert_array_equal(world.pose(cube).matrix, before)
    world.step(100)
    np.testing.assert_array_equal(world.pose(cube).matrix, once)
    world.forget(state)


def test_worlds_share_nothing(world: World) -> None:
    with World() as other:
        add_cube(other, 0.0, 0.0, 1.0)
        assert world.objects == ()
    cube = add_cube(world, 0.0, 0.0, 1.0)
    world.step()
    assert world.position(cube)[2] < 1.0


def test_a_body_that_is_put_somewhere_is_at_rest(world: World) -> None:
    cube = add_cube(world, 0.0, 0.0, 1.0)
    world.step(24)
    world.set_pose(cube, (0.3, 0.2, 0.5), UPRIGHT)
    assert world.speed(cube) == 0.0
    np.testing.assert_allclose(world.position(cube), (0.3, 0.2, 0.5), atol=1e-9)


def test_a_closed_world_may_be_closed_again() -> None:
    world = World()
    world.close()
    world.close()


SLOPE = """<robot name="slope"><link name="base"><inertial><mass value="0"/>
<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>
<collision><geometry><box size="2 2 0.1"/></geometry></collision></link></robot>"""


@pytest.mark.parametrize(("friction", "slides"), [(0.2, True), (0.3, True), (0.45, False), (0.9, False)])
@pytest.mark.parametrize("mass", [0.05, 0.5])
def test_an_object_slides_down_a_slope_that_is_steeper_than_its_friction(
    world: World, tmp_path: Path, friction: float, slides: bool, mass: float
) -> None:
    """Whatever its file says, and however heavy it is: the slope's tangent is 0.36."""
    (tmp_path / "slope.urdf").write_text(SLOPE)
    half = np.deg2rad(20) / 2
    tilt = Pose.from_quaternion([0.0, np.sin(half), 0.0, np.cos(half)], np.zeros(3))
    slope = world.load_urdf(tmp_path / "slope.urdf", tilt)
    world.set_dynamics(slope, BASE_LINK, lateralFriction=1.0)
    start = tilt @ Pose(np.eye(3), np.array([0.0, 0.0, 0.05 + 0.0251]))
    cube = world.load_object(CUBE, start, mass=mass, friction=friction)
    world.step(240)
    moved = float(np.linalg.norm(np.subtract(world.position(cube), start.translation)))
    assert (moved > 0.1) == slides
    assert (moved < 0.01) == (not slides)
