"""Labels in a form small enough to ship: scenes, views, poses and outcomes; the clouds are rendered again from it.

An archive is a folder of parts, `labels_*.npz` (`training.parts`), which may be written one after the other while
labels are made.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from simharness.play.crew import Emit, Work, crew
from simharness.sim.objects import ObjectModel, load_object_set
from simharness.sim.outcome_kinds import OUTCOME_KINDS
from simharness.sim.scene import restore_scene
from simharness.sim.world import World
from tesnet import cloud
from tesnet.collision import blocked
from tesnet.points import nearest_neighbours
from training.parts import ArchivedScene, ArchivedView, keys_of, read_part, viewing_of_cameras, write_part
from training.viewing import MoreViews, Viewing, viewings_of
from training.views import (
    LabelledView,
    LabelsError,
    check_preparation,
    count_outcomes,
    load_scene,
    number_of,
    save_scene,
    scene_files,
)

LARGEST_SHIFT = 0.015
"""From a camera that is not its own, a candidate is shown where both points of its pair have a point of the new cloud
within so many metres."""

_TODAY = cloud.PreparationConfig()
_NO_MORE = MoreViews()
SCENES_PER_PART = 1000
_HEAR_S = 1.0


def is_archive(folder: Path) -> bool:
    """Whether the folder holds an archive."""
    return any(folder.glob("labels_*.npz"))


def pack(folders: Sequence[Path], out: Path) -> dict[str, Any]:
    """Adds the labelled scenes under the folders to the archive `out`, as further parts; what it holds then.

    Scenes that the archive holds already, by seed and number, are left out.
    """
    out.mkdir(parents=True, exist_ok=True)
    there = sorted(out.glob("labels_*.npz"))
    known = {key for part in there for key in keys_of(part)}
    first_part = 1 + max(map(number_of, there), default=-1)
    scenes = (scene for scene in map(_read_scene, scene_files(folders)) if scene.key is None or scene.key not in known)
    for part in itertools.count(first_part):
        if not (some := list(itertools.islice(scenes, SCENES_PER_PART))):
            break
        write_part(out / f"labels_{part:03d}.npz", some)
    parts = sorted(out.glob("labels_*.npz"))
    counts = np.zeros(len(OUTCOME_KINDS), dtype=np.int64)
    num_scenes = 0
    for path in parts:
        with np.load(path, allow_pickle=False) as stored:
            counts += count_outcomes([stored["outcome"]])
            num_scenes += len(stored["scene_kind"])
    return {
        "scenes": num_scenes,
        "labels": int(counts.sum()),
        "outcomes": dict(zip(OUTCOME_KINDS, counts.tolist(), strict=True)),
        "bytes": sum(path.stat().st_size for path in parts),
    }


def unpack(
    archive: Path,
    objects: str,
    out: Path,
    workers: int = 1,
    more_views: MoreViews = _NO_MORE,
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
    if there := next(iter(sorted(out.glob("scene_*.npz"))), None):
        check_preparation(there, load_scene(there)[0], preparation)
    render = partial(_render_scene, more_views=more_views, preparation=preparation)
    return {"scenes": for_each_scene(archive, objects, render, out, "scene", workers, scenes=scenes, seed=seed)}


@dataclass(frozen=True, eq=False, slots=True)
class SceneFile:
    """A scene of an archive, and the file that shall be made of it."""

    scene: ArchivedScene
    path: Path


Make = Callable[[SceneFile, Mapping[str, ObjectModel]], None]
"""Makes the file of a scene, of object models by their names. It is sent to workers, so it can be pickled."""


def for_each_scene(
    archive: Path,
    objects: str,
    make: Make,
    out: Path,
    stem: str,
    workers: int,
    *,
    scenes: int | None,
    seed: int,
) -> int:
    """Has workers make a file `STEM_NUMBER.npz` in `out` of each scene of an archive, but of those that have one.

    Args:
        archive: folder of `labels_*.npz`.
        objects: the object sets that the scenes were made of, joined with commas.
        make: makes a file.
        out: folder for the files.
        stem: of their names.
        workers: processes.
        scenes: so many, drawn from the whole archive; None for all. Each keeps the number that it has in the archive.
        seed: of the draw.

    Returns:
        How many scenes were chosen.

    Raises:
        LabelsError: no archive, or objects that the sets do not hold.
        SimError: a worker failed.
    """
    parts = sorted(archive.glob("labels_*.npz"))
    if not parts:
        raise LabelsError(f"{archive} holds no labels_*.npz; make one with `python -m training pack`")
    out.mkdir(parents=True, exist_ok=True)
    chosen = _draw(parts, scenes, seed)
    known = {kind: set(models) for kind, models in _models_by_kind(objects).items()}
    numbers, waiting = itertools.count(), 0
    with crew(_Maker(objects, make), workers, ray=None) as makers, tqdm(unit="scene") as progress:
        for part in parts:
            for scene, number in zip(read_part(part), numbers, strict=False):
                if not chosen[number]:
                    continue
                description = scene.description
                if missing := sorted({item["name"] for item in description["objects"]} - known[description["kind"]]):
                    raise LabelsError(f"--objects lacks {missing[0]}, which a scene of the archive holds; add its set")
                path = out / f"{stem}_{number:07d}.npz"
                if not path.exists():
                    makers.give(SceneFile(scene, path))
                    waiting += 1
            while waiting:
                done = len(makers.hear(_HEAR_S))
                waiting -= done
                progress.update(done)
    return int(chosen.sum())


def _draw(parts: Sequence[Path], count: int | None, seed: int) -> NDArray[np.bool_]:
    """Mask over the scenes of an archive's parts: `count` of them drawn at random, or all."""
    total = 0
    for part in parts:
        with np.load(part, allow_pickle=False) as stored:
            total += len(stored["scene_kind"])
    chosen = np.zeros(total, dtype=np.bool_)
    chosen[np.random.default_rng(seed).permutation(total)[:count]] = True
    return chosen


