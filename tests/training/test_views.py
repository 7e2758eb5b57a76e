from __future__ import annotations

import gc
import json
import weakref
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tesnet.cloud import PreparationConfig
from tesnet.geometry import PANDA, Pose
from tests.training.synthetic import labelled_view, write
from training.views import Fold, LabelsError, StoredViews, load_scene, load_views, save_scene, scene_files


def test_labels_round_trip(tmp_path: Path) -> None:
    first = replace(labelled_view(0), collision_free=torch.arange(60) % 3 > 0)
    second = labelled_view(1, count=40)
    second = replace(second, sensor="d435", cloud=replace(second.cloud, pose_in_doubt=True))
    path = tmp_path / "scene_0000000.npz"
    save_scene(path, {"seed": 3, "objects": ["a", "b"]}, [first, second])
    description, views = load_scene(path)
    assert description == {"seed": 3, "objects": ["a", "b"], "preparation": asdict(PreparationConfig())}
    assert len(views) == 2
    for before, after in zip((first, second), views, strict=True):
        assert torch.equal(before.outcomes, after.outcomes)
        assert torch.equal(before.success, after.success)
        assert torch.equal(before.collision_free, after.collision_free)
        assert torch.equal(before.candidates.approach, after.candidates.approach)
        assert torch.equal(before.candidates.contact, after.candidates.contact)
        assert torch.equal(before.cloud.neighbours, after.cloud.neighbours)
        assert after.scene == "packed"
        assert after.sensor == before.sensor
        # float16 coordinates: 0.06 mm at 0.1 m, 0.12 mm beyond 0.125 m; half of that by rounding.
        torch.testing.assert_close(after.cloud.points, before.cloud.points, atol=7e-5, rtol=0)
        tried, stored = before.candidates.Ts_canonical_grasp, after.candidates.Ts_canonical_grasp
        assert torch.equal(stored, tried)
        # Directions are of unit length to rounding, whatever float16 kept of them.
        for directions in (after.cloud.normals, after.cloud.view_directions):
            torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)), atol=1e-6, rtol=0)
        facing = (after.cloud.normals * after.cloud.view_directions).sum(dim=1)
        assert (facing >= 0).all()
        agree = (after.cloud.normals * before.cloud.normals).sum(dim=1)
        assert agree.min() > 0.999
        torch.testing.assert_close(after.cloud.spectrum, before.cloud.spectrum, atol=1e-3, rtol=0)
        assert before.cloud.up is not None
        assert after.cloud.up is not None
        torch.testing.assert_close(after.cloud.up, before.cloud.up)
        assert after.cloud.support_height == before.cloud.support_height
        assert after.cloud.pose_in_doubt == before.cloud.pose_in_doubt
        assert len(after.cloud.sides) == 4
        assert torch.equal(after.cloud.sides, before.cloud.sides)
        np.testing.assert_array_equal(after.cloud.T_cloud_canonical.matrix, before.cloud.T_cloud_canonical.matrix)


def test_poses_widths_and_hand_round_trip_whatever_they_are(tmp_path: Path) -> None:
    view = labelled_view(count=30)
    rng = np.random.default_rng(0)
    poses = torch.tensor(np.stack([Pose.random(rng).matrix for _ in range(30)])).float()
    widths = torch.linspace(0.01, 0.06, 30)
    hand = PANDA.with_sizes({"max_width": 0.06, "linkage_length": 0.05})
    save_scene(tmp_path / "scene_0.npz", {}, [replace(view, poses=poses, widths=widths, gripper=hand)])
    (stored,) = load_scene(tmp_path / "scene_0.npz")[1]
    assert torch.equal(stored.candidates.Ts_canonical_grasp, poses)
    assert torch.equal(stored.candidates.widths, widths)
    assert stored.gripper == hand


def test_files_of_pairs_alone_are_those_of_the_open_hand(tmp_path: Path) -> None:
    """As they were before 0.6.0."""
    view = labelled_view(count=30)
    d = view.cloud.points[view.contact] - view.cloud.points[view.approach]
    closing, travel = view.poses[:, :3, 1], view.poses[:, :3, 2]
    pairs = torch.stack([view.cloud.points[view.approach], view.cloud.points[view.contact], closing, travel], dim=1)
    path = tmp_path / "scene_0.npz"
    save_scene(path, {}, [view])
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if not name.endswith(("/poses", "/widths"))}
    frame = json.loads(arrays["0/frame"].tobytes()) | {"gripper": "franka"}
    arrays["0/frame"] = np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8)
    np.savez(path, allow_pickle=False, **arrays, **{"0/pairs": pairs.numpy()})
    (old,) = load_scene(path)[1]
    tips = (d * travel).sum(dim=1) + 0.007
    expected = pairs[:, 0] + (tips - PANDA.tip_offset)[:, None] * travel
    torch.testing.assert_close(old.poses[:, :3, 3], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(old.poses[:, :3, :3], view.poses[:, :3, :3], atol=1e-6, rtol=0)
    assert (old.widths == PANDA.max_width).all()
    assert old.gripper == PANDA


@pytest.mark.parametrize("as_mask", [True, False])
def test_of_a_view_with_only_some_candidates_each_keeps_all_that_is_its_own(as_mask: bool) -> None:
    rng = np.random.default_rng(0)
    view = replace(
        labelled_view(count=30),
        widths=torch.linspace(0.01, 0.08, 30),
        outcomes=torch.from_numpy(rng.integers(0, 4, 30).astype(np.uint8)),
        collision_free=torch.from_numpy(rng.random(30) < 0.5),
    )
    rows = np.flatnonzero(rng.random(30) < 0.4) if as_mask else rng.permutation(30)[:11]
    which = torch.zeros(30, dtype=torch.bool) if as_mask else torch.from_numpy(rows)
    if as_mask:
        which[rows] = True
    some = view.only(which)
    assert some.cloud is view.cloud
    for name in ("poses", "widths", "approach", "contact", "outcomes", "collision_free", "success"):
        assert torch.equal(getattr(some, name), torch.stack([getattr(view, name)[row] for row in rows.tolist()]))


def test_a_scene_without_views_round_trips(tmp_path: Path) -> None:
    save_scene(tmp_path / "scene_0.npz", {"number": 0}, [])
    description, views = load_scene(tmp_path / "scene_0.npz")
    assert description["number"] == 0
    assert views == []


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "other"])
def test_a_damaged_file_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "scene_0.npz"
    save_scene(path, {}, [labelled_view(count=30)])
    if damage == "other":
        np.savez(path, allow_pickle=False, a=np.zeros(3))
    else:
        path.write_bytes({"empty": b"", "cut": path.read_bytes()[:-500], "text": b"labels\n" * 50}[damage])
    with pytest.raises(LabelsError, match="remove it and generate again"):
        load_scene(path)


