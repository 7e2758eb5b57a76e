"""Elements are closed, convex and where they are said to be."""

from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.shapes.elements import ball, blob, rod, star, tube, turned
from simharness.sim.solids import Mesh


def closed(mesh: Mesh) -> bool:
    starts, ends = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    count = len(mesh.vertices)
    return bool(np.array_equal(np.sort(starts * count + ends), np.sort(ends * count + starts)) and mesh.volume > 0)


def test_a_rod_has_the_volume_of_its_prism_in_any_direction() -> None:
    for end in ([0.1, 0.0, 0.0], [0.0, 0.0, -0.1], [0.03, -0.05, 0.02]):
        bar = rod([0.0, 0.0, 0.0], end, (0.01, 0.01), corners=6)
        assert closed(bar)
        assert bar.volume == pytest.approx(3 * np.sqrt(3) / 2 * 0.01**2 * np.linalg.norm(end))
        np.testing.assert_allclose(bar.centroid, np.array(end) / 2, atol=1e-9)


def test_a_closed_tube_has_the_volume_of_a_torus() -> None:
    angles = 2 * np.pi * np.arange(60) / 60
    path = np.column_stack([0.03 * np.cos(angles), 0.03 * np.sin(angles), np.zeros(60)])
    parts = tube(path, np.full(60, 0.005), closed=True)
    assert len(parts) == 60
    assert all(closed(part) for part in parts)
    octagon = 2 * np.sqrt(2) / np.pi  # of the circle's area
    assert sum(part.volume for part in parts) == pytest.approx(2 * np.pi**2 * 0.03 * 0.005**2 * octagon, rel=0.01)


def test_a_star_fills_its_outline_and_its_parts_are_convex() -> None:
    angles = np.pi * np.arange(10) / 5
    radii = np.where(np.arange(10) % 2 == 0, 0.04, 0.015)
    outline = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    parts = star(outline, [(1.0, 0.0), (1.0, 0.02)])
    x, y = outline.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert sum(part.volume for part in parts) == pytest.approx(area * 0.02)
    assert all(closed(part) for part in parts)


def test_a_ball_of_80_faces_is_nearly_as_large_as_the_sphere_around_it() -> None:
    sphere = ball(0.02, (0.1, 0.0, 0.0))
    assert sphere.faces.shape == (80, 3)
    assert closed(sphere)
    assert 0.85 < sphere.volume / (4 / 3 * np.pi * 0.02**3) < 1.0
    np.testing.assert_allclose(sphere.centroid, [0.1, 0.0, 0.0], atol=1e-9)


def test_a_blob_has_its_radius_in_every_direction_and_a_flat_foot() -> None:
    parts = blob(lambda directions: 0.03 + 0.01 * directions[:, 0], floor=0.02)
    assert len(parts) == 80
    assert all(closed(part) for part in parts)
    corners = np.unique(np.concatenate([part.vertices for part in parts]).round(9), axis=0)
    assert corners[:, 2].min() == pytest.approx(-0.02, abs=1e-9)
    assert np.isclose(corners[:, 2], -0.02).sum() >= 6
    free = corners[(corners[:, 2] > -0.0199) & (np.abs(corners).sum(axis=1) > 0)]
    lengths = np.linalg.norm(free, axis=1)
    np.testing.assert_allclose(lengths, 0.03 + 0.01 * free[:, 0] / lengths, atol=1e-9)


def test_turning_keeps_the_shape() -> None:
    bar = rod([0.0, 0.0, 0.0], [0.05, 0.0, 0.0], (0.01, 0.005))
    assert turned(bar, 1.0, (0.1, 0.2, 0.3)).volume == pytest.approx(bar.volume)
