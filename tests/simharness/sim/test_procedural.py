"""The generated objects: closed, convex where they say so, standing, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.procedural import FAMILIES, OBJECTS_PER_FAMILY, Split, generate_object, object_names
from simharness.sim.solids import GeneratedObject
from tests.simharness.sim.meshes import (
    assert_centred_on_its_mass,
    assert_closed_and_turned_outwards,
    assert_parts_are_convex,
    assert_seen_is_touched,
    assert_stands,
    corners_of,
    digest_of,
    parts_of,
    shells_of,
)

NAMES = [*object_names("test"), *(name for name in object_names("train") if name.endswith(("_00", "_05")))]


DIGESTS: dict[Split, str] = {
    "test": "e04025135717dd6c092b356ecefb355a6000d09299af03724c2745f2f25f1fb2",
    "train": "91a3ef8803f7ebc5c2afa4554e04b4ebb22de8c6fc12dc318889b28a37e4d164",
}
"""Labels and rates are useless without their objects."""


@pytest.mark.parametrize("split", DIGESTS)
def test_objects_are_those_that_labels_and_rates_were_made_with(split: Split) -> None:
    assert digest_of(map(generate_object, object_names(split))) == DIGESTS[split]


@pytest.fixture(scope="module")
def objects() -> list[GeneratedObject]:
    return [generate_object(name) for name in NAMES]


def test_every_mesh_is_closed_and_turned_outwards(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        assert_closed_and_turned_outwards(generated)


def test_every_collision_part_is_convex(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        assert_parts_are_convex(generated, within=1e-5)


def test_what_is_seen_is_what_is_touched(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        assert_seen_is_touched(generated, within=1e-3)


def test_the_origin_is_the_centre_of_mass(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        assert_centred_on_its_mass(generated)


def test_an_object_stands_until_it_is_tilted_by_eight_degrees(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        assert_stands(generated, foot_within=2e-4)


def test_sizes_are_those_of_household_objects(objects: list[GeneratedObject]) -> None:
    extents = np.array([np.ptp(corners_of(shells_of(generated)), axis=0) for generated in objects])
    assert extents[:, 2].min() >= 0.018
    assert extents[:, 2].max() <= 0.2
    across = extents[:, :2].min(axis=1)
    assert across.min() >= 0.02
    assert np.mean(across <= 0.07) > 0.8, "most objects must fit into a hand that opens 0.08 m"


def test_a_vessel_is_hollow() -> None:
    for family in ("cup", "mug", "bowl", "tube"):
        parts = parts_of(generate_object(f"procedural/test/{family}_00"))
        corners = corners_of(parts)
        x, y = (
            (corners.min(axis=0) + corners.max(axis=0))[:2] / 2
            if family != "mug"
            else (corners[:, 0].min() + 0.03, 0.0)
        )
        above_floor = np.array([x, y, corners[:, 2].max() - 0.005])
        for part in parts:
            a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
            normals = np.cross(b - a, c - a)
            assert np.einsum("fi,fi->f", normals, above_floor - a).max() > 0, f"the inside of {family} is filled"


@pytest.mark.parametrize("name", NAMES[::7])
def test_a_name_always_gives_the_same_bytes(name: str) -> None:
    assert generate_object(name).files() == generate_object(name).files()


def test_a_urdf_refers_to_the_files_beside_it_and_comes_last(objects: list[GeneratedObject]) -> None:
    for generated in objects[::5]:
        files = generated.files()
        urdf = files["object.urdf"].decode()
        assert list(files)[-1] == "object.urdf"
        assert all(f'filename="{name}"' in urdf for name in files if name.endswith(".obj"))
        assert files["collision.obj"].decode().count("o part_") == len(parts_of(generated))
        assert urdf.count("rgba") == len(generated.bodies)


def test_no_training_object_is_a_test_object() -> None:
    test, train = object_names("test"), object_names("train")
    assert not set(test) & set(train)
    assert len(test) == len(FAMILIES) * OBJECTS_PER_FAMILY["test"] >= 40
    assert len(train) == len(FAMILIES) * OBJECTS_PER_FAMILY["train"] >= 200
    shapes = [generate_object(name).files()["collision.obj"] for name in (*test, *train[::5])]
    assert len(set(shapes)) == len(shapes)
