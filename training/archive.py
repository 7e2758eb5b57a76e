"""Labels in a form small enough to ship: scenes, cameras, pairs and outcomes; the clouds are rendered again from it.

A part of an archive is one `labels_*.npz`. Its arrays hold all scenes one after the other: what belongs to a view or
a scene is found by counts. Positions are kept to 0.02 mm, in the world.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from simharness.play.crew import Emit, Work, crew
from simharness.sim.camera import PRESET_SENSOR, Preset, observe_from, sample_camera
from simharness.sim.objects import ObjectModel, load_object_set
from simharness.sim.outcomes import OUTCOME_KINDS
from simharness.sim.protocol import query_about
from simharness.sim.scene import restore_scene
from simharness.sim.sensors.catalogue import SENSORS
from simharness.sim.world import World
from tesnet import cloud
from tesnet.candidates import grasp_poses
from tesnet.collision import blocked
from tesnet.geometry import Pose
from tesnet.points import nearest_neighbours
from tesnet.whole_file import whole_file
from training.views import (
    LabelledView,
    LabelsError,
    check_preparation,
    count_outcomes,
    load_scene,
    save_scene,
    scene_files,
)

RESOLUTION = 2e-5
"""Metres to which positions are kept."""

LARGEST_SHIFT = 0.006
"""Candidates whose points have no point of the new cloud within so many metres are left out."""

_TODAY = cloud.PreparationConfig()
_DOWN = np.array([0.0, 0.0, -1.0])
_STRAIGHT = 1 - 1e-6
"""Cosine of the angle with straight down, 0.08 degrees, up to which a direction of travel is kept as a mere flag: that
of shallow pairs does not follow from their points."""

_SCENES_PER_PART = 1000
_HEAR_S = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class ArchivedView:
    """What is kept of a view: C candidates.

    Args:
        Ts_world_camera: (V, 4, 4).
        pairs: (C, 4, 3) as in `LabelledView`, in the world.
        outcomes: as in `LabelledView`.
        collision_free: as there; None where it must be found out from the rendered cloud.
    """

    Ts_world_camera: NDArray[np.float64]
    pairs: NDArray[np.float64]
    outcomes: NDArray[np.uint8]
    collision_free: NDArray[np.bool_] | None


def is_archive(folder: Path) -> bool:
    """Whether the folder holds an archive."""
    return any(folder.glob("labels_*.npz"))


def pack(folders: Sequence[Path], out: Path) -> dict[str, Any]:
    """Writes the labelled scenes under the folders to `out` as an archive; what is in it."""
    out.mkdir(parents=True, exist_ok=True)
    if stale := sorted(out.glob("labels_*.npz")):
        raise LabelsError(f"{out} already holds {stale[0].name}; remove it, or choose another folder")
    files = scene_files(folders)
    counts = np.zeros(len(OUTCOME_KINDS), dtype=np.int64)
    for part, first in enumerate(range(0, len(files), _SCENES_PER_PART)):
        scenes = [_read_scene(path) for path in files[first : first + _SCENES_PER_PART]]
        counts += count_outcomes(view.outcomes for _, views in scenes for view in views)
        _write_part(out / f"labels_{part:03d}.npz", scenes)
    return {
        "scenes": len(files),
        "labels": int(counts.sum()),
        "outcomes": dict(zip(OUTCOME_KINDS, counts.tolist(), strict=True)),
        "bytes": sum(path.stat().st_size for path in out.glob("labels_*.npz")),
    }


def unpack(
    archive: Path,
    objects: str,
    out: Path,
    workers: int = 1,
    more_views: int = 0,
    *,
    scenes: int | None = None,
    seed: int = 0,
    preparation: cloud.PreparationConfig = _TODAY,
) -> dict[str, Any]:
    """Renders the scenes of an archive again, with noise of their own, as scene files in `out`.

    Scenes already there are left alone, so that a stopped run goes on.

    Args:
        archive: folder of `labels_*.npz`.
        objects: the object sets that the scenes were made of, joined with commas.
        out: folder for the scene files.
        workers: processes.
        more_views: views of each scene from new cameras. The outcome of a grasp depends on no camera, so such a view
            shows all labels of its scene whose points it sees.
        scenes: so many, drawn from the whole archive; None for all. Each keeps the number that it has in the archive.
        seed: of the draw.
        preparation: of the clouds. The noise does not depend on it.

    Raises:
        LabelsError: no archive, objects that the sets do not hold, or scenes of another preparation in `out`.
        SimError: a worker failed.
    """
    parts = sorted(archive.glob("labels_*.npz"))
    if not parts:
        raise LabelsError(f"{archive} holds no labels_*.npz; make one with `python -m training pack`")
    out.mkdir(parents=True, exist_ok=True)
    if there := next(iter(sorted(out.glob("scene_*.npz"))), None):
        check_preparation(there, load_scene(there)[0], preparation)
    chosen = _draw(parts, scenes, seed)
    known = {kind: set(models) for kind, models in _models_by_kind(objects).items()}
    numbers, waiting = itertools.count(), 0
    renderer = _Renderer(objects, more_views, preparation)
    with crew(renderer, workers, ray=None) as renderers, tqdm(unit="scene") as progress:
        for part in parts:
            for (description, views), number in zip(_read_part(part), numbers, strict=False):
                if not chosen[number]:
                    continue
                if missing := sorted({item["name"] for item in description["objects"]} - known[description["kind"]]):
                    raise LabelsError(f"--objects lacks {missing[0]}, which a scene of the archive holds; add its set")
                path = out / f"scene_{number:07d}.npz"
                if not path.exists():
                    renderers.give(_Rendering(description, views, path))
                    waiting += 1
            while waiting:
                done = len(renderers.hear(_HEAR_S))
                waiting -= done
                progress.update(done)
    return {"scenes": int(chosen.sum())}


def _draw(parts: Sequence[Path], count: int | None, seed: int) -> NDArray[np.bool_]:
    """Mask over the scenes of an archive's parts: `count` of them drawn at random, or all."""
    total = 0
    for part in parts:
        with np.load(part, allow_pickle=False) as stored:
            total += len(stored["scene_kind"])
    chosen = np.zeros(total, dtype=np.bool_)
    chosen[np.random.default_rng(seed).permutation(total)[:count]] = True
    return chosen


