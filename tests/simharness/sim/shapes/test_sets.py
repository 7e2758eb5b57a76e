"""Made shapes: closed, convex where they say so, standing, of the sizes that their sets promise, the same for ever."""

from __future__ import annotations

import pytest

from simharness.sim.objects import load_object_set
from simharness.sim.shapes.sets import SETS
from simharness.sim.solids import GeneratedObject
from tests.simharness.sim.meshes import (
    assert_centred_on_its_mass,
    assert_closed_and_turned_outwards,
    assert_parts_are_convex,
    assert_seen_is_touched,
    assert_stands,
    digest_of,
)

VALIDATION = ("flat", "novel", "wide")

SHAPES = {
    "extremes-train": "b44940bb317964a8bfa2f8e7c1bff9ce963f5f8add2f7b87921cfee3da77cfa4",
    "flat": "a84d34ec9962dd4e1f405fbdeba9b4ff4eb7288ba343dd02b909aade362ea946",
    "novel": "f2cae092dad01637c439ce2b235add4c39b29fdf823b41569ce5710e0d244a82",
    "shapes-train": "fd77141c40341fe44ce3c594d91219f2084e9c0dd9d3e284aa96c8268e8805c2",
    "slopes-train": "dfdbd7b020d647d941194e7f997c5cd6a5187822e4b04318e47caaa74bb928f6",
    "wide": "f10e5d6d368b574dc3602658bd3291cbce53c9c1d8f75ddff32401067771c7a9",
}
"""A change needs another version in the names."""


@pytest.mark.parametrize("name", SETS)
def test_every_mesh_is_closed_and_turned_outwards(name: str, made: dict[str, list[GeneratedObject]]) -> None:
    for generated in made[name]:
        assert_closed_and_turned_outwards(generated)


@pytest.mark.parametrize("name", SETS)
def test_every_part_is_convex_to_a_third_of_a_millimetre(name: str, made: dict[str, list[GeneratedObject]]) -> None:
    for generated in made[name]:
        assert_parts_are_convex(generated, within=3e-4)


@pytest.mark.parametrize("name", SETS)
def test_what_is_seen_is_what_is_touched_and_the_origin_is_the_centre_of_mass(
    name: str, made: dict[str, list[GeneratedObject]]
) -> None:
    for generated in made[name]:
        assert_seen_is_touched(generated, within=1e-6)
        assert_centred_on_its_mass(generated)


@pytest.mark.parametrize("name", VALIDATION)
def test_a_shape_stands_until_it_is_tilted_by_eight_degrees(name: str, made: dict[str, list[GeneratedObject]]) -> None:
    for generated in made[name]:
        assert_stands(generated, foot_within=3e-4)


@pytest.mark.parametrize("name", SETS)
def test_names_say_set_version_family_and_seed_and_give_one_shape_each(name: str) -> None:
    shapes = SETS[name]
    first = shapes.names()[0]
    assert first == f"{name}-{shapes.version}/{min(shapes.families)}_00"
    assert shapes.make(first).files() == shapes.make(first).files()
    assert len({shapes.make(shape).files()["collision.obj"] for shape in shapes.names()}) == len(shapes.names())


@pytest.mark.parametrize("name", SETS)
def test_shapes_are_those_that_labels_and_rates_were_made_with(
    name: str, made: dict[str, list[GeneratedObject]]
) -> None:
    assert digest_of(made[name]) == SHAPES[name]


def test_a_set_loads_for_both_scenes(tmp_path_factory: pytest.TempPathFactory) -> None:
    cache = tmp_path_factory.mktemp("cache")
    for kind in ("packed", "pile"):
        models = load_object_set("flat", kind, cache_dir=cache)
        assert [model.name for model in models] == sorted(SETS["flat"].names())
        assert all(model.sized for model in models)
