"""Labelled views on disk: one .npz a scene, with all that is needed to render its views again. Knows no simulator."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from simharness.sim.outcomes import OUTCOME_KINDS
from tesnet.candidates import Candidates, poses_along
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.geometry import Gripper, Pose
from tesnet.hands import HANDS
from tesnet.orientation import orient
from tesnet.whole_file import whole_file

_TODAY = PreparationConfig()
_ROUNDING = 1e-5
"""Metres."""


class LabelsError(Exception):
    """A folder or file of labels that cannot be used; the message says why and what to do."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelledView:
    """A prepared cloud and the outcomes of C of its candidates under the `strict` executor.

    Args:
        cloud: in its canonical frame.
        pairs: (C, 4, 3) approach point, contact point, and directions of closing and travel of each candidate.
        widths: (C,) metres between the fingers as they arrived.
        approach, contact: (C,) the points of the cloud nearest to those of the pairs: where the cloud was rendered
            again, no point lies just there.
        outcomes: (C,) codes into `OUTCOME_KINDS`.
        collision_free: (C,) whether the observed cloud left the hand's way free: such candidates the service scores.
        scene: kind of the scene, `packed` or `pile`.
        gripper: name of the hand that tried them.
        sensor: name of the model of the camera's errors; None for the camera's own.
    """

    cloud: PreparedCloud
    pairs: torch.Tensor
    widths: torch.Tensor
    approach: torch.Tensor
    contact: torch.Tensor
    outcomes: torch.Tensor
    collision_free: torch.Tensor
    scene: str
    gripper: str = "franka"
    sensor: str | None = None

    @property
    def candidates(self) -> Candidates:
        """The candidates with the poses that were tried."""
        hand = HANDS[self.gripper].gripper
        poses = poses_along(*self.pairs.unbind(dim=1), hand=hand, widths=self.widths)
        return Candidates(self.approach, self.contact, poses, self.widths, hand)

    @property
    def success(self) -> torch.Tensor:
        """(C,) bool."""
        return self.outcomes == OUTCOME_KINDS.index("success")


def count_outcomes(outcomes: Iterable[NDArray[np.uint8]]) -> NDArray[np.int64]:
    """How often each of `OUTCOME_KINDS` stands in arrays of their codes."""
    counts = np.zeros(len(OUTCOME_KINDS), dtype=np.int64)
    for codes in outcomes:
        counts += np.bincount(codes, minlength=len(OUTCOME_KINDS))
    return counts


def save_scene(
    path: Path,
    description: Mapping[str, Any],
    views: Sequence[LabelledView],
    preparation: PreparationConfig = _TODAY,
) -> None:
    """Writes one scene, whole: the cloud as float16 (0.06 mm at 0.1 m), indices as uint16, outcomes as bytes.

    Args:
        path: of the file.
        description: of the scene, JSON values.
        views: of the scene.
        preparation: of the views' clouds; the file names it.
    """
    described = {**description, "preparation": asdict(preparation)}
    arrays: dict[str, NDArray[Any]] = {
        "description": np.frombuffer(json.dumps(described).encode(), dtype=np.uint8),
        "counts": count_outcomes(view.outcomes.numpy() for view in views),
    }
    for number, view in enumerate(views):
        cloud = view.cloud
        frame = {
            "viewpoints": cloud.viewpoints.tolist(),
            "up": None if cloud.up is None else cloud.up.tolist(),
            "support_height": cloud.support_height,
            "sides": cloud.sides.tolist(),
            "T_cloud_canonical": cloud.T_cloud_canonical.matrix.tolist(),
            "scene": view.scene,
            "gripper": view.gripper,
            "sensor": view.sensor,
        }
        arrays |= {
            f"{number}/frame": np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8),
            f"{number}/points": cloud.points.numpy().astype(np.float16),
            f"{number}/normals": cloud.normals.numpy().astype(np.float16),
            f"{number}/spectrum": cloud.spectrum.numpy().astype(np.float16),
            f"{number}/neighbours": cloud.neighbours.numpy().astype(np.uint16),
            f"{number}/approach": view.approach.numpy().astype(np.uint16),
            f"{number}/contact": view.contact.numpy().astype(np.uint16),
            f"{number}/pairs": view.pairs.numpy(),
            f"{number}/widths": view.widths.numpy(),
            f"{number}/outcomes": view.outcomes.numpy().astype(np.uint8),
            f"{number}/collision_free": view.collision_free.numpy(),
        }
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def pairs_of(cloud: PreparedCloud, candidates: Candidates, hand: Gripper) -> torch.Tensor:
    """(C, 4, 3) approach points, contact points and directions of closing and travel of a hand's candidates on a cloud.

    Where the hand stands beside its approach point along the closing direction, this is moved as far; where it stops
    short of its usual depth past the contact point, this stands as much less deep.
    """
    _, closing, travel = candidates.Ts_canonical_grasp[:, :3, :3].unbind(dim=2)
    approach, contact = cloud.points[candidates.approach], cloud.points[candidates.contact]
    beside = (candidates.Ts_canonical_grasp[:, :3, 3] - approach) * closing
    approach = approach + beside.sum(dim=1, keepdim=True) * closing
    usual = poses_along(approach, contact, closing, travel, hand=hand, widths=candidates.widths)
    short = ((usual - candidates.Ts_canonical_grasp)[:, :3, 3] * travel).sum(dim=1, keepdim=True)
    contact = torch.where(short > _ROUNDING, contact - short * travel, contact)
    return torch.stack([approach, contact, closing, travel], dim=1)


