from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from simharness.sim.protocol import query_about
from tesnet import weights
from tesnet.cloud import MINIMUM_POINTS, PreparationConfig, prepare
from tesnet.collision import blocked
from tesnet.geometry import Pose
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from tests.tesnet.scenes import CAMERA, UP
from tests.training.synthetic import labelled_view
from training import archive, viewing
from training.__main__ import main
from training.archive import _draw, pack, unpack
from training.generate import GenerateConfig, generate
from training.parts import ArchivedView, keys_of
from training.viewing import MoreViews
from training.views import LabelledView, LabelsError, load_scene, save_scene, scene_files

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labels")
    config = GenerateConfig("packed", "procedural-train", seed=5, labels_per_view=16, colliding_share=0.5)
    generate(config, labels=40, workers=1, out=folder)
    return folder


def test_an_archive_renders_the_views_and_labels_that_went_in(labels: Path, tmp_path: Path) -> None:
    account = pack([labels], tmp_path / "archive")
    assert unpack(tmp_path / "archive", "procedural-train", tmp_path / "again") == {"scenes": account["scenes"]}
    kept = 0
    for before, after in zip(scene_files([labels]), scene_files([tmp_path / "again"]), strict=True):
        old, new = load_scene(before), load_scene(after)
        assert [item["name"] for item in old[0]["objects"]] == [item["name"] for item in new[0]["objects"]]
        for one, other in zip(old[1], new[1], strict=True):
            kept += len(other.outcomes)
            assert len(other.outcomes) == len(one.outcomes)
            np.testing.assert_allclose(
                one.cloud.T_cloud_canonical.apply(one.cloud.points.numpy().mean(axis=0)),
                other.cloud.T_cloud_canonical.apply(other.cloud.points.numpy().mean(axis=0)),
                atol=3e-3,  # the noise is another
            )
            poses = [v.cloud.T_cloud_canonical.matrix @ v.candidates.Ts_canonical_grasp.numpy() for v in (one, other)]
            for pose, outcome, free in zip(poses[1], other.outcomes, other.collision_free, strict=True):
                same = np.abs(poses[0] - pose).max(axis=(1, 2)) < 5e-3
                assert (int(outcome), bool(free)) in set(
                    zip(one.outcomes[same].tolist(), one.collision_free[same].tolist(), strict=True)
                )
    assert kept == account["labels"]


def test_more_views_may_be_of_any_camera_and_sensor(labels: Path, tmp_path: Path) -> None:
    pack([labels], tmp_path / "archive")
    more = MoreViews(2, "any", "random")
    unpack(tmp_path / "archive", "procedural-train", tmp_path / "again", more_views=more)
    added = []
    for before, after in zip(scene_files([labels]), scene_files([tmp_path / "again"]), strict=True):
        old, (description, views) = load_scene(before)[1], load_scene(after)
        assert [view.sensor for view in views] == [viewing["sensor"] for viewing in description["views"]]
        added += description["views"][len(old) :]
    assert len(added) > 1
    assert {viewing["sensor"] for viewing in added} == {"random"}
    assert len({viewing["seed"] for viewing in added}) == len(added)
    assert any(viewing["shows"] != "box" or len(viewing["cameras"]) > 1 for viewing in added)


def test_more_views_show_the_labels_of_their_scene_from_new_cameras(labels: Path, tmp_path: Path) -> None:
    pack([labels], tmp_path / "archive")
    unpack(tmp_path / "archive", "procedural-train", tmp_path / "again", more_views=MoreViews(3))
    shown = 0
    for before, after in zip(scene_files([labels]), scene_files([tmp_path / "again"]), strict=True):
        old, (description, views) = load_scene(before)[1], load_scene(after)
        cameras = [viewing["cameras"] for viewing in description["views"]]
        assert [viewing["sensor"] for viewing in description["views"]] == [view.sensor for view in views]
        assert len(cameras) == len(old) + 3
        assert len({json.dumps(camera) for camera in cameras}) == len(cameras)
        recorded = [_in_world(view) for view in old]
        for view in views[len(old) :]:
            poses, outcomes = _in_world(view)
            shown += len(outcomes)
            for pose, outcome in zip(poses, outcomes, strict=True):
                assert any(
                    outcome in of_old[np.abs(old_poses - pose).max(axis=(1, 2)) < 5e-3]
                    for old_poses, of_old in recorded
                )
            free, clear = surely_free(view)
            assert torch.equal(view.collision_free[clear], free[clear])
            assert clear.float().mean() > 0.5
    assert shown > 0


