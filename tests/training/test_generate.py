from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from simharness.sim.outcomes import OUTCOME_KINDS
from simharness.sim.protocol import query_about
from tesnet import weights
from tesnet.cloud import prepare
from tesnet.hands import HANDS
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from training import generate as generating
from training.archive import pack
from training.generate import GenerateConfig, generate
from training.views import LabelsError, load_scene, scene_files

pytestmark = pytest.mark.sim

CONFIG = GenerateConfig("packed", "procedural-train", seed=5, views=1, labels_per_view=6, colliding_share=0.5)


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A handful of labels, really simulated."""
    out = tmp_path_factory.mktemp("generate") / "first"
    generate(CONFIG, 1, 1, out)
    return out


def arrays(path: Path) -> dict[str, bytes]:
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name].tobytes() for name in stored.files}


def test_labels_come_with_all_that_is_needed_to_see_the_scene_again(labels: Path) -> None:
    account = json.loads((labels / "account.json").read_text())
    files = scene_files([labels])
    assert account["scenes"] == len(files)
    assert account["labels"] == sum(account["outcomes"].values()) >= 1
    assert list(account["outcomes"]) == list(OUTCOME_KINDS)
    total = 0
    for path in files:
        description, views = load_scene(path)
        assert {"seed", "number", "cameras"} <= set(description)
        assert len(views) <= 1
        for view in views:
            total += len(view.outcomes)
            assert len(view.outcomes) <= 6
            assert view.scene == "packed"
            assert view.outcomes.max() < len(OUTCOME_KINDS)
            assert int((~view.collision_free).sum()) <= 3
    assert total == account["labels"]


def test_a_second_run_gives_equal_labels_and_a_longer_one_goes_on(labels: Path, tmp_path: Path) -> None:
    generate(CONFIG, 1, 1, tmp_path / "second")
    first, second = scene_files([labels]), scene_files([tmp_path / "second"])
    assert [path.name for path in first] == [path.name for path in second]
    for one, other in zip(first, second, strict=True):
        assert arrays(one) == arrays(other)

    before = {path.name: path.stat().st_mtime_ns for path in second}
    account = json.loads((tmp_path / "second" / "account.json").read_text())
    longer = generate(CONFIG, account["labels"] + 1, 1, tmp_path / "second", resume=True)
    assert longer["labels"] > account["labels"]
    assert longer["scenes"] > account["scenes"]
    after = {path.name: path.stat().st_mtime_ns for path in scene_files([tmp_path / "second"])}
    assert {name: after[name] for name in before} == before


def test_labels_show_the_clouds_as_the_service_prepares_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit, so that no network learns from normals of another neighbourhood than it is served."""
    queries: list[GraspQuery] = []

    def noted(*arguments: Any) -> GraspQuery:
        queries.append(query_about(*arguments))
        return queries[-1]

    monkeypatch.setattr(generating, "query_about", noted)
    _, (view,) = generating.label_scene(CONFIG, generating.object_sets(CONFIG), 0)
    served = prepare(queries[0], GraspPredictor.load(weights.default_weights()).preparation, torch.device("cpu"))
    assert served is not None
    for name in ("points", "normals", "spectrum", "neighbours", "view_directions"):
        assert torch.equal(getattr(view.cloud, name), getattr(served, name))


def test_more_workers_make_the_same_scenes(labels: Path, tmp_path: Path) -> None:
    generate(CONFIG, 1, 2, tmp_path / "two")
    one, two = scene_files([labels]), scene_files([tmp_path / "two"])
    assert [path.name for path in two] == [path.name for path in one]
    assert [arrays(path) for path in two] == [arrays(path) for path in one]


def test_a_folder_of_labels_is_not_taken_over_unasked(labels: Path) -> None:
    with pytest.raises(LabelsError, match="add --resume"):
        generate(CONFIG, 1, 1, labels)


def test_a_folder_of_other_settings_is_refused(labels: Path) -> None:
    with pytest.raises(LabelsError, match=r"other settings \(seed: 5\)"):
        generate(replace(CONFIG, seed=6), 1, 1, labels, resume=True)


def test_labels_of_another_hand_say_so_and_keep_its_poses(tmp_path: Path) -> None:
    generate(replace(CONFIG, gripper="rg2", scene="pile", labels_per_view=4), 1, 1, tmp_path)
    views = [view for path in scene_files([tmp_path]) for view in load_scene(path)[1]]
    assert {view.gripper for view in views} == {"rg2"}
    view = next(view for view in views if len(view.outcomes))
    hand = HANDS["rg2"].gripper
    p_a, p_c, closing, travel = view.pairs.double().unbind(dim=1)
    d = p_c - p_a
    closed = 2 * (d * closing).sum(dim=1).clamp(0, hand.max_width / 2)
    tips = (d * travel).sum(dim=1) + 0.007  # past the approach point, once the hand has closed
    expected = p_a + (tips - hand.tip_offset - hand.tcp_at(closed) + hand.hand_to_tcp)[:, None] * travel
    np.testing.assert_allclose(view.candidates.Ts_canonical_grasp[:, :3, 3], expected, atol=1e-5)
    with pytest.raises(LabelsError, match="labels of rg2; an archive keeps those of franka alone"):
        pack([tmp_path], tmp_path / "archive")


def test_tables_may_hold_more_things_of_other_weight_and_grip(tmp_path: Path) -> None:
    varied = replace(CONFIG, scale=(0.4, 0.6), mass=(0.05, 0.1), friction=(0.3, 0.4), things=9, seed=1)
    generate(varied, 1, 1, tmp_path)
    description, _ = load_scene(scene_files([tmp_path])[0])
    for item in description["objects"]:
        assert 0.4 <= item["scale"] <= 0.6
        assert 0.05 <= item["mass"] <= 0.1
        assert 0.3 <= item["friction"] <= 0.4
    # The folder knows its settings again, written and read.
    generate(varied, 1, 1, tmp_path, resume=True)
    with pytest.raises(LabelsError, match="other settings"):
        generate(replace(varied, things=8), 1, 1, tmp_path, resume=True)