def _read_scene(path: Path) -> tuple[dict[str, Any], list[ArchivedView]]:
    description, views = load_scene(path)
    if len(description["cameras"]) != len(views):  # a view without candidates left no labels
        description["cameras"] = _cameras_of(description, views)
    archived = []
    for cameras, view in zip(description["cameras"], views, strict=True):
        if view.gripper != "franka":
            raise LabelsError(
                f"{path} has labels of {view.gripper}; an archive keeps those of franka alone, leave it out"
            )
        in_world = _moved(view.cloud.T_cloud_canonical, view.pairs.double().numpy())
        archived.append(ArchivedView(np.array(cameras), in_world, view.outcomes.numpy(), view.collision_free.numpy()))
    return description, archived


def _moved(T_b_a: Pose, pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pairs (C, 4, 3), two points and two directions in frame a, in frame b."""
    return np.concatenate([T_b_a.apply(pairs[:, :2]), T_b_a.rotate(pairs[:, 2:])], axis=1)


def _cameras_of(description: Mapping[str, Any], views: Sequence[LabelledView]) -> list[Any]:
    """The recorded cameras from which the views were taken."""
    found = []
    for view in views:
        position = view.cloud.T_cloud_canonical.apply(view.cloud.viewpoints.double().numpy())[0]
        distances = [np.linalg.norm(np.array(camera)[0, :3, 3] - position) for camera in description["cameras"]]
        found.append(description["cameras"][int(np.argmin(distances))])
    return found


def _write_part(path: Path, scenes: Sequence[tuple[Mapping[str, Any], Sequence[ArchivedView]]]) -> None:
    names = sorted({item["name"] for description, _ in scenes for item in description["objects"]})
    columns: dict[str, list[NDArray[Any]]] = {}

    def add(name: str, values: Any, dtype: Any) -> None:
        columns.setdefault(name, []).append(np.asarray(values, dtype=dtype))

    for description, views in scenes:
        items = description["objects"]
        add("scene_kind", [description["kind"] == "pile"], np.uint8)
        add("scene_objects", [len(items)], np.uint8)
        add("scene_views", [len(views)], np.uint8)
        add("object_name", [names.index(item["name"]) for item in items], np.uint16)
        add("object_scale", [item["scale"] for item in items], np.float32)
        poses = [[*item["position"], *item["quaternion_xyzw"]] for item in items]
        add("object_pose", np.array(poses).reshape(-1, 7), np.float32)
        for view in views:
            approach, which_approach = np.unique(_to_grid(view.pairs[:, 0]), axis=0, return_inverse=True)
            closing = np.round(view.pairs[:, 2] * np.iinfo(np.int16).max).astype(np.int64)
            contact, which_contact = np.unique(
                np.hstack([_to_grid(view.pairs[:, 1]), closing]), axis=0, return_inverse=True
            )
            add("view_cameras", [len(view.Ts_world_camera)], np.uint8)
            add("camera", view.Ts_world_camera[:, :3].reshape(-1, 12), np.float32)
            add("view_approach_points", [len(approach)], np.uint16)
            add("view_contact_points", [len(contact)], np.uint16)
            add("view_labels", [len(view.outcomes)], np.uint16)
            add("approach_point", approach, np.int16)
            add("contact_point", contact[:, :3], np.int16)
            add("closing_direction", contact[:, 3:], np.int16)
            add("approach", which_approach.ravel(), np.uint16)
            add("contact", which_contact.ravel(), np.uint16)
            add("straight_down", view.pairs[:, 3] @ _DOWN > _STRAIGHT, np.bool_)
            add("outcome", view.outcomes, np.uint8)
            add("collision_free", view.collision_free, np.bool_)
    arrays = {name: np.concatenate(values) for name, values in columns.items()}
    # Neighbours in the table lie close to each other: bytes of equal weight side by side compress far better.
    for name in ("approach_point", "contact_point", "closing_direction"):
        arrays[name] = np.ascontiguousarray(arrays[name].T)
    arrays["names"] = np.frombuffer(json.dumps(names).encode(), dtype=np.uint8)
    with whole_file(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _to_grid(points: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.round(points / RESOLUTION).astype(np.int64)


def _read_part(path: Path) -> Iterator[tuple[dict[str, Any], list[ArchivedView]]]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
    names = json.loads(arrays.pop("names").tobytes())
    for name in ("approach_point", "contact_point", "closing_direction"):
        arrays[name] = arrays[name].T
    # Parts from before there were shallow pairs have no such column.
    arrays.setdefault("straight_down", np.zeros(len(arrays["outcome"]), dtype=np.bool_))
    position = dict.fromkeys(arrays, 0)

    def take(name: str, count: int) -> NDArray[Any]:
        begin = position[name]
        position[name] += count
        taken: NDArray[Any] = arrays[name][begin : begin + count]
        return taken

    for pile in arrays["scene_kind"]:
        num_objects = int(take("scene_objects", 1)[0])
        poses = take("object_pose", num_objects).astype(np.float64)
        objects = [
            {
                "name": names[name],
                "scale": float(scale),
                "position": pose[:3].tolist(),
                "quaternion_xyzw": pose[3:].tolist(),
            }
            for name, scale, pose in zip(
                take("object_name", num_objects), take("object_scale", num_objects), poses, strict=True
            )
        ]
        views = []
        for _ in range(int(take("scene_views", 1)[0])):
            cameras = np.tile(np.eye(4), (int(take("view_cameras", 1)[0]), 1, 1))
            cameras[:, :3] = take("camera", len(cameras)).reshape(-1, 3, 4)
            num_approach, num_contact, num_labels = (
                int(take(f"view_{name}", 1)[0]) for name in ("approach_points", "contact_points", "labels")
            )
            approach = take("approach_point", num_approach) * RESOLUTION
            contact = take("contact_point", num_contact) * RESOLUTION
            closing = take("closing_direction", num_contact) / np.iinfo(np.int16).max
            which_approach, which_contact = take("approach", num_labels), take("contact", num_labels)
            pairs = _pairs(
                approach[which_approach],
                contact[which_contact],
                closing[which_contact],
                straight_down=take("straight_down", num_labels),
            )
            views.append(ArchivedView(cameras, pairs, take("outcome", num_labels), take("collision_free", num_labels)))
        kind = "pile" if pile else "packed"
        yield {"kind": kind, "objects": objects}, views


def _pairs(
    approach: NDArray[np.float64],
    contact: NDArray[np.float64],
    closing: NDArray[np.float64],
    *,
    straight_down: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Pairs (C, 4, 3) from points (C, 3), closing directions of about unit length and a mask of what travels so."""
    closing = closing / np.linalg.norm(closing, axis=1, keepdims=True)
    poses = grasp_poses(*(torch.from_numpy(rows) for rows in (approach, contact, closing))).numpy()
    travel = np.where(straight_down[:, None], _DOWN, poses[:, :3, 2])
    return np.stack([approach, contact, np.where(straight_down[:, None], closing, poses[:, :3, 1]), travel], axis=1)


@dataclass(frozen=True, eq=False, slots=True)
class _Rendering:
    """A scene to be rendered into a file."""

    description: Mapping[str, Any]
    views: Sequence[ArchivedView]
    path: Path


@dataclass(frozen=True, slots=True)
class _Renderer:
    """What a worker needs to render any scene."""

    objects: str
    more_views: int
    preparation: cloud.PreparationConfig

    def name(self, job: _Rendering) -> str:
        """A scene in words."""
        return job.path.stem.replace("_", " ")

    @contextmanager
    def begin(self) -> Iterator[Work[_Rendering]]:
        """The object models, and what renders scenes of them."""
        os.nice(10)
        torch.set_num_threads(1)
        models = _models_by_kind(self.objects)

        def render(job: _Rendering, _: Emit) -> None:
            _render_scene(job, models[job.description["kind"]], self.more_views, self.preparation)

        yield render


def _models_by_kind(objects: str) -> dict[str, dict[str, ObjectModel]]:
    return {
        kind: {model.name: model for name in objects.split(",") for model in load_object_set(name, kind)}
        for kind in ("packed", "pile")
    }


def _render_scene(
    job: _Rendering, models: Mapping[str, ObjectModel], more_views: int, preparation: cloud.PreparationConfig
) -> None:
    rng = np.random.default_rng([len(job.views), *(len(view.outcomes) for view in job.views)])
    views = list(job.views)
    with World() as world:
        restore_scene(world, job.description, models)
        kind = job.description["kind"]
        rendered = [_render_view(world, view, kind, rng, preparation) for view in views]
        for _ in range(more_views if views else 0):
            views.append(_from_elsewhere(job.views, rng))
            rendered.append(_render_view(world, views[-1], kind, rng, preparation))
    cameras = [view.Ts_world_camera.tolist() for view in views]
    description = {**job.description, "cameras": cameras}
    save_scene(job.path, description, [view for view in rendered if view is not None], preparation)


def _from_elsewhere(views: Sequence[ArchivedView], rng: np.random.Generator) -> ArchivedView:
    """All labels of a scene, as one view from a new camera would have them."""
    return ArchivedView(
        np.stack([camera.matrix for camera in sample_camera("random", rng)]),
        np.concatenate([view.pairs for view in views]),
        np.concatenate([view.outcomes for view in views]),
        None,
    )


def _render_view(
    world: World, view: ArchivedView, kind: str, rng: np.random.Generator, preparation: cloud.PreparationConfig
) -> LabelledView | None:
    preset: Preset = "random" if len(view.Ts_world_camera) == 1 else "multi3"
    cameras = [Pose.from_matrix(matrix) for matrix in view.Ts_world_camera]
    observation = observe_from(world, cameras, rng, SENSORS[PRESET_SENSOR[preset]])
    query = query_about(observation)
    prepared = cloud.prepare(query, preparation, torch.device("cpu"))
    if prepared is None or len(prepared) < cloud.MINIMUM_POINTS:
        return None
    pairs = torch.tensor(_moved(prepared.T_cloud_canonical.inverse(), view.pairs)).float()
    nearest = nearest_neighbours(prepared.points, 1, pairs[:, :2].reshape(-1, 3))[:, 0].view(-1, 2)
    near = ((prepared.points[nearest] - pairs[:, :2]).norm(dim=2) < LARGEST_SHIFT).all(dim=1)
    shown = LabelledView(
        cloud=prepared,
        pairs=pairs[near],
        widths=torch.full((int(near.sum()),), query.gripper.max_width),
        approach=nearest[near, 0],
        contact=nearest[near, 1],
        outcomes=torch.from_numpy(view.outcomes.copy())[near],
        collision_free=torch.ones(int(near.sum()), dtype=torch.bool),
        scene=kind,
    )
    if view.collision_free is None:
        return replace(shown, collision_free=~blocked(prepared, shown.candidates, query.gripper, query.unseen))
    return replace(shown, collision_free=torch.from_numpy(view.collision_free.copy())[near])
