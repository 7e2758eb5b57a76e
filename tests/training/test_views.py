from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tesnet.candidates import CandidateConfig, generate, poses_along
from tesnet.cloud import PreparationConfig
from tesnet.geometry import PANDA
from tests.tesnet.scenes import CAMERA, UP, ask, box_surface, prepared, seen_from, tabletop_query
from tests.training.synthetic import labelled_view, write
from training.views import LabelsError, load_scene, load_views, pairs_of, save_scene, scene_files


def test_labels_round_trip(tmp_path: Path) -> None:
    first = replace(labelled_view(0), collision_free=torch.arange(60) % 3 > 0)
    second = replace(labelled_view(1, count=40), sensor="d435")
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
        torch.testing.assert_close(stored[:, :3, 3], tried[:, :3, 3], atol=2e-3, rtol=0)
        cosines = (stored[:, :3, 1] * tried[:, :3, 1]).sum(dim=1)
        assert cosines.min() > 0.999
        facing = (after.cloud.normals * after.cloud.view_directions).sum(dim=1)
        assert (facing >= 0).all()
        agree = (after.cloud.normals * before.cloud.normals).sum(dim=1)
        assert agree.min() > 0.999
        torch.testing.assert_close(after.cloud.spectrum, before.cloud.spectrum, atol=1e-3, rtol=0)
        assert before.cloud.up is not None
        assert after.cloud.up is not None
        torch.testing.assert_close(after.cloud.up, before.cloud.up)
        assert after.cloud.support_height == before.cloud.support_height
        assert len(after.cloud.sides) == 4
        assert torch.equal(after.cloud.sides, before.cloud.sides)
        np.testing.assert_array_equal(after.cloud.T_cloud_canonical.matrix, before.cloud.T_cloud_canonical.matrix)


def test_pairs_of_hands_that_stop_short_give_their_poses_again() -> None:
    points, normals = box_surface((0.05, 0.07, 0.0105), 60_000, np.random.default_rng(0))
    seen = seen_from(points + 0.00525 * UP, normals, CAMERA)
    low = ask(seen, viewpoints=CAMERA, up=UP, support_height=0.0)
    for query, stops_short in ((low, True), (tabletop_query(), False)):
        cloud = prepared(query)
        found, _ = generate(cloud, query, CandidateConfig())
        pairs = pairs_of(cloud, found, PANDA)
        again = poses_along(*pairs.unbind(dim=1))
        torch.testing.assert_close(again, found.Ts_canonical_grasp, atol=1.1e-5, rtol=0)
        moved = (pairs[:, 1] - cloud.points[found.contact]).norm(dim=1)
        assert (float(moved.max()) > 0.001) == stops_short


def test_poses_of_shallow_pairs_round_trip(tmp_path: Path) -> None:
    """Their direction of travel does not follow from their points, which may even be one and the same."""
    view = labelled_view(count=30)
    assert view.cloud.up is not None
    pairs = view.pairs.clone()
    pairs[:, 1] = pairs[:, 0]
    pairs[:, 2] = torch.linalg.cross(view.cloud.up.expand(30, 3), torch.randn(30, 3))
    pairs[:, 2] /= pairs[:, 2].norm(dim=1, keepdim=True)
    pairs[:, 3] = -view.cloud.up
    shallow = replace(view, pairs=pairs)
    save_scene(tmp_path / "scene_0.npz", {}, [shallow])
    (stored,) = load_scene(tmp_path / "scene_0.npz")[1]
    poses = stored.candidates.Ts_canonical_grasp
    assert torch.equal(poses, shallow.candidates.Ts_canonical_grasp)
    torch.testing.assert_close(poses[:, :3, 2], -view.cloud.up.expand(30, 3))
    torch.testing.assert_close(poses[:, :3, 1], pairs[:, 2])


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
    save_scene(tmp_path / "scene_0.npz", {}, [labelled_view(count=30)], PreparationConfig(**{name: value + 2}))
    with pytest.raises(LabelsError, match=f"{name} is {value + 2}, not {value}"):
        list(load_views([tmp_path], PreparationConfig()))