def surely_free(view: LabelledView) -> tuple[torch.Tensor, torch.Tensor]:
    """What the cloud leaves free, and where that holds however the file rounded the points (half a step of float16)."""
    generator = torch.Generator().manual_seed(0)
    noise = 2e-4 * torch.rand(16, *view.cloud.points.shape, generator=generator) - 1e-4
    clouds = [replace(view.cloud, points=view.cloud.points + moved) for moved in noise]
    votes = torch.stack([~blocked(cloud, view.candidates, "free") for cloud in clouds])
    return votes[0], (votes == votes[0]).all(dim=0)


def test_some_scenes_are_drawn_and_prepared_as_a_network_wants_them(labels: Path, tmp_path: Path) -> None:
    pack([labels], tmp_path / "archive")
    folders = {name: tmp_path / name for name in ("all", "coarse", "again")}
    fine = PreparationConfig(voxel_size=0.0025)
    unpack(tmp_path / "archive", "procedural-train", folders["all"])
    for name, seed, preparation in (("coarse", 0, PreparationConfig()), ("again", 0, fine)):
        told = unpack(
            tmp_path / "archive", "procedural-train", folders[name], scenes=1, seed=seed, preparation=preparation
        )
        assert told == {"scenes": 1}
    (one,), (same,) = scene_files([folders["coarse"]]), scene_files([folders["again"]])
    assert one.name == same.name
    assert one.read_bytes() == (folders["all"] / one.name).read_bytes()
    (coarse, *_), (dense, *_) = load_scene(one)[1], load_scene(same)[1]
    assert len(dense.cloud) > 1.5 * len(coarse.cloud)
    drawn = {tuple(np.flatnonzero(_draw(sorted((tmp_path / "archive").glob("*.npz")), 1, seed))) for seed in range(20)}
    assert len(drawn) > 1
    with pytest.raises(LabelsError, match="prepared for another network"):
        unpack(tmp_path / "archive", "procedural-train", folders["coarse"], preparation=fine)


