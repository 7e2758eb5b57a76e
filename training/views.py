"""Labelled views on disk: one .npz a scene, with all that is needed to render its views again. Knows no simulator."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from simharness.sim.outcome_kinds import OUTCOME_KINDS
from tesnet.candidates import Candidates, poses_along
from tesnet.cloud import PreparationConfig, PreparedCloud
from tesnet.geometry import PANDA, Gripper, Pose
from tesnet.hands import HANDS
from tesnet.orientation import orient
from tesnet.whole_file import whole_file

_TODAY = PreparationConfig()


class LabelsError(Exception):
    """A folder or file of labels that cannot be used; the message says why and what to do."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelledView:
    """A prepared cloud and the outcomes of C of its candidates under the `strict` executor.

    Args:
        cloud: in its canonical frame.
        poses: (C, 4, 4) T_canonical_grasp of each candidate, as it was tried.
        widths: (C,) how far the hand was open then, metres.
        approach, contact: (C,) indices of the pair: where the cloud was rendered again, of its points nearest to those
            that the pair had.
        outcomes: (C,) codes into `OUTCOME_KINDS`.
        collision_free: (C,) whether the observed cloud left the hand's way free: such candidates the service scores.
        scene: kind of the scene, `packed` or `pile`.
        gripper: the hand that tried them.
        sensor: name of the model of the camera's errors; None for the camera's own.
    """

    cloud: PreparedCloud
    poses: torch.Tensor
    widths: torch.Tensor
    approach: torch.Tensor
    contact: torch.Tensor
    outcomes: torch.Tensor
    collision_free: torch.Tensor
    scene: str
    gripper: Gripper = PANDA
    sensor: str | None = None

    @property
    def candidates(self) -> Candidates:
        """The candidates as they were tried."""
        return Candidates(self.approach, self.contact, self.poses, self.widths, self.gripper)

    def only(self, which: torch.Tensor) -> LabelledView:
        """The view with the candidates at the indices (K,), or where the mask (C,) is true."""
        return replace(
            self,
            poses=self.poses[which],
            widths=self.widths[which],
            approach=self.approach[which],
            contact=self.contact[which],
            outcomes=self.outcomes[which],
            collision_free=self.collision_free[which],
        )

    @property
    def success(self) -> torch.Tensor:
        """(C,) bool."""
        return self.outcomes == OUTCOME_KINDS.index("success")


_OfTensors = TypeVar("_OfTensors", PreparedCloud, Candidates)


def moved(what: _OfTensors, device: torch.device) -> _OfTensors:
    """The cloud or candidates with their tensors on a device."""
    values: dict[str, Any] = {field.name: getattr(what, field.name) for field in fields(what)}
    tensors: dict[str, Any] = {
        name: value.to(device) for name, value in values.items() if isinstance(value, torch.Tensor)
    }
    return replace(what, **tensors)


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
            "pose_in_doubt": cloud.pose_in_doubt,
            "T_cloud_canonical": cloud.T_cloud_canonical.matrix.tolist(),
            "scene": view.scene,
            "gripper": gripper_values(view.gripper),
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
            f"{number}/poses": view.poses[:, :3].numpy(),
            f"{number}/widths": view.widths.numpy(),
            f"{number}/outcomes": view.outcomes.numpy().astype(np.uint8),
            f"{number}/collision_free": view.collision_free.numpy(),
        }
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


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
        return description, [_view(arrays, number) for number in range(_count_views(arrays))]
    except _DAMAGE as error:
        raise _damaged(path, error) from error


_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def _damaged(path: Path, error: Exception) -> LabelsError:
    return LabelsError(f"{path} holds no labelled scene ({error}); remove it and generate again")


def _count_views(names: Iterable[str]) -> int:
    return sum(name.endswith("/frame") for name in names)


def _view(arrays: Mapping[str, NDArray[Any]], number: int) -> LabelledView:
    frame = json.loads(arrays[f"{number}/frame"].tobytes())
    gripper = gripper_of(frame.get("gripper", "franka"))

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
        pose_in_doubt=frame.get("pose_in_doubt", False),  # files of before 0.6.8 do not say
    )
    if f"{number}/poses" in arrays:
        poses, widths = _whole(tensor("poses", torch.float32)), tensor("widths", torch.float32)
    else:
        poses = _poses_of_pairs(tensor("pairs", torch.float32), gripper)
        widths = torch.full((len(poses),), gripper.max_width)
    return LabelledView(
        cloud=cloud,
        poses=poses,
        widths=widths,
        approach=tensor("approach", torch.long),
        contact=tensor("contact", torch.long),
        outcomes=tensor("outcomes", torch.uint8),
        collision_free=tensor("collision_free", torch.bool),
        scene=frame["scene"],
        gripper=gripper,
        sensor=frame.get("sensor"),
    )


