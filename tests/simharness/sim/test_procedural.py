"""The generated objects: closed, convex where they say so, standing, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.procedural import FAMILIES, OBJECTS_PER_FAMILY, generate_object, object_names
from simharness.sim.solids import GeneratedObject, Mesh

NAMES = [*object_names("test"), *(name for name in object_names("train") if name.endswith(("_00", "_05")))]


@pytest.fixture(scope="module")
def objects() -> list[GeneratedObject]:
    return [generate_object(name) for name in NAMES]


def parts_of(generated: GeneratedObject) -> list[Mesh]:
    return [part for body in generated.bodies for part in body.parts]


def shells_of(generated: GeneratedObject) -> list[Mesh]:
    return [shell for body in generated.bodies for shell in body.shells]


def corners_of(meshes: list[Mesh]) -> np.ndarray:
    return np.concatenate([mesh.vertices for mesh in meshes])


def test_every_mesh_is_closed_and_turned_outwards(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        for mesh in (*parts_of(generated), *shells_of(generated)):
            starts, ends = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
            edges, back = starts * len(mesh.vertices) + ends, ends * len(mesh.vertices) + starts
            assert len(np.unique(edges)) == len(edges), generated.name
            assert np.array_equal(np.sort(edges), np.sort(back)), generated.name
            assert mesh.volume > 0, generated.name


def test_every_collision_part_is_convex(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        for part in parts_of(generated):
            a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
            normals = np.cross(b - a, c - a)
            lengths = np.linalg.norm(normals, axis=1)
            normals, points = normals[lengths > 1e-12] / lengths[lengths > 1e-12, None], a[lengths > 1e-12]
            outside = np.einsum("fi,vfi->vf", normals, part.vertices[:, None] - points)
            assert outside.max() < 1e-5, generated.name


def test_what_is_seen_is_what_is_touched(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        seen, touched = corners_of(shells_of(generated)), corners_of(parts_of(generated))
        np.testing.assert_allclose(seen.min(axis=0), touched.min(axis=0), atol=1e-3, err_msg=generated.name)
        np.testing.assert_allclose(seen.max(axis=0), touched.max(axis=0), atol=1e-3, err_msg=generated.name)


def test_the_origin_is_the_centre_of_mass(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        weights = [part.volume * body.density for body in generated.bodies for part in body.parts]
        centre = np.average([part.centroid for part in parts_of(generated)], axis=0, weights=weights)
        np.testing.assert_allclose(centre, 0, atol=1e-9, err_msg=generated.name)


def test_an_object_stands_until_it_is_tilted_by_eight_degrees(objects: list[GeneratedObject]) -> None:
    for generated in objects:
        corners = corners_of(parts_of(generated))
        lowest = corners[:, 2].min()
        foot = corners[corners[:, 2] < lowest + 2e-4, :2]
        directions = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        reach = (foot @ np.stack([np.cos(directions), np.sin(directions)])).max(axis=0).min()
        assert np.degrees(np.arctan2(reach, -lowest)) > 8, generated.name


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
