"""A short run of `python -m bench.frames`, and what it counts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench import frames
from bench.rooms import Truth, cabinet, overhead, photograph, small_table, table
from tesnet.geometry import PANDA

SQUARE = Truth(np.array([0.0, 0.0, 1.0]), 0.1, np.array([[0, 0, 0.1], [1, 0, 0.1], [1, 1, 0.1], [0, 1, 0.1]]))


def test_grasps_of_bare_frames_lie_on_things_of_the_table_and_hold_nothing(
    tmp_path: Path, service_url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(5)
    rooms = {"cabinet": cabinet(rng), "overhead": overhead(rng), "small": small_table(rng), "table": table(rng)}
    frames.write_frames(
        tmp_path, ((name, photograph(room, (320, 240), 0.001, rng, 0.8)) for name, room in rooms.items())
    )
    out = tmp_path / "counts.out"
    frames.main([str(tmp_path), "--bare", "--url", service_url, "--out", str(out)])
    counts = json.loads(out.read_text(encoding="utf-8"))
    assert [one["name"] for one in counts] == ["cabinet", "overhead", "small", "table"]
    assert sum(one["grasps"] for one in counts) == 40
    assert sum(one["colliding"] for one in counts) == 0
    assert sum(one["on_things"] for one in counts) >= 36
    assert all(any("up auto" in note for note in one["warnings"]) for one in counts)
    assert "on things" in capsys.readouterr().out


def test_truth_may_stand_in_the_options_or_beside_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames.write_frames(tmp_path, iter([("one", photograph(overhead(rng), (64, 48), 0.0, rng))]))
    (inside,) = frames.read_frames(tmp_path)
    options = json.loads((tmp_path / "one.json").read_text(encoding="utf-8"))
    (tmp_path / "one.truth.json").write_text(json.dumps(options.pop("truth")), encoding="utf-8")
    (tmp_path / "one.json").write_text(json.dumps(options), encoding="utf-8")
    (beside,) = frames.read_frames(tmp_path)
    assert inside.truth is not None
    assert beside.truth is not None
    np.testing.assert_array_equal(inside.truth.outline, beside.truth.outline)
    assert "truth" not in inside.options
    assert set(beside.bare().options) == {"intrinsics", "depth_scale", "stride"}


def test_a_folder_without_frames_says_how_to_write_some(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="--generate"):
        frames.read_frames(tmp_path)


def test_points_on_the_surface_are_over_its_outline_and_not_too_high() -> None:
    points = np.array([[0.5, 0.5, 0.2], [0.5, 0.5, 0.102], [0.5, 0.5, 0.46], [1.1, 0.5, 0.2], [0.5, -0.1, 0.2]])
    assert frames.on_surface(points, SQUARE).tolist() == [True, False, False, False, False]


def test_a_hand_holds_points_that_are_four_millimetres_under_its_surface() -> None:
    pose, width = np.eye(4), 0.08
    pad = width / 2
    palm = next(part for part in PANDA.parts if not part.side)
    across = np.linspace(-0.002, 0.002, 12)
    between = np.column_stack([across, np.zeros(12), np.zeros(12)])
    deep = np.column_stack([across, np.full(12, pad + 0.008), np.full(12, -0.02)])
    shallow = np.column_stack([across, np.full(12, pad + 0.002), np.full(12, -0.02)])
    in_palm = np.column_stack([across, np.zeros(12), np.full(12, palm.front - 0.02)])
    held = [frames.held_points(points, pose, width) for points in (between, deep, shallow, in_palm)]
    assert held == [0, 12, 0, 12]
    pose[:3, 3] = [0.3, -0.2, 0.5]
    assert frames.held_points(deep + pose[:3, 3], pose, width) == 12
