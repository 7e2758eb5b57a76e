"""What the second look learns from, and that it learns it while the rest of the network stays as it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from simharness.sim.objects import load_object_set
from simharness.sim.outcome_kinds import OUTCOME_KINDS
from simharness.sim.scene import restore_scene
from simharness.sim.world import World
from tesnet import networks, weights
from tesnet.candidates import at_rest
from tesnet.networks.second_look import INPUTS, seen_by_fingers
from tesnet.networks.tesnet import TesNet
from training import second_look
from training.archive import pack, render_view
from training.generate import GenerateConfig
from training.generate import generate as make_labels
from training.parts import read_part
from training.views import Fold, LabelsError

SHIPPED = weights.default_weights()
SUCCESS, APPROACH, DROP = (OUTCOME_KINDS.index(kind) for kind in ("success", "approach", "drop"))


@pytest.mark.sim
def test_samples_are_what_fingers_see_of_free_candidates_with_the_first_looks_logits(tmp_path: Path) -> None:
    config = GenerateConfig("packed", "procedural-train", seed=5, labels_per_view=20)
    make_labels(config, labels=60, workers=1, out=tmp_path / "labels")
    pack([tmp_path / "labels"], tmp_path / "archive")
    state, header = weights.load(SHIPPED)
    surer = {name: tensor + float(name == "head.3.bias") for name, tensor in state.items()}
    weights.save(tmp_path / "surer.safetensors", surer, header)
    files_of_folds = [SHIPPED, tmp_path / "surer.safetensors"]
    asked = (files_of_folds, tmp_path / "archive", "procedural-train", tmp_path / "samples")
    told = second_look.sample(*asked)
    files = sorted((tmp_path / "samples").iterdir())
    assert len(files) == told["scenes"] > 1
    first = second_look._first_look(SHIPPED)
    models = {model.name: model for model in load_object_set("procedural-train", "packed")}
    for index, (file, scene) in enumerate(zip(files, read_part(next((tmp_path / "archive").iterdir())), strict=True)):
        with World() as world, np.load(file) as stored:
            restore_scene(world, scene.description, models)
            for number, archived in enumerate(scene.views):
                view = render_view(world, archived, first.preparation)
                assert view is not None
                free, mine = view.only(view.collision_free), stored["views"] == number
                logits = first.score(networks.encode(first, free.cloud), free.cloud, free.candidates)
                order = logits.argsort(descending=True)
                seen = seen_by_fingers(free.cloud, at_rest(free.cloud, free.candidates.select(order)))
                np.testing.assert_allclose(stored["logits"][mine], logits[order].numpy() + index % 2, atol=1e-3)
                np.testing.assert_array_equal(stored["outcomes"][mine], free.outcomes[order].numpy())
                assert (torch.from_numpy(stored["seen"][mine]).float() - seen).abs().mean() < 1e-3
    before = [file.stat().st_mtime_ns for file in files]
    assert second_look.sample(*asked) == told
    assert [file.stat().st_mtime_ns for file in files] == before


def test_weights_of_another_fold_are_not_asked_about_scenes_that_they_were_taught(tmp_path: Path) -> None:
    state, header = weights.load(SHIPPED)
    files = [tmp_path / f"{index}.safetensors" for index in range(2)]
    for index, file in enumerate(files):
        training = {"data": {"leave_out": {"index": index, "count": 2}}}
        weights.save(file, state, replace(header, training=training))
        second_look._check_fold(file, Fold(index, 2))
    second_look._check_fold(files[1], Fold(0, 1))
    second_look._check_fold(SHIPPED, Fold(1, 2))
    with pytest.raises(LabelsError, match=r"without fold 1/2 and is to score 0/2; give the weights of all"):
        second_look.sample(files[::-1], tmp_path, "procedural-train", tmp_path / "samples")


def write_samples(folder: Path, scenes: int = 40, each: int = 120) -> None:
    """Grasps that hold where both pads meet something, of which the first look knows nothing."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(scenes):
        seen = rng.normal(0, 0.05, (each, INPUTS))
        holds = rng.random(each) < 0.7
        seen[:, : INPUTS // 2 : 5] += holds[:, None]
        outcomes = np.where(rng.random(each) < 0.2, APPROACH, np.where(holds, SUCCESS, DROP)).astype(np.uint8)
        np.savez(
            folder / f"looks_{number:07d}.npz",
            seen=seen.astype(np.float16), logits=rng.normal(1.0, 0.2, each).astype(np.float32), outcomes=outcomes,
            views=np.zeros(each, np.int64),
        )  # fmt: skip
    nothing = np.zeros((0, INPUTS))
    np.savez(folder / "looks_0000099.npz", seen=nothing, logits=nothing, outcomes=nothing, views=nothing)


def test_the_fit_finds_what_holds_and_leaves_the_first_look_alone(tmp_path: Path) -> None:
    write_samples(tmp_path / "samples")
    told = second_look.fit(SHIPPED, tmp_path / "samples", tmp_path / "w.safetensors", epochs=3, version="8")
    before, after = told["held_out"]["before"], told["held_out"]["after"]
    assert told["held_out"]["candidates"] == 240
    assert told["samples"] == 4560
    assert before["auroc"] < 0.6
    assert after["auroc"] > 0.75
    assert after["served_loss"] < before["served_loss"]
    network, header = networks.load(tmp_path / "w.safetensors")
    shipped, plain = networks.load(SHIPPED)
    assert isinstance(network, TesNet)
    assert isinstance(shipped, TesNet)
    assert (header.version, network.config.second_look) == ("8", second_look.BEST)
    assert header.calibration == plain.calibration
    assert header.configuration["candidates"] == plain.configuration["candidates"]
    for name, tensor in second_look._first_look(SHIPPED).state_dict().items():
        if not name.startswith("second_look."):
            torch.testing.assert_close(network.state_dict()[name], tensor)
    again = second_look.fit(SHIPPED, tmp_path / "samples", tmp_path / "again.safetensors", epochs=3, version="8")
    assert again == told


def test_the_best_of_each_view_counts_once() -> None:
    views, logits = torch.tensor([7, 7, 3, 3, 9]), torch.tensor([0.1, 0.4, 2.0, 1.0, -3.0])
    success = torch.tensor([True, False, True, False, True])
    assert second_look._best_of_views(logits, views, success) == pytest.approx(2 / 3)


def test_without_samples_there_is_nothing_to_fit_and_other_networks_look_once(tmp_path: Path) -> None:
    with pytest.raises(LabelsError, match="holds no looks"):
        second_look.fit(SHIPPED, tmp_path, tmp_path / "w.safetensors")
    with pytest.raises(LabelsError, match="only that network looks twice"):
        second_look._first_look(weights.default_weights("gatv2"))