def _read_scene(path: Path) -> ArchivedScene:
    description, views = load_scene(path)
    if "views" not in description:  # of before 0.6.0
        cameras = description["cameras"]
        cameras = cameras if len(cameras) == len(views) else _cameras_of(description, views)
        viewings = [viewing_of_cameras(np.array(some)) for some in cameras]
    else:
        viewings = viewings_of(description)
    archived = [_archived(viewing, view) for viewing, view in zip(viewings, views, strict=True)]
    return ArchivedScene(description, tuple(archived))


def _archived(viewing: Viewing, view: LabelledView) -> ArchivedView:
    T_world_canonical = view.cloud.T_cloud_canonical
    places = torch.stack([view.cloud.points[view.approach], view.cloud.points[view.contact]], dim=1).double().numpy()
    return ArchivedView(
        viewing,
        view.gripper,
        T_world_canonical.apply(places),
        T_world_canonical.matrix @ view.poses.double().numpy(),
        view.widths.double().numpy(),
        view.outcomes.numpy(),
        view.collision_free.numpy(),
    )


def _cameras_of(description: Mapping[str, Any], views: Sequence[LabelledView]) -> list[Any]:
    """The recorded cameras from which the views were taken."""
    found = []
    for view in views:
        position = view.cloud.T_cloud_canonical.apply(view.cloud.viewpoints.double().numpy())[0]
        distances = [np.linalg.norm(np.array(camera)[0, :3, 3] - position) for camera in description["cameras"]]
        found.append(description["cameras"][int(np.argmin(distances))])
    return found


@dataclass(frozen=True, slots=True)
class _Maker:
    """What a worker needs to make the file of any scene."""

    objects: str
    make: Make

    def name(self, job: SceneFile) -> str:
        """A scene in words."""
        return job.path.stem.replace("_", " ")

    @contextmanager
    def begin(self) -> Iterator[Work[SceneFile]]:
        """The object models, and what makes files of scenes of them."""
        os.nice(10)
        torch.set_num_threads(1)
        models = _models_by_kind(self.objects)

        def work(job: SceneFile, _: Emit) -> None:
            self.make(job, models[job.scene.description["kind"]])

        yield work