def _whole(rows: torch.Tensor) -> torch.Tensor:
    """Poses (C, 4, 4) of their upper three rows (C, 3, 4)."""
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rows.dtype).expand(len(rows), 1, 4)
    return torch.cat([rows, last], dim=1)


def _poses_of_pairs(pairs: torch.Tensor, gripper: Gripper) -> torch.Tensor:
    """Poses of the wide open hand in files that hold pairs instead of poses.

    Args:
        pairs: (C, 4, 3) approach point, contact point, and directions of closing and travel.
        gripper: the hand.
    """
    if pairs.shape[1:] != (4, 3):
        raise ValueError("its pairs have no directions of travel")
    return poses_along(*pairs.unbind(dim=1), hand=gripper)


def gripper_values(gripper: Gripper) -> dict[str, Any]:
    """A hand as plain JSON values."""
    return {**gripper.sizes(), "name": gripper.name}


def gripper_of(values: str | Mapping[str, Any]) -> Gripper:
    """The hand that `gripper_values` described, or that has a name."""
    return HANDS[values].gripper if isinstance(values, str) else Gripper(**values)


def number_of(path: Path) -> int:
    """The number in the name of a file `STEM_NUMBER.npz`, of a scene or of a part of an archive."""
    return int(path.stem.rpartition("_")[2])


def fold_of(path: Path, count: int) -> int:
    """The index, from 0, of the one of so many folds that holds the scene of a file: scenes go round them by number."""
    return number_of(path) % count


@dataclass(frozen=True, slots=True)
class Fold:
    """Scenes that a network is trained without, so that its answers about them are those about any others.

    Args:
        index: of this fold, from 0.
        count: of all (`fold_of`).
    """

    index: int
    count: int

    def holds(self, path: Path) -> bool:
        """Whether the scene of a file is in it."""
        return fold_of(path, self.count) == self.index

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


def scene_files(folders: Sequence[Path], leave_out: Fold | None = None) -> list[Path]:
    """The scene files under the folders, sorted, without those of a fold.

    Raises:
        LabelsError: a folder that does not exist or holds none.
    """
    found: list[Path] = []
    for folder in folders:
        files = sorted(folder.rglob("scene_*.npz"))
        if not files:
            raise LabelsError(f"{folder} holds no scene_*.npz; make some with `python -m training generate`")
        found += [file for file in files if leave_out is None or not leave_out.holds(file)]
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


class StoredViews:
    """Labelled views that lie in scene files; each is read anew whenever it is asked for, so any number has room.

    Reading one takes some milliseconds, where a step of training with it takes a hundred.

    Args:
        folders: of scene files.
        preparation: that their clouds must have.
        wanted: which views there shall be, by whether their candidates succeed, (C,) bool.
        leave_out: scenes that are left out.

    Raises:
        LabelsError: no scenes, or clouds that were prepared in another way; later, a file that was damaged since.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        preparation: PreparationConfig,
        wanted: Callable[[NDArray[np.bool_]], bool],
        leave_out: Fold | None = None,
    ) -> None:
        self.labels, self.successes = 0, 0
        self._places: list[tuple[Path, int]] = []
        for path in scene_files(folders, leave_out):
            for number, success in enumerate(_successes(path, preparation)):
                if wanted(success):
                    self._places.append((path, number))
                    self.labels += len(success)
                    self.successes += int(success.sum())

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> LabelledView:
        """The view at an index."""
        path, number = self._places[index]
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                return _view(stored, number)
        except _DAMAGE as error:
            raise _damaged(path, error) from error


def _successes(path: Path, preparation: PreparationConfig) -> list[NDArray[np.bool_]]:
    """Which candidates of each view of a scene succeed (C,), without reading the clouds."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            description = json.loads(stored["description"].tobytes())
            outcomes = [stored[f"{number}/outcomes"] for number in range(_count_views(stored.files))]
    except _DAMAGE as error:
        raise _damaged(path, error) from error
    check_preparation(path, description, preparation)
    return [codes == OUTCOME_KINDS.index("success") for codes in outcomes]


def check_preparation(path: Path, description: Mapping[str, Any], wanted: PreparationConfig) -> None:
    """Raises LabelsError unless the clouds of a scene file were prepared as wanted.

    Clouds that were not to be smoothed stand for those of a network that smooths noisy ones: the protocol's are quiet.
    """
    found = description.get("preparation", {})
    if found.get("smooth_above") is None:
        wanted = replace(wanted, smooth_above=None)
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
