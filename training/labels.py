"""Labelled views on disk: one .npz a scene, with all that is needed to render its views again. Knows no simulator."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tesnet.candidates import Candidates, grasp_poses
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Pose

OUTCOMES = ("success", "pregrasp", "approach", "slip", "drop")
"""Codes of the stored outcomes, by position."""


class LabelsError(Exception):
    """A folder or file of labels that cannot be used; the message says why and what to do."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelledView:
    """A prepared cloud and the outcomes of C of its candidates under the `strict` executor.

    Args:
        cloud: in its canonical frame.
        approach, contact: (C,) indices into the cloud.
        outcomes: (C,) codes into `OUTCOMES`.
        collision_free: (C,) whether the observed cloud left the hand's way free: such candidates the service scores.
        scene: kind of the scene, `packed` or `pile`.
    """

    cloud: PreparedCloud
    approach: torch.Tensor
    contact: torch.Tensor
    outcomes: torch.Tensor
    collision_free: torch.Tensor
    scene: str

    @property
    def success(self) -> torch.Tensor:
        """(C,) bool."""
        return self.outcomes == 0

    def candidates(self, which: torch.Tensor) -> Candidates:
        """The candidates at indices (K,), with their poses."""
        approach, contact = self.approach[which], self.contact[which]
        points = self.cloud.points
        return Candidates(
            approach, contact, grasp_poses(points[approach], points[contact], self.cloud.normals[contact])
        )


def save_scene(
    path: Path, description: Mapping[str, Any], views: Sequence[LabelledView], counts: NDArray[np.int64]
) -> None:
    """Writes one scene atomically: coordinates as float16 (0.06 mm at 0.1 m), indices as uint16, outcomes as bytes."""
    arrays: dict[str, NDArray[Any]] = {
        "description": np.frombuffer(json.dumps(description).encode(), dtype=np.uint8),
        "counts": counts,
    }
    for number, view in enumerate(views):
        cloud = view.cloud
        frame = {
            "viewpoints": cloud.viewpoints.tolist(),
            "up": None if cloud.up is None else cloud.up.tolist(),
            "support_height": cloud.support_height,
            "T_cloud_canonical": cloud.T_cloud_canonical.matrix.tolist(),
            "scene": view.scene,
        }
        arrays |= {
            f"{number}/frame": np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8),
            f"{number}/points": cloud.points.numpy().astype(np.float16),
            f"{number}/normals": cloud.normals.numpy().astype(np.float16),
            f"{number}/spectrum": cloud.spectrum.numpy().astype(np.float16),
            f"{number}/neighbours": cloud.neighbours.numpy().astype(np.uint16),
            f"{number}/approach": view.approach.numpy().astype(np.uint16),
            f"{number}/contact": view.contact.numpy().astype(np.uint16),
            f"{number}/outcomes": view.outcomes.numpy().astype(np.uint8),
            f"{number}/collision_free": view.collision_free.numpy(),
        }
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    temporary.replace(path)


def load_scene(path: Path) -> tuple[dict[str, Any], list[LabelledView]]:
    """The description and the views of a scene written by `save_scene`.

    Raises:
        LabelsError: not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        description = json.loads(arrays["description"].tobytes())
        count = sum(name.endswith("/frame") for name in arrays)
        return description, [_view(arrays, number) for number in range(count)]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise LabelsError(f"{path} holds no labelled scene ({error}); remove it and generate again") from error


def _view(arrays: Mapping[str, NDArray[Any]], number: int) -> LabelledView:
    frame = json.loads(arrays[f"{number}/frame"].tobytes())

    def tensor(name: str, dtype: torch.dtype) -> torch.Tensor:
        array = arrays[f"{number}/{name}"]
        return torch.from_numpy(array.astype(np.int64) if array.dtype == np.uint16 else array).to(dtype)

    points = tensor("points", torch.float32)
    viewpoints = torch.tensor(frame["viewpoints"])
    normals = torch.nn.functional.normalize(tensor("normals", torch.float32), dim=1)
    directions = torch.nn.functional.normalize(viewpoints[None] - points[:, None], dim=2)
    best = (directions * normals[:, None]).sum(dim=2).argmax(dim=1)
    cloud = PreparedCloud(
        points=points,
        normals=normals,
        neighbours=tensor("neighbours", torch.long),
        spectrum=tensor("spectrum", torch.float32),
        view_directions=directions[torch.arange(len(points)), best],
        viewpoints=viewpoints,
        up=None if frame["up"] is None else torch.tensor(frame["up"]),
        support_height=frame["support_height"],
        T_cloud_canonical=Pose.from_matrix(frame["T_cloud_canonical"]),
    )
    return LabelledView(
        cloud=cloud,
        approach=tensor("approach", torch.long),
        contact=tensor("contact", torch.long),
        outcomes=tensor("outcomes", torch.uint8),
        collision_free=tensor("collision_free", torch.bool),
        scene=frame["scene"],
    )


def scene_files(folders: Sequence[Path]) -> list[Path]:
    """The scene files under the folders, sorted.

    Raises:
        LabelsError: a folder that does not exist or holds none.
    """
    found: list[Path] = []
    for folder in folders:
        files = sorted(folder.rglob("scene_*.npz"))
        if not files:
            raise LabelsError(f"{folder} holds no scene_*.npz; make some with `python -m training generate`")
        found += files
    return found


def load_views(folders: Sequence[Path]) -> Iterator[LabelledView]:
    """Every labelled view under the folders, scene by scene."""
    for path in scene_files(folders):
        yield from load_scene(path)[1]
