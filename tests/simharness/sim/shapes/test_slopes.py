"""Leaning faces lean: few of a thing's faces have another one that is parallel to them."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.shapes.sets import SETS
from simharness.sim.solids import GeneratedObject, Mesh
from tests.simharness.sim.meshes import corners_of, parts_of


def of(family: str, made: dict[str, list[GeneratedObject]]) -> list[GeneratedObject]:
    return [one for one in made["slopes-train"] if f"/{family}_" in one.name]


def share_of_parallel_area(mesh: Mesh) -> float:
    """Of a mesh's surface, the part that faces a part of it within 10 degrees of parallel."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals[areas > 1e-9] / areas[areas > 1e-9, None]
    areas = areas[areas > 1e-9]
    return float(areas[(normals @ normals.T < -np.cos(np.radians(10))).any(axis=1)].sum() / areas.sum())


@pytest.mark.parametrize(("family", "most"), [("wedge", 0.45), ("shard", 0.45), ("rock", 0.75)])
def test_few_faces_of_a_thing_are_parallel(family: str, most: float, made: dict[str, list[GeneratedObject]]) -> None:
    shares = [share_of_parallel_area(part) for one in of(family, made) for part in parts_of(one)]
    assert len(shares) == 60
    assert np.mean(shares) < most
    (block,) = parts_of(SETS["shapes-train"].make("shapes-train-1/box_00"))
    assert share_of_parallel_area(block) > 0.9


def test_no_thing_leaves_the_workspace_and_the_parts_of_each_lie_on_another(
    made: dict[str, list[GeneratedObject]],
) -> None:
    for one in made["slopes-train"]:
        assert np.ptp(corners_of(parts_of(one)), axis=0).max() < 0.2, one.name
    for family in ("bundle", "elbow", "horn", "knuckle", "ridge", "sail", "twist", "vane"):
        for one in of(family, made):
            boxes = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in parts_of(one)])
            low, high = boxes[1:, 0], boxes[1:, 1]
            in_a_row = family in ("horn", "knuckle", "twist")
            before = boxes[:-1] if in_a_row else boxes[:1]
            assert ((low <= before[:, 1]) & (before[:, 0] <= high)).all(), one.name
