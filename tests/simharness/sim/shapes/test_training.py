"""Training shapes are as wide and as thin as they are meant to be, and rough ones differ from round ones."""

from __future__ import annotations

import numpy as np

from simharness.sim.shapes.sets import SETS
from tesnet.geometry import PANDA

TRAINING = SETS["shapes-train"]


def extents(family: str) -> np.ndarray:
    names = [name for name in TRAINING.names() if f"/{family}_" in name]
    return np.array(
        [
            np.sort(np.ptp(np.concatenate([p.vertices for b in TRAINING.make(n).bodies for p in b.parts]), axis=0))
            for n in names
        ]
    )


def test_boxes_and_cylinders_reach_98_percent_of_the_opening_and_no_more() -> None:
    for family in ("box", "cylinder"):
        across = extents(family)[:, 0]
        assert across.max() <= 0.98 * PANDA.max_width * 1.6
        assert np.ptp(across) > 0.04
    assert 0.9 * PANDA.max_width < max(extents("cylinder")[:, 1].max(), extents("box")[:, 0].max())


def test_plates_cards_and_pens_are_thin() -> None:
    assert extents("plate")[:, 0].max() <= 0.014
    assert extents("card")[:, 0].max() <= 0.004
    assert extents("pen")[:, 1].max() <= 0.02
    assert extents("pen")[:, 2].min() >= 0.08


def test_fields_and_sums_are_not_convex() -> None:
    for family in ("field", "sum"):
        rough = 0
        for name in TRAINING.names():
            if f"/{family}_" not in name:
                continue
            parts = [part for body in TRAINING.make(name).bodies for part in body.parts]
            corners = np.concatenate([part.vertices for part in parts])
            apex = parts[0].vertices[0]
            faces = np.stack([part.vertices[1:] for part in parts])
            normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
            normals *= np.sign(np.einsum("fi,fi->f", normals, faces[:, 0] - apex))[:, None]
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            outside = np.einsum("fi,vfi->vf", normals, corners[:, None] - faces[:, 0])
            rough += outside.max() > 0.002
        assert rough >= 30
