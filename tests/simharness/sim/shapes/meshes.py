"""What tests look at of a made shape."""

from __future__ import annotations

import numpy as np

from simharness.sim.solids import Array, GeneratedObject, Mesh


def parts_of(generated: GeneratedObject) -> list[Mesh]:
    return [part for body in generated.bodies for part in body.parts]


def meshes_of(generated: GeneratedObject) -> list[Mesh]:
    return [mesh for body in generated.bodies for mesh in (*body.shells, *body.parts)]


def corners_of(generated: GeneratedObject) -> Array:
    return np.concatenate([part.vertices for part in parts_of(generated)])
