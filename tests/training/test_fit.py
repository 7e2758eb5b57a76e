from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tesnet import networks, weights
from tesnet.predictor import GraspPredictor
from tests.tesnet.scenes import tabletop_query
from tests.training.synthetic import labelled_view, write
from training import fit as fitting
from training.__main__ import main
from training.evaluate import evaluate
from training.fit import PRESETS, Recipe, fit
from training.views import LabelsError

RECIPE = Recipe(max_epochs=2, views_per_step=2, candidates_per_view=30)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three usable training views, one with too few successes, one without failures; one validation view."""
    root = tmp_path_factory.mktemp("labels")
    views = [labelled_view(0), labelled_view(1), labelled_view(2)]
    write(root / "train", [*views, labelled_view(3, positives=9), labelled_view(4, positives=60)])
    write(root / "validation", [labelled_view(5)])
    return root


def run(folder: Path, out: Path, recipe: Recipe = RECIPE, **options: Any) -> dict[str, object]:
    return fit("tesnet", [folder / "train"], [folder / "validation"], recipe, out, threads=1, **options)


def test_a_stopped_run_goes_on_from_its_checkpoint(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "whole.safetensors")
    run(folder, tmp_path / "parts.safetensors", epochs=1)
    run(folder, tmp_path / "parts.safetensors")
    whole, parts = (
        [json.loads(line) for line in (tmp_path / f"{name}.log.jsonl").read_text().splitlines()]
        for name in ("whole", "parts")
    )
    assert [entry["epoch"] for entry in whole] == [entry["epoch"] for entry in parts] == [1, 2]
    for first, second in zip(whole, parts, strict=True):
        assert first["train_loss"] == pytest.approx(second["train_loss"], abs=1e-5)
        assert first["balanced_loss"] == pytest.approx(second["balanced_loss"], abs=1e-5)
    first_state, header = weights.load(tmp_path / "whole.safetensors")
    second_state, _ = weights.load(tmp_path / "parts.safetensors")
    for name, tensor in first_state.items():
        torch.testing.assert_close(tensor, second_state[name], atol=1e-5, rtol=0)

    assert header.network == "tesnet"
    assert header.training["data"]["scenes"] == 5
    # Views with fewer than ten successes or without failures are left out.
    assert header.training["data"]["views"] == 3
    result = GraspPredictor.load(tmp_path / "whole.safetensors").predict(tabletop_query())
    assert len(result.grasps) > 0
    measured = evaluate("tesnet", tmp_path / "whole.safetensors", [folder / "validation"])
    assert measured["all"]["candidates"] == 60
    assert measured["all"]["balanced_loss"] == pytest.approx(header.training["validation"]["balanced_loss"], abs=1e-4)
    assert set(measured) == {"weights_sha256", "all", "packed"}


def test_a_checkpoint_of_another_recipe_is_refused(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "a.safetensors", epochs=1)
    for options in ({"recipe": replace(RECIPE, learning_rate=1e-3)}, {"seed": 1}):
        with pytest.raises(LabelsError, match=r"a\.checkpoint is of another recipe or seed"):
            run(folder, tmp_path / "a.safetensors", **options)


def test_training_begins_with_given_weights(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "first.safetensors", epochs=1)
    still = replace(RECIPE, learning_rate=1e-12, weight_decay=0.0, max_epochs=1)
    run(folder, tmp_path / "second.safetensors", still, start=tmp_path / "first.safetensors")
    first, second = (weights.load(tmp_path / f"{name}.safetensors")[0] for name in ("first", "second"))
    for name, tensor in first.items():
        torch.testing.assert_close(tensor, second[name], atol=1e-6, rtol=0)


@pytest.mark.parametrize("shown", [0.2, 0.5])
def test_a_logit_of_zero_is_an_even_chance_at_a_balanced_prior(shown: float) -> None:
    view = labelled_view(count=60, positives=round(60 * shown))
    logit = torch.zeros((), requires_grad=True)
    network = SimpleNamespace(
        encode_batch=lambda clouds: [None],
        score=lambda features, cloud, candidates, mirror: logit.expand(len(candidates)),
    )
    log_odds = math.log(shown / (1 - shown))
    recipe = replace(RECIPE, candidates_per_view=60)
    fitting._view_loss(network, view, log_odds, recipe, np.random.default_rng(0)).backward()  # type: ignore[arg-type]
    assert logit.grad is not None
    assert float(logit.grad) == pytest.approx(0, abs=1e-6)


def test_weights_with_fewer_inputs_are_begun_with_and_others_refused(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "now.safetensors", epochs=1)
    state, header = weights.load(tmp_path / "now.safetensors")
    older = {**state, "candidate.weight": state["candidate.weight"][:, :-3]}
    weights.save(tmp_path / "older.safetensors", older, header)
    network = networks.build("tesnet")
    fitting._begin_with(tmp_path / "older.safetensors", "tesnet", network)
    begun = network.state_dict()["candidate.weight"]
    assert torch.equal(begun[:, :-3], state["candidate.weight"][:, :-3])
    assert not begun[:, -3:].any()
    weights.save(tmp_path / "narrow.safetensors", {**state, "lift.weight": state["lift.weight"][:-1]}, header)
    with pytest.raises(LabelsError, match="of another configuration; begin without --start"):
        fitting._begin_with(tmp_path / "narrow.safetensors", "tesnet", network)


def test_training_learns_the_training_views(folder: Path, tmp_path: Path) -> None:
    recipe = replace(RECIPE, max_epochs=12, cosine=False, learning_rate=3e-3, views_per_step=1)
    run(folder, tmp_path / "a.safetensors", recipe)
    log = [json.loads(line) for line in (tmp_path / "a.log.jsonl").read_text().splitlines()]
    assert log[-1]["train_loss"] < 0.8 * log[0]["train_loss"]


def test_labels_without_a_usable_view_are_refused(tmp_path: Path, folder: Path) -> None:
    write(tmp_path / "train", [labelled_view(0, positives=9)])
    with pytest.raises(LabelsError, match="10 successes and a failure; generate more"):
        fit("tesnet", [tmp_path / "train"], [folder / "validation"], RECIPE, tmp_path / "a.safetensors", threads=1)
    with pytest.raises(LabelsError, match="10 successes"):
        fit("tesnet", [folder / "train"], [tmp_path / "train"], RECIPE, tmp_path / "a.safetensors", threads=1)


def test_the_learning_rate_is_halved_after_stagnant_epochs() -> None:
    recipe = replace(PRESETS["paper"], patience=2)
    progress = fitting._Progress({}, 0, learning_rate=1e-4, best_loss=0.5)
    rates = []
    for loss in (0.4, 0.6, 0.6, 0.6, 0.6, 0.3):
        fitting._schedule(recipe, progress, loss)
        progress.best_loss = min(progress.best_loss, loss)
        rates.append(progress.learning_rate)
    np.testing.assert_allclose(rates, [1e-4, 1e-4, 5e-5, 5e-5, 2.5e-5, 2.5e-5])


def test_the_papers_recipe_is_a_preset() -> None:
    paper = PRESETS["paper"]
    assert (paper.optimiser, paper.patience, paper.cosine) == ("adam", 6, False)


def test_the_command_says_what_is_wrong_with_its_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {"--data": tmp_path / "none", "--validation": tmp_path, "--out": tmp_path / "a", "--threads": 1}
    assert main(["fit", *(str(word) for pair in paths.items() for word in pair)]) == 2
    assert "python -m training generate" in capsys.readouterr().err
