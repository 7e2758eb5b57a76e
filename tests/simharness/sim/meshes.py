"""What tests look at of a made thing: its meshes, and whether they are closed and convex."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from simharness.sim.solids import Array, GeneratedObject, Mesh


def parts_of(generated: GeneratedObject) -> list[Mesh]:
    """What is touched."""
    return [part for body in generated.bodies for part in body.parts]


def shells_of(generated: GeneratedObject) -> list[Mesh]:
    """What is seen."""
    return [shell for body in generated.bodies for shell in body.shells]


def meshes_of(generated: GeneratedObject) -> list[Mesh]:
    return [mesh for body in generated.bodies for mesh in (*body.shells, *body.parts)]


def corners_of(meshes: list[Mesh]) -> Array:
    """(V, 3) vertices of all of them."""
    return np.concatenate([mesh.vertices for mesh in meshes])


def assert_closed_and_turned_outwards(generated: GeneratedObject) -> None:
    for mesh in meshes_of(generated):
        starts, ends = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
        edges, back = starts * len(mesh.vertices) + ends, ends * len(mesh.vertices) + starts
        assert len(np.unique(edges)) == len(edges), generated.name
        assert np.array_equal(np.sort(edges), np.sort(back)), generated.name
        assert mesh.volume > 0, generated.name


def assert_parts_are_convex(generated: GeneratedObject, within: float) -> None:
    """No vertex of a part lies farther than `within` metres outside one of its faces."""
    for part in parts_of(generated):
        a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        normals, points = normals[lengths > 1e-12] / lengths[lengths > 1e-12, None], a[lengths > 1e-12]
        outside = np.einsum("fi,vfi->vf", normals, part.vertices[:, None] - points)
        assert outside.max() < within, generated.name


def assert_stands(generated: GeneratedObject, foot_within: float) -> None:
    """An object stands until it is tilted by eight degrees; what lies so near to its lowest point is its foot."""
    corners = corners_of(parts_of(generated))
    lowest = corners[:, 2].min()
    foot = corners[corners[:, 2] < lowest + foot_within, :2]
    directions = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    reach = (foot @ np.stack([np.cos(directions), np.sin(directions)])).max(axis=0).min()
    assert np.degrees(np.arctan2(reach, -lowest)) > 8, generated.name


def assert_seen_is_touched(generated: GeneratedObject, within: float) -> None:
    """To so many metres, by extents."""
    seen, touched = corners_of(shells_of(generated)), corners_of(parts_of(generated))
    np.testing.assert_allclose(seen.min(axis=0), touched.min(axis=0), atol=within, err_msg=generated.name)
    np.testing.assert_allclose(seen.max(axis=0), touched.max(axis=0), atol=within, err_msg=generated.name)


def assert_centred_on_its_mass(generated: GeneratedObject) -> None:
    weights = [part.volume * body.density for body in generated.bodies for part in body.parts]
    centre = np.average([part.centroid for part in parts_of(generated)], axis=0, weights=weights)
    np.testing.assert_allclose(centre, 0, atol=1e-9, err_msg=generated.name)


def digest_of(objects: Iterable[GeneratedObject]) -> str:
    """SHA-256 of every mesh and convex part, to 10 micrometres."""
    digest = hashlib.sha256()
    for generated in objects:
        digest.update(generated.name.encode())
        for mesh in meshes_of(generated):
            digest.update((np.round(mesh.vertices * 1e5) + 0.0).astype("<f8").tobytes())
            digest.update(mesh.faces.astype("<i8").tobytes())
    return digest.hexdigest()