def load_scene(path: Path) -> tuple[dict[str, Any], list[LabelledView]]:
    """The description and the views of a scene written by `save_scene`.

    Raises:
        LabelsError: not such a file.
    """
    try:
        # Opened here because numpy leaves a damaged file open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = dict(stored)
        description = json.loads(arrays["description"].tobytes())
        count = sum(name.endswith("/frame") for name in arrays)
        return description, [_view(arrays, number) for number in range(count)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise LabelsError(f"{path} holds no labelled scene ({error}); remove it and generate again") from error


def _view(arrays: Mapping[str, NDArray[Any]], number: int) -> LabelledView:
    frame = json.loads(arrays[f"{number}/frame"].tobytes())
    gripper = frame.get("gripper", "franka")
    if arrays[f"{number}/pairs"].shape[1:] != (4, 3):
        raise ValueError("its pairs have no directions of travel")

    def tensor(name: str, dtype: torch.dtype) -> torch.Tensor:
        array = arrays[f"{number}/{name}"]
        return torch.from_numpy(array.astype(np.int64) if array.dtype == np.uint16 else array).to(dtype)

    points = tensor("points", torch.float32)
    viewpoints = torch.tensor(frame["viewpoints"])
    normals = torch.nn.functional.normalize(tensor("normals", torch.float32), dim=1)
    neighbours = tensor("neighbours", torch.long)
    normals, view_directions = orient(points, normals, neighbours, viewpoints)
    cloud = PreparedCloud(
        points=points,
        normals=normals,
        neighbours=neighbours,
        spectrum=tensor("spectrum", torch.float32),
        view_directions=view_directions,
        viewpoints=viewpoints,
        up=None if frame["up"] is None else torch.tensor(frame["up"]),
        support_height=frame["support_height"],
        sides=torch.tensor(frame["sides"]).reshape(-1, 4),
        T_cloud_canonical=Pose.from_matrix(frame["T_cloud_canonical"]),
    )
    return LabelledView(
        cloud=cloud,
        pairs=tensor("pairs", torch.float32),
        widths=_widths(arrays, number, gripper),
        approach=tensor("approach", torch.long),
        contact=tensor("contact", torch.long),
        outcomes=tensor("outcomes", torch.uint8),
        collision_free=tensor("collision_free", torch.bool),
        scene=frame["scene"],
        gripper=gripper,
        sensor=frame.get("sensor"),
    )


def _widths(arrays: Mapping[str, NDArray[Any]], number: int, gripper: str) -> torch.Tensor:
    """Those of a view; hands were wide open before files told them."""
    if f"{number}/widths" in arrays:
        return torch.from_numpy(arrays[f"{number}/widths"])
    return torch.full((len(arrays[f"{number}/outcomes"]),), HANDS[gripper].gripper.max_width)


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


def load_views(folders: Sequence[Path], preparation: PreparationConfig) -> Iterator[LabelledView]:
    """Every labelled view under the folders, scene by scene.

    Raises:
        LabelsError: no scenes, or clouds that were prepared in another way.
    """
    for path in scene_files(folders):
        description, views = load_scene(path)
        check_preparation(path, description, preparation)
        yield from views


def check_preparation(path: Path, description: Mapping[str, Any], wanted: PreparationConfig) -> None:
    """Raises LabelsError unless the clouds of a scene file were prepared as wanted."""
    found = description.get("preparation", {})
    different = [
        f"{name} is {found.get(name)}, not {value}"
        for name, value in asdict(wanted).items()
        if found.get(name) != value
    ]
    if different:
        raise LabelsError(
            f"the clouds of {path} were prepared for another network ({'; '.join(different)}); "
            "render an archive of their labels for this one with `python -m training unpack --model NAME`"
        )
