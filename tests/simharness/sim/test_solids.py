"""Lofts against the volumes that geometry gives them."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.solids import block, centred, hollow, loft, obj_file, oval, solid, stack

RED = (1.0, 0.0, 0.0)


def test_a_stack_of_growing_circles_is_a_cone() -> None:
    body = stack(oval(), [(0.03, 0.0), (0.01, 0.06)], RED)
    polygon = 32 / 2 * np.sin(2 * np.pi / 32)
    expected = polygon * 0.06 / 3 * (0.03**2 + 0.03 * 0.01 + 0.01**2)
    assert sum(part.volume for part in body.parts) == pytest.approx(expected)
    assert body.shells[0].volume == pytest.approx(expected)


def test_a_profile_that_bends_inwards_is_cut_into_convex_parts() -> None:
    hourglass = stack(oval(), [(0.03, 0.0), (0.01, 0.03), (0.03, 0.06)], RED)
    assert len(hourglass.parts) == 2
    barrel = stack(oval(), [(0.02, 0.0), (0.03, 0.03), (0.02, 0.06)], RED)
    assert len(barrel.parts) == 1


def test_the_parts_of_a_hollow_thing_fill_its_shell() -> None:
    for floor in (None, 0.005):
        body = hollow([(0.03, 0.0), (0.03, 0.05)], 0.004, floor, RED)
        # Each part's inner wall is straight over two sides of the inner circle.
        assert 1.0 < sum(part.volume for part in body.parts) / body.shells[0].volume < 1.1


def test_a_loft_is_turned_outwards_whichever_way_its_rings_run() -> None:
    square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    for ring in (square, square[::-1]):
        assert loft([ring, ring + np.array([0.0, 0.0, 1.0])]).volume == pytest.approx(1.0)


def test_an_object_is_centred_on_its_mass_with_metal_counted_heavier() -> None:
    bodies = [
        solid([block((0.02, 0.02, 0.02), (0.0, 0.0), 0.0)], RED),
        solid([block((0.02, 0.02, 0.02), (0.1, 0.0), 0.0)], RED, 3.0),
    ]
    thing = centred("thing", bodies)
    first, second = (body.parts[0].centroid for body in thing.bodies)
    np.testing.assert_allclose(first, [-0.075, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(second, [0.025, 0.0, 0.0], atol=1e-9)


def test_an_obj_file_numbers_the_corners_of_all_its_groups() -> None:
    cube = block((0.02, 0.02, 0.02), (0.0, 0.0), 0.0)
    lines = obj_file([("a", cube), ("b", cube)]).decode().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o a", "o b"]
    highest = max(int(index) for line in lines if line.startswith("f ") for index in line.split()[1:])
    assert highest == sum(line.startswith("v ") for line in lines)
