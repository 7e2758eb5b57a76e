from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tesnet.geometry import PANDA, Pose
from training.hands import random_hand
from training.parts import LENGTH, ArchivedScene, ArchivedView, keys_of, read_part, write_part
from training.viewing import Viewing

OLD = [Path(__file__).parent / "data" / f"old_labels_{number}.npz" for number in ("000", "004")]
"""The first scenes of parts as versions before 0.6.0 wrote them, the oldest without pairs that travel straight down."""


def view(seed: int, count: int = 40) -> ArchivedView:
    """Poses of any kind beside pairs of any kind: a part knows no rule that makes one of the other."""
    rng = np.random.default_rng(seed)
    hand = random_hand(rng).gripper
    places = rng.uniform(0.0, 0.3, (count, 1, 3)) + rng.normal(0.0, 0.01, (count, 2, 3))
    places[: count // 4, 1] = places[: count // 4, 0]  # no depth
    poses = np.stack([Pose.random(rng).matrix for _ in range(count)])
    poses[:, :3, 3] += places[:, 0] + rng.uniform(-0.05, 0.05, (count, 3)) - poses[:, :3, 3]
    cameras = tuple(Pose.random(rng) for _ in range(1 + seed % 3))
    viewing = Viewing(cameras, ("random", "d435")[seed % 2], int(rng.integers(2**32)), "open")
    kinds = rng.integers(5, size=count).astype(np.uint8)
    return ArchivedView(viewing, hand, places, poses, rng.uniform(0, hand.max_width, count), kinds, kinds > 2)


def scene(number: int, **more: Any) -> ArchivedScene:
    item: dict[str, Any] = {
        "name": "a",
        "scale": 0.75,
        "position": [0.125, 0.25, 0.0625],
        "quaternion_xyzw": [0, 0, 0, 1.0],
    }
    light = {**item, "name": "b", "mass": 0.125, "friction": 0.5}
    description = {"kind": "pile", "seed": 7, "number": number, "objects": [item, light]}
    return ArchivedScene({**description, **more}, tuple(view(3 * number + step) for step in range(number % 3)))


def by_place(some: ArchivedView) -> list[Any]:
    """Candidates by what tells them apart."""
    keys = np.round(some.places[:, 0] / LENGTH).astype(int).tolist()
    rows = zip(keys, some.places, some.Ts_world_grasp, some.widths, some.outcomes, some.collision_free, strict=True)
    return sorted(rows, key=lambda row: row[0])


def test_everything_comes_back_as_exactly_as_is_said(tmp_path: Path) -> None:
    scenes = [scene(number, seed=7 * (number % 2)) for number in range(5)]
    write_part(tmp_path / "labels_000.npz", scenes)
    again = list(read_part(tmp_path / "labels_000.npz"))
    assert [one.description for one in again] == [one.description for one in scenes]
    compared = 0
    for before, after in zip(scenes, again, strict=True):
        for old, new in zip(before.views, after.views, strict=True):
            assert new.gripper == old.gripper
            assert (new.viewing.sensor, new.viewing.seed, new.viewing.shows) == (
                old.viewing.sensor, old.viewing.seed, old.viewing.shows,
            )  # fmt: skip
            for camera, same in zip(old.viewing.cameras, new.viewing.cameras, strict=True):
                np.testing.assert_allclose(same.matrix, camera.matrix, atol=1e-6)
            for one, other in zip(by_place(old), by_place(new), strict=True):
                compared += 1
                np.testing.assert_allclose(other[1], one[1], atol=0.51e-4)
                np.testing.assert_allclose(other[2][:3, 3], one[2][:3, 3], atol=0.9e-4)
                # Half a step of each of two angles and of the turn.
                angle = np.arccos(np.clip((np.trace(other[2][:3, :3].T @ one[2][:3, :3]) - 1) / 2, -1, 1))
                assert np.rad2deg(angle) < 0.05 + 0.05 + 0.1
                assert abs(other[3] - one[3]) <= 0.51e-4
                assert other[4:] == one[4:]
    assert compared > 100


def test_equal_scenes_make_equal_files_that_name_their_scenes(tmp_path: Path) -> None:
    for name in ("labels_000.npz", "labels_001.npz"):
        write_part(tmp_path / name, [scene(1), scene(2)])
    assert (tmp_path / "labels_000.npz").read_bytes() == (tmp_path / "labels_001.npz").read_bytes()
    assert keys_of(tmp_path / "labels_000.npz") == {(7, "pile", 1), (7, "pile", 2)}


def test_scenes_without_a_number_are_kept_too(tmp_path: Path) -> None:
    known = scene(1)
    unnamed = replace(known, description={"kind": "packed", "objects": known.description["objects"]})
    write_part(tmp_path / "labels_000.npz", [unnamed])
    (again,) = read_part(tmp_path / "labels_000.npz")
    assert again.key is None
    assert again.description == unnamed.description
    assert keys_of(tmp_path / "labels_000.npz") == set()


@pytest.mark.parametrize("path", OLD, ids=lambda path: path.stem)
def test_parts_of_pairs_alone_are_read(path: Path) -> None:
    """Poses follow from pairs."""
    assert keys_of(path) == set()
    views = [view for scene in read_part(path) for view in scene.views]
    assert len(views) == 14
    for some in views:
        assert some.gripper == PANDA
        assert (some.widths == PANDA.max_width).all()
        p_a, p_c = some.places[:, 0], some.places[:, 1]
        y, z = some.Ts_world_grasp[:, :3, 1], some.Ts_world_grasp[:, :3, 2]
        np.testing.assert_allclose((y * z).sum(axis=1), 0, atol=1e-6)
        tips = ((p_c - p_a) * z).sum(axis=1) + 0.007 - PANDA.tip_offset
        np.testing.assert_allclose(some.Ts_world_grasp[:, :3, 3], p_a + tips[:, None] * z, atol=1e-6)
        inside = np.abs(p_a - 0.15) < 0.16
        assert inside.all()