def test_scenes_are_read_in_order_from_every_folder(tmp_path: Path) -> None:
    view = labelled_view(count=30)
    for name in ("b/scene_0000001.npz", "b/scene_0000000.npz", "a/deep/scene_0000005.npz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        save_scene(tmp_path / name, {}, [view])
    files = scene_files([tmp_path / "b", tmp_path / "a"])
    assert [path.name for path in files] == ["scene_0000000.npz", "scene_0000001.npz", "scene_0000005.npz"]
    assert sum(1 for _ in load_views([tmp_path], PreparationConfig())) == 3
    with pytest.raises(LabelsError, match="python -m training generate"):
        scene_files([tmp_path / "c"])


def test_folds_hold_every_scene_once_and_each_leaves_its_own_out(tmp_path: Path) -> None:
    write(tmp_path, [labelled_view(number, count=30) for number in range(5)])
    everything, folds = scene_files([tmp_path]), [Fold(index, 3) for index in range(3)]
    kept = [scene_files([tmp_path], leave_out=fold) for fold in folds]
    assert [[int(path.stem[-7:]) for path in files] for files in kept] == [[1, 2, 4], [0, 2, 3], [0, 1, 3, 4]]
    assert [[fold.holds(path) for fold in folds].count(True) for path in everything] == [1] * 5
    stored = StoredViews([tmp_path], PreparationConfig(), lambda _: True, folds[0])
    assert torch.equal(stored[2].poses, load_scene(everything[4])[1][0].poses)
    assert len(stored) == 3


def test_stored_views_are_those_of_the_files_and_are_not_kept(tmp_path: Path) -> None:
    for number in range(3):
        views = [labelled_view(number, count=30, positives=3 * number + step) for step in range(2)]
        save_scene(tmp_path / f"scene_{number}.npz", {}, views)
    stored = StoredViews([tmp_path], PreparationConfig(), lambda success: int(success.sum()) >= 3)
    loaded = [view for view in load_views([tmp_path], PreparationConfig()) if int(view.success.sum()) >= 3]
    assert len(stored) == len(loaded) == 4
    assert (stored.labels, stored.successes) == (120, 3 + 4 + 6 + 7)
    for index in (2, 0, 3, 1):
        one, other = stored[index], loaded[index]
        for name in ("poses", "widths", "approach", "contact", "outcomes", "collision_free"):
            assert torch.equal(getattr(one, name), getattr(other, name))
        for name in ("points", "normals", "neighbours", "spectrum", "view_directions"):
            assert torch.equal(getattr(one.cloud, name), getattr(other.cloud, name))
    kept = weakref.ref(stored[0].cloud.points)
    gc.collect()
    assert kept() is None


def test_a_file_that_is_damaged_later_is_refused_when_its_view_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path, [labelled_view(count=30)]) / "scene_0000000.npz"
    stored = StoredViews([tmp_path], PreparationConfig(), lambda _: True)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(LabelsError, match="remove it and generate again"):
        stored[0]
    with pytest.raises(LabelsError, match="remove it and generate again"):
        StoredViews([tmp_path], PreparationConfig(), lambda _: True)


def test_writing_leaves_no_temporary_file(tmp_path: Path) -> None:
    write(tmp_path, [labelled_view(count=30)])
    assert [path.name for path in tmp_path.iterdir()] == ["scene_0000000.npz"]


def test_clouds_of_another_preparation_are_refused(tmp_path: Path) -> None:
    fine = PreparationConfig(voxel_size=0.0025)
    save_scene(tmp_path / "scene_0.npz", {}, [labelled_view(count=30)], fine)
    assert len(list(load_views([tmp_path], fine))) == 1
    with pytest.raises(LabelsError, match=r"voxel_size is 0\.0025, not 0\.0045\); .*unpack --model NAME"):
        list(load_views([tmp_path], PreparationConfig()))


@pytest.mark.parametrize("name", asdict(PreparationConfig()))
def test_clouds_that_differ_in_any_part_of_their_preparation_are_refused(tmp_path: Path, name: str) -> None:
    """Such as normals of 16 neighbours, where the service fits them to 14."""
    value = asdict(PreparationConfig())[name]
    other = 2 if value is None else value + 2
    save_scene(tmp_path / "scene_0.npz", {}, [labelled_view(count=30)], PreparationConfig(**{name: other}))
    with pytest.raises(LabelsError, match=f"{name} is {other}, not {value}"):
        list(load_views([tmp_path], PreparationConfig()))