def _models_by_kind(objects: str) -> dict[str, dict[str, ObjectModel]]:
    return {
        kind: {model.name: model for name in objects.split(",") for model in load_object_set(name, kind)}
        for kind in ("packed", "pile")
    }


def _render_scene(
    job: SceneFile, models: Mapping[str, ObjectModel], more_views: MoreViews, preparation: cloud.PreparationConfig
) -> None:
    views = job.scene.views
    # Not of the number of outcomes, which many scenes share.
    rng = np.random.default_rng([crc32(view.outcomes.tobytes()) for view in views])
    with World() as world:
        restore_scene(world, job.scene.description, models)
        shown = [(view.viewing, render_view(world, view, preparation)) for view in views]
        if views:
            others = more_views.draw(rng)
            shown += [(viewing, _from_elsewhere(world, views, viewing, preparation)) for viewing in others]
    kept = [(viewing, view) for viewing, view in shown if view is not None]
    description = {**job.scene.description, "views": [viewing.describe() for viewing, _ in kept]}
    save_scene(job.path, description, [replace(view, scene=description["kind"]) for _, view in kept], preparation)


def _from_elsewhere(
    world: World, views: Sequence[ArchivedView], viewing: Viewing, preparation: cloud.PreparationConfig
) -> LabelledView | None:
    """All labels of a scene whose places are seen from a new camera, where the hand's way is judged anew."""
    everything = ArchivedView(
        viewing=viewing,
        gripper=views[0].gripper,
        places=np.concatenate([view.places for view in views]),
        Ts_world_grasp=np.concatenate([view.Ts_world_grasp for view in views]),
        widths=np.concatenate([view.widths for view in views]),
        outcomes=np.concatenate([view.outcomes for view in views]),
        collision_free=np.concatenate([view.collision_free for view in views]),
    )
    shown = render_view(world, everything, preparation)
    if shown is None:
        return None
    seen = shown.only((_shifts(shown, everything.places) < LARGEST_SHIFT).all(dim=1))
    return replace(seen, collision_free=~blocked(seen.cloud, seen.candidates, "free"))


def _shifts(view: LabelledView, places: NDArray[np.float64]) -> torch.Tensor:
    """(C, 2) metres from the places of pairs in the world to the points that stand for them."""
    wanted = torch.tensor(view.cloud.T_cloud_canonical.inverse().apply(places)).float()
    found = torch.stack([view.cloud.points[view.approach], view.cloud.points[view.contact]], dim=1)
    shifts: torch.Tensor = (found - wanted).norm(dim=2)
    return shifts


def render_view(world: World, view: ArchivedView, preparation: cloud.PreparationConfig) -> LabelledView | None:
    """The view as its sensor sees it, with every label: poses stay, the nearest points stand for those of the pairs.

    None where too little is seen.
    """
    looked = view.viewing.look(world, 0, view.gripper, preparation)
    if looked is None:
        return None
    _, prepared = looked
    to_canonical = prepared.T_cloud_canonical.inverse()
    places = torch.tensor(to_canonical.apply(view.places.reshape(-1, 3))).float()
    nearest = nearest_neighbours(prepared.points, 1, places)[:, 0].view(-1, 2)
    return LabelledView(
        cloud=prepared,
        poses=torch.tensor(to_canonical.matrix @ view.Ts_world_grasp).float(),
        widths=torch.tensor(view.widths).float(),
        approach=nearest[:, 0],
        contact=nearest[:, 1],
        outcomes=torch.from_numpy(view.outcomes.copy()),
        collision_free=torch.from_numpy(view.collision_free.copy()),
        scene="",
        gripper=view.gripper,
        sensor=view.viewing.sensor,
    )