def test_scenes_are_rendered_with_clouds_as_the_service_prepares_them(
    labels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queries: list[GraspQuery] = []

    def noted(*arguments: Any, **options: Any) -> GraspQuery:
        queries.append(query_about(*arguments, **options))
        return queries[-1]

    monkeypatch.setattr(viewing, "query_about", noted)
    preparation = GraspPredictor.load(weights.default_weights()).preparation
    scene = archive._read_scene(next(path for path in scene_files([labels]) if load_scene(path)[1]))
    job = archive.SceneFile(replace(scene, views=scene.views[:1]), tmp_path / "scene_0.npz")
    archive._render_scene(job, archive._models_by_kind("procedural-train")["packed"], MoreViews(), preparation)
    (view,) = load_scene(tmp_path / "scene_0.npz")[1]
    served = prepare(queries[0], preparation, torch.device("cpu"))
    assert served is not None
    # As far as float16 keeps them.
    torch.testing.assert_close(view.cloud.points, served.points, atol=3e-4, rtol=0)
    torch.testing.assert_close(view.cloud.spectrum, served.spectrum, atol=3e-4, rtol=0)
    assert (view.cloud.normals * served.normals).sum(dim=1).quantile(0.01) > 0.9999


def _in_world(view: LabelledView) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Poses and outcomes of a view's labels."""
    poses = view.cloud.T_cloud_canonical.matrix @ view.candidates.Ts_canonical_grasp.double().numpy()
    return poses, view.outcomes.numpy()


def test_rendering_goes_on_where_it_stopped(labels: Path, tmp_path: Path) -> None:
    pack([labels], tmp_path / "archive")
    unpack(tmp_path / "archive", "procedural-train", tmp_path / "again")
    first, *others = scene_files([tmp_path / "again"])
    contents, written = first.read_bytes(), first.stat().st_mtime_ns
    for path in others:
        path.unlink()
    unpack(tmp_path / "archive", "procedural-train", tmp_path / "again")
    assert len(scene_files([tmp_path / "again"])) == 1 + len(others)
    assert (first.read_bytes(), first.stat().st_mtime_ns) == (contents, written)


def test_parts_are_added_of_scenes_that_an_archive_lacks(labels: Path, tmp_path: Path) -> None:
    for number, path in enumerate(scene_files([labels])):
        (tmp_path / "growing").mkdir(exist_ok=True)
        (tmp_path / "growing" / path.name).write_bytes(path.read_bytes())
        account = pack([tmp_path / "growing"], tmp_path / "archive")
        assert account["scenes"] == number + 1
    assert len(list((tmp_path / "archive").glob("labels_*.npz"))) == account["scenes"] > 1
    assert pack([labels], tmp_path / "archive") == account
    assert pack([labels], tmp_path / "whole")["labels"] == account["labels"]


def scenes_of_seeds(labels: Path, folder: Path, seeds: list[int]) -> Path:
    """A folder with one scene of the labels under each of these seeds."""
    folder.mkdir()
    description, views = load_scene(next(path for path in scene_files([labels]) if load_scene(path)[1]))
    for seed in seeds:
        save_scene(folder / f"scene_{seed:07d}.npz", {**description, "seed": seed}, views)
    return folder


def test_a_new_part_comes_after_all_that_are_there_and_replaces_none(labels: Path, tmp_path: Path) -> None:
    """Also where one in between was taken away, and scenes of the default seed 0 are known again."""
    first, second, all_of_them = (
        scenes_of_seeds(labels, tmp_path / name, seeds)
        for name, seeds in (("first", [0, 1]), ("second", [2]), ("third", [0, 1, 2, 3]))
    )
    out = tmp_path / "archive"
    pack([first], out)
    pack([second], out)
    (out / "labels_001.npz").rename(out / "labels_002.npz")
    contents = {path: path.read_bytes() for path in out.iterdir()}
    account = pack([all_of_them], out)
    assert {path.name for path in out.iterdir()} == {"labels_000.npz", "labels_002.npz", "labels_003.npz"}
    assert all(path.read_bytes() == content for path, content in contents.items())
    assert {key[0] for key in keys_of(out / "labels_003.npz")} == {3}
    assert account["scenes"] == 4
    assert account["bytes"] == sum(path.stat().st_size for path in out.iterdir())
    labelled = load_scene(scene_files([second])[0])[1]
    assert account["labels"] == 4 * sum(len(view.outcomes) for view in labelled) == sum(account["outcomes"].values())


def test_no_part_has_more_scenes_than_it_may(labels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "SCENES_PER_PART", 2)
    folder, out = scenes_of_seeds(labels, tmp_path / "labels", list(range(5))), tmp_path / "archive"
    assert pack([folder], out)["scenes"] == 5
    assert [len(keys_of(out / f"labels_{part:03d}.npz")) for part in range(3)] == [2, 2, 1]
    assert len(list(out.iterdir())) == 3


@pytest.mark.parametrize("count", [0, 1, 3, 7, None])
def test_so_many_scenes_are_drawn_from_all_parts(labels: Path, tmp_path: Path, count: int | None) -> None:
    out = tmp_path / "archive"
    for part in range(3):
        pack([scenes_of_seeds(labels, tmp_path / f"labels{part}", [part])], out)
    chosen = _draw(sorted(out.glob("*.npz")), count, 0)
    assert len(chosen) == 3
    assert chosen.sum() == (3 if count is None else min(count, 3))


def test_an_archive_without_its_objects_is_refused(
    labels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pack([labels], tmp_path / "archive")
    with pytest.raises(LabelsError, match="lacks procedural/train/"):
        unpack(tmp_path / "archive", "procedural", tmp_path / "again")
    arguments = ["fit", "--data", str(tmp_path / "archive"), "--validation", str(labels), "--out", str(tmp_path / "w")]
    assert main(arguments) == 2
    assert "name its objects with --objects" in capsys.readouterr().err
    with pytest.raises(LabelsError, match="holds no labels_"):
        unpack(labels, "procedural-train", tmp_path / "again")


@pytest.mark.parametrize("others", [0, 2])
def test_views_of_old_scenes_were_taken_from_the_recorded_cameras_where_their_viewpoints_are(others: int) -> None:
    """Scenes of before 0.6.0 record cameras of views that were dropped, too; a fused view begins with its first one."""
    places = CAMERA + np.array([[0.3, 0, 0], [0, 0, 0], [0, -0.2, 0], [0.1, 0.2, 0]])
    cameras = [
        [Pose.look_at(places[(first + step) % 4], [0, 0, 0], UP).matrix.tolist() for step in range(1 + others)]
        for first in range(4)
    ]
    views = []
    for first in (1, 3):
        view = labelled_view(count=30)
        T_canonical_world = view.cloud.T_cloud_canonical.inverse()
        stood = [T_canonical_world.apply(places[(first + step) % 4]) for step in range(1 + others)]
        views.append(replace(view, cloud=replace(view.cloud, viewpoints=torch.tensor(np.array(stood)).float())))
    assert archive._cameras_of({"cameras": cameras}, views) == [cameras[1], cameras[3]]


def test_views_that_are_rendered_with_too_few_points_are_left_out_of_their_scene(labels: Path, tmp_path: Path) -> None:
    """As on a grid so coarse that small things have fewer points than the service answers."""
    models = archive._models_by_kind("procedural-train")["packed"]
    scene = archive._read_scene(next(path for path in scene_files([labels]) if load_scene(path)[1]))
    labels_of_seed = {view.viewing.seed: len(view.outcomes) for view in scene.views}
    kept = []
    for number, voxel_size in enumerate((0.025, 0.04, 0.06)):
        job = archive.SceneFile(scene, tmp_path / f"scene_{number}.npz")
        archive._render_scene(job, models, MoreViews(), PreparationConfig(voxel_size=voxel_size))
        description, views = load_scene(job.path)
        assert all(len(view.cloud) >= MINIMUM_POINTS for view in views)
        told = [labels_of_seed[viewing["seed"]] for viewing in description["views"]]
        assert [len(view.outcomes) for view in views] == told
        kept.append(len(views))
    assert kept[0] == len(scene.views) > kept[-1]


def test_a_new_camera_shows_the_candidates_of_whose_pair_it_sees_both_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near enough, that is; which of them are free of what it sees is judged anew."""
    rng = np.random.default_rng(0)
    view = labelled_view(count=60)
    view = replace(view, collision_free=torch.zeros(60, dtype=torch.bool))
    found = torch.stack([view.cloud.points[view.approach], view.cloud.points[view.contact]], dim=1).double().numpy()
    distances = rng.choice([0.0, 0.0149, 0.0151, 0.04], (60, 2))
    directions = np.stack([[Pose.random(rng).rotation[0] for _ in range(2)] for _ in range(60)])
    wanted = view.cloud.T_cloud_canonical.apply(found + distances[:, :, None] * directions)
    np.testing.assert_allclose(archive._shifts(view, wanted).numpy(), distances, atol=1e-5)
    looked = viewing.Viewing((Pose.identity(),), "gaussian", 0)
    halves = [
        ArchivedView(
            looked,
            view.gripper,
            wanted[some],
            view.poses.numpy()[some],
            view.widths.numpy()[some],
            view.outcomes.numpy()[some],
            view.collision_free.numpy()[some],
        )
        for some in (slice(20), slice(20, None))
    ]
    asked: list[ArchivedView] = []

    def rendered(_: Any, everything: ArchivedView, __: Any) -> LabelledView:
        asked.append(everything)
        return view

    monkeypatch.setattr(archive, "render_view", rendered)
    shown = archive._from_elsewhere(None, halves, looked, PreparationConfig())  # type: ignore[arg-type]
    assert shown is not None
    (everything,) = asked
    np.testing.assert_array_equal(everything.places, wanted)
    np.testing.assert_array_equal(everything.outcomes, view.outcomes.numpy())
    near = (distances < 0.015).all(axis=1)
    assert 5 < near.sum() < 40
    assert torch.equal(shown.poses, view.poses[torch.from_numpy(near)])
    assert torch.equal(shown.outcomes, view.outcomes[torch.from_numpy(near)])
    assert torch.equal(shown.collision_free, ~blocked(shown.cloud, shown.candidates, "free"))
    assert shown.collision_free.any()
    monkeypatch.setattr(archive, "render_view", lambda *_: None)
    assert archive._from_elsewhere(None, halves, looked, PreparationConfig()) is None  # type: ignore[arg-type]
