from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from tesnet import networks, weights
from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.predictor import GraspPredictor, configuration_of
from tesnet.threads import Threads
from tests.tesnet.scenes import tabletop_query
from tests.training.synthetic import labelled_view, write
from training import evaluate as evaluating
from training import fit as fitting
from training import metrics
from training.evaluate import evaluate
from training.fit import PRESETS, Recipe, fit
from training.views import Fold, LabelledView, LabelsError, StoredViews, load_views, save_scene

Shown = tuple[PreparedCloud, Candidates, torch.Tensor]
"""A cloud, candidates of it and which of them are mirrored."""

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


def test_the_log_tells_the_seconds_of_each_epoch_by_itself(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock:
        now = 0.0

        def monotonic(self) -> float:
            self.now += 1.0
            return self.now

    monkeypatch.setattr(fitting, "time", Clock())
    run(folder, tmp_path / "a.safetensors", replace(RECIPE, max_epochs=3))
    seconds = [json.loads(line)["seconds"] for line in (tmp_path / "a.log.jsonl").read_text().splitlines()]
    assert seconds[0] > 0
    assert seconds == [seconds[0]] * 3


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
    assert set(measured) == {"weights_sha256", "all", "packed", "by_hand", "by_sensor", "by_width"}


def test_a_run_of_more_epochs_than_the_recipe_has_ends_with_the_recipe(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "a.safetensors", replace(RECIPE, max_epochs=1), epochs=3)
    log = (tmp_path / "a.log.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in log] == [1]


def test_a_run_that_is_stopped_within_an_epoch_ends_as_if_it_had_not_been(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = replace(RECIPE, views_per_step=1)
    run(folder, tmp_path / "whole.safetensors", recipe)
    monkeypatch.setattr(fitting, "CHECKPOINT_S", 0.0)
    view_loss, calls = fitting._view_loss, []

    def stops_in_the_second_epoch(*arguments: Any) -> torch.Tensor:
        calls.append(arguments)
        if len(calls) == 3 + 2:
            raise KeyboardInterrupt
        return view_loss(*arguments)

    monkeypatch.setattr(fitting, "_view_loss", stops_in_the_second_epoch)
    with pytest.raises(KeyboardInterrupt):
        run(folder, tmp_path / "parts.safetensors", recipe)
    run(folder, tmp_path / "parts.safetensors", recipe)
    assert len(calls) == 3 + 2 + 2  # the step that failed is taken again, the one before it is not
    whole, parts = (
        [json.loads(line) for line in (tmp_path / f"{name}.log.jsonl").read_text().splitlines()]
        for name in ("whole", "parts")
    )
    assert [entry["epoch"] for entry in parts] == [1, 2]
    for first, second in zip(whole, parts, strict=True):
        assert first["train_loss"] == pytest.approx(second["train_loss"], abs=1e-5)
    expected, _ = weights.load(tmp_path / "whole.safetensors")
    for name, tensor in weights.load(tmp_path / "parts.safetensors")[0].items():
        torch.testing.assert_close(tensor, expected[name], atol=1e-5, rtol=0)


def test_a_comparison_keeps_the_last_epoch_and_measures_all_candidates(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses = iter([0.3, 0.6])
    validate = evaluating.validate

    def worse_and_worse(*arguments: Any) -> Any:
        of_free, of_all = validate(*arguments)
        return of_free | {"served_loss": next(losses)}, of_all

    monkeypatch.setattr(fitting, "validate", worse_and_worse)
    for recipe, epoch in ((replace(RECIPE, keep="best"), 1), (replace(RECIPE, keep="last"), 2)):
        losses = iter([0.3, 0.6])
        run(folder, tmp_path / f"{epoch}.safetensors", recipe)
        training = weights.load(tmp_path / f"{epoch}.safetensors")[1].training
        assert training["epoch"] == epoch
        assert training["validation_with_blocked"]["candidates"] == 60
    assert PRESETS["comparison"].keep == "last"
    assert PRESETS["comparison"].blocked_per_view > 0


def test_every_recipe_begins_with_a_rate_that_adam_can_learn_at() -> None:
    assert all(1e-4 <= recipe.learning_rate <= 1e-2 for recipe in PRESETS.values())


@pytest.mark.parametrize("stopped", [False, True])
@pytest.mark.parametrize(("keep", "epoch"), [("best", 2), ("last", 4)])
def test_the_weights_kept_are_those_of_the_epoch_they_are_named_after(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: Any, epoch: int, stopped: bool
) -> None:
    """Every epoch changes the network; what it was when its validation loss was measured is noted."""
    losses = iter([0.5, 0.3, 0.6, 0.4])
    seen: list[dict[str, torch.Tensor]] = []

    def measured(network: torch.nn.Module, *_: Any) -> Any:
        seen.append({name: tensor.clone() for name, tensor in network.state_dict().items()})
        return {"served_loss": next(losses), "calibration": [float(len(seen)), 0.0]}, {}

    monkeypatch.setattr(fitting, "validate", measured)
    monkeypatch.setattr(fitting, "_view_loss", lambda network, *_: sum(p.square().sum() for p in network.parameters()))
    recipe = replace(RECIPE, max_epochs=4, keep=keep, learning_rate=1e-2, cosine=False)
    for epochs in (2, None) if stopped else (None,):
        run(folder, tmp_path / "a.safetensors", recipe, epochs=epochs)
    state, header = weights.load(tmp_path / "a.safetensors")
    assert header.training["epoch"] == epoch
    assert header.calibration == pytest.approx((epoch, 0.0))
    assert header.configuration["preparation"] == asdict(networks.build("tesnet").preparation)
    same = [all(torch.equal(tensor, state[name]) for name, tensor in then.items()) for then in seen]
    assert same == [number == epoch for number in range(1, 5)]


class Watched(torch.nn.Module):
    """A network of one parameter that remembers which candidates it is shown, and how."""

    def __init__(self) -> None:
        super().__init__()
        self.logit = torch.nn.Parameter(torch.zeros(()))
        self.shown: list[Shown] = []

    def encode_batch(self, clouds: list[PreparedCloud]) -> list[None]:
        return [None] * len(clouds)

    def score(self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: torch.Tensor) -> torch.Tensor:
        self.shown.append((cloud, candidates, mirror))
        return self.logit.expand(len(candidates))


def watched_epochs(
    views: list[LabelledView], recipe: Recipe, count: int, out: Path, seed: int = 0
) -> list[list[Shown]]:
    """What a network was shown in each of `count` epochs."""
    network, progress = Watched(), fitting._Progress({}, seed, recipe.learning_rate)
    epochs = []
    for _ in range(count):
        optimiser = torch.optim.SGD(network.parameters(), lr=recipe.learning_rate)
        fitting._epoch(network, optimiser, recipe, views, 0.5, progress, None, out, cores=Threads(1))  # type: ignore[arg-type]
        epochs.append(network.shown)
        network.shown = []
    return epochs


def test_every_epoch_shows_other_draws_and_a_seed_repeats_them(tmp_path: Path) -> None:
    """Order of the views, their turns, the candidates drawn and which of them are mirrored."""
    views = [labelled_view(seed) for seed in range(6)]
    recipe = replace(RECIPE, candidates_per_view=20)
    first, second = watched_epochs(views, recipe, 2, tmp_path / "a.checkpoint")
    again, _ = watched_epochs(views, recipe, 2, tmp_path / "a.checkpoint")
    other, _ = watched_epochs(views, recipe, 2, tmp_path / "a.checkpoint", seed=1)

    def order(shown: list[Shown]) -> list[int]:
        sizes = [len(view.cloud) for view in views]
        return [sizes.index(len(cloud)) for cloud, _, _ in shown]

    def of_view(shown: list[Shown], index: int) -> tuple[torch.Tensor, ...]:
        cloud, found, mirror = shown[order(shown).index(index)]
        pairs = torch.stack([found.approach, found.contact], dim=1)
        return cloud.points, torch.unique(pairs, dim=0), mirror

    assert sorted(order(first)) == sorted(order(second)) == list(range(6))
    assert order(first) != order(second)
    assert order(first) == order(again)
    for index in range(6):
        for one, two, three, four in zip(
            *(of_view(shown, index) for shown in (first, second, again, other)), strict=True
        ):
            assert torch.equal(one, three)
            assert not torch.equal(one, two)
            assert not torch.equal(one, four)
        assert set(of_view(first, index)[2].tolist()) == {-1.0, 1.0}
    # Nor do two views of an epoch share their draws.
    mirrors = [tuple(mirror.tolist()) for _, _, mirror in first]
    assert len(set(mirrors)) == len(mirrors)


class Sloping(torch.nn.Module):
    """A network of two parameters whose logits differ from cloud to cloud, and between training and judging."""

    def __init__(self, steepness: float) -> None:
        super().__init__()
        self.steepness = steepness
        self.slopes = torch.nn.Parameter(torch.tensor([0.3, -0.2]))
        self.was_training: list[bool] = []

    def encode_batch(self, clouds: list[PreparedCloud]) -> list[None]:
        return [None] * len(clouds)

    def score(self, features: None, cloud: PreparedCloud, candidates: Candidates, mirror: torch.Tensor) -> torch.Tensor:
        self.was_training.append(self.training)
        inputs = torch.tensor([1.0, len(cloud) / 1000]).expand(len(candidates), 2)
        return self.steepness * inputs @ self.slopes


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("steepness", [0.1, 30.0])
def test_a_step_goes_along_the_mean_slope_of_its_views_which_is_at_most_one_long(
    tmp_path: Path, steepness: float, share: float
) -> None:
    """Of the mean cross-entropy at the prior of the labels, by plain gradient descent, worked out by hand."""
    views = [labelled_view(seed, positives=10 + 15 * seed) for seed in range(2)]
    network, network_before = Sloping(steepness).eval(), Sloping(steepness)
    recipe = replace(RECIPE, candidates_per_view=60, cosine=False)
    progress = fitting._Progress({}, 0, learning_rate=0.5)
    optimiser = torch.optim.SGD(network.parameters(), lr=9.0)
    loss = fitting._epoch(network, optimiser, recipe, views, share, progress, None, tmp_path / "a", cores=Threads(1))  # type: ignore[arg-type]
    assert network.was_training == [True, True]
    slopes = network_before.slopes.detach().double().numpy()
    mean_slope, mean_loss = np.zeros(2), 0.0
    for view in views:
        inputs = np.array([1.0, len(view.cloud) / 1000])
        chance = 1 / (1 + math.exp(-(steepness * inputs @ slopes)) * (1 - share) / share)
        successes = float(view.success.double().mean())
        mean_slope += (chance - successes) * steepness * inputs / 2
        mean_loss -= (successes * math.log(chance) + (1 - successes) * math.log(1 - chance)) / 2
    length = float(np.linalg.norm(mean_slope))
    assert (length > 1) == (steepness > 1)
    step = network.slopes.detach().numpy() - slopes
    np.testing.assert_allclose(step, -0.5 * mean_slope / max(1.0, length), rtol=1e-3, atol=1e-6)
    assert loss == pytest.approx(mean_loss, rel=1e-4)


@pytest.mark.parametrize(("name", "kind"), [("adam", torch.optim.Adam), ("adamw", torch.optim.AdamW)])
def test_the_optimiser_is_that_of_the_recipe(name: Any, kind: type[torch.optim.Optimizer]) -> None:
    made = fitting._optimiser(networks.build("tesnet"), Recipe(optimiser=name, learning_rate=0.01, weight_decay=0.07))
    assert type(made) is kind
    assert made.defaults["lr"] == 0.01
    assert made.defaults["weight_decay"] == (0.07 if name == "adamw" else 0.0)


@pytest.mark.parametrize("approach_points", [None, 1000])
@pytest.mark.parametrize(("free", "blocked"), [(20, 10), (20, 0), (100, 100)])
def test_free_and_blocked_candidates_are_shown_in_the_numbers_of_the_recipe(
    free: int, blocked: int, approach_points: int | None
) -> None:
    view = labelled_view(count=60)
    view = replace(view, collision_free=torch.arange(60) % 2 == 0)
    is_free = dict(
        zip(zip(view.approach.tolist(), view.contact.tolist(), strict=True), view.collision_free, strict=True)
    )
    assert len(is_free) == 60
    network = Watched()
    recipe = replace(RECIPE, candidates_per_view=free, blocked_per_view=blocked)
    fitting._view_loss(network, view, 0.0, recipe, np.random.default_rng(0), approach_points)  # type: ignore[arg-type]
    ((_, found, _),) = network.shown
    shown = [bool(is_free[pair]) for pair in zip(found.approach.tolist(), found.contact.tolist(), strict=True)]
    assert (shown.count(True), shown.count(False)) == (min(free, 30), min(blocked, 30))


def test_the_default_recipes_show_blocked_candidates_too() -> None:
    assert all(PRESETS[name].blocked_per_view > 0 for name in ("default", "refine"))


@pytest.mark.parametrize("cosine", [True, False])
def test_the_optimiser_steps_at_the_rate_of_the_schedule(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosine: bool
) -> None:
    """A slope of one moves a parameter by just the rate in each step of plain gradient descent."""
    moving = torch.zeros((), requires_grad=True)
    places: list[float] = []

    def loss(*_: Any) -> torch.Tensor:
        places.append(float(moving.detach()))
        return moving * 1.0

    monkeypatch.setattr(fitting, "_view_loss", loss)
    monkeypatch.setattr(
        fitting, "_optimiser", lambda network, recipe: torch.optim.SGD([moving], lr=recipe.learning_rate)
    )
    monkeypatch.setattr(fitting, "validate", lambda *_: ({"served_loss": 1.0, "calibration": [1.0, 0.0]}, {}))
    recipe = replace(RECIPE, learning_rate=0.5, views_per_step=1, max_epochs=8, cosine=cosine, patience=2)
    for epochs in (3, None):  # stopped and resumed
        run(folder, tmp_path / "a.safetensors", recipe, epochs=epochs)
    rates = -np.diff([*places, float(moving.detach())])
    steps = np.arange(24)  # of three views, eight times
    if cosine:
        falling = np.maximum(0.03, (1 + np.cos(np.pi * steps / 24)) / 2)
        expected = 0.5 * np.minimum(1, (steps + 1) / 100) * falling
    else:  # the first epoch is better than none, then every second one halves
        expected = 0.5 / 2.0 ** np.maximum(0, (steps // 3 - 1) // 2)
    np.testing.assert_allclose(rates, expected, rtol=1e-4, atol=1e-6)


def test_a_network_that_learns_nothing_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(LabelsError, match="heuristic has no parameters to train"):
        fit("heuristic", [folder / "train"], [folder / "validation"], RECIPE, tmp_path / "a.safetensors")


def test_labels_rendered_for_another_network_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(LabelsError, match="prepared for another network"):
        fit("gpd", [folder / "train"], [folder / "validation"], RECIPE, tmp_path / "a.safetensors", threads=1)


def test_a_step_may_show_the_candidates_of_few_approach_points() -> None:
    view = labelled_view(count=60)
    shown = []

    def score(features: Any, cloud: Any, candidates: Candidates, mirror: Any) -> torch.Tensor:
        shown.append(candidates.approach)
        return torch.zeros(len(candidates))

    network = SimpleNamespace(encode_batch=lambda clouds: [None], score=score, parameters=lambda: iter(()))
    for limit in (3, None):
        fitting._view_loss(network, view, 0.0, RECIPE, np.random.default_rng(0), limit)  # type: ignore[arg-type]
    few, many = shown
    assert len(few.unique()) == 3
    assert len(many.unique()) > 3
    assert len(few) == min(int(torch.isin(view.approach, few).sum()), RECIPE.candidates_per_view)


def test_a_checkpoint_of_another_recipe_is_refused(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "a.safetensors", epochs=1)
    other = {"recipe": replace(RECIPE, learning_rate=1e-3)}, {"seed": 1}, {"leave_out": Fold(0, 2)}
    for options in other:
        with pytest.raises(LabelsError, match=r"a\.checkpoint is of another recipe, seed or fold"):
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
        parameters=lambda: iter(()),
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
    begun = fitting._first_network("tesnet", RECIPE, tmp_path / "older.safetensors").state_dict()["candidate.weight"]
    assert torch.equal(begun[:, :-3], state["candidate.weight"][:, :-3])
    assert not begun[:, -3:].any()
    weights.save(tmp_path / "narrow.safetensors", {**state, "lift.weight": state["lift.weight"][:-1]}, header)
    for key in ("lift.weight", "stage.attention_norm.weight"):  # a layer too narrow, one that is missing
        weights.save(tmp_path / "less.safetensors", {name: state[name] for name in state if name != key}, header)
    for file, name in (("narrow", "tesnet"), ("less", "tesnet"), ("now", "gpd")):
        with pytest.raises(LabelsError, match="of another configuration; begin without --start"):
            fitting._first_network(name, RECIPE, tmp_path / f"{file}.safetensors")


def test_a_network_that_was_not_told_goes_on_as_one_that_is_and_stays_so(tmp_path: Path) -> None:
    recipe = replace(RECIPE, network={"told": True})
    untold = weights.default_weights().with_name("tesnet-same-data.safetensors")
    told = fitting._first_network("tesnet", recipe, untold)
    shipped, header = weights.load(untold)
    assert "told" not in header.configuration["network"]
    assert not told.state_dict()["told.layer.weight"].any()
    torch.testing.assert_close({key: told.state_dict()[key] for key in shipped}, shipped, atol=0, rtol=0)
    weights.save(
        tmp_path / "told.safetensors", told.state_dict(), weights.Header("tesnet", "1", configuration_of(told))
    )
    again = fitting._first_network("tesnet", RECIPE, tmp_path / "told.safetensors")
    assert again.config == told.config
    assert again.config.told
    assert not fitting._first_network("tesnet", RECIPE, None).config.told
    assert fitting._first_network("tesnet", recipe, None).config.told


def test_a_network_that_looks_twice_goes_on_as_one_that_looks_once() -> None:
    state, header = weights.load(weights.default_weights())
    assert header.configuration["network"]["second_look"] > 0
    begun = fitting._first_network("tesnet", PRESETS["product"], weights.default_weights())
    assert begun.config.second_look == 0
    first = {key: tensor for key, tensor in state.items() if not key.startswith("second_look.")}
    torch.testing.assert_close(dict(begun.state_dict()), first, atol=0, rtol=0)


def test_a_checkpoint_from_before_a_field_of_the_recipe_goes_on(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "a.safetensors", epochs=1)
    path = tmp_path / "a.checkpoint"
    with safetensors.safe_open(path, "pt") as stored:
        progress = json.loads(stored.metadata()["progress"])
        tensors = {key: stored.get_tensor(key) for key in stored.keys()}  # noqa: SIM118  not a mapping
    for added in ("vary", "network"):
        del progress["recipe"][added]
    path.write_bytes(safetensors.torch.save(tensors, {"progress": json.dumps(progress)}))
    run(folder, tmp_path / "a.safetensors", epochs=2)
    log = (tmp_path / "a.log.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in log] == [1, 2]


def test_views_read_one_by_one_train_as_those_in_memory(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = StoredViews.__getitem__
    in_memory: dict[int, LabelledView] = {}

    def remembered(views: StoredViews, index: int) -> LabelledView:
        if int(index) not in in_memory:
            in_memory[int(index)] = read(views, index)
        return in_memory[int(index)]

    run(folder, tmp_path / "streamed.safetensors", epochs=2)
    monkeypatch.setattr(StoredViews, "__getitem__", remembered)
    run(folder, tmp_path / "remembered.safetensors", epochs=2)
    assert len(in_memory) == 3
    one, other = (weights.load(tmp_path / f"{name}.safetensors")[0] for name in ("streamed", "remembered"))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_training_learns_the_training_views(folder: Path, tmp_path: Path) -> None:
    recipe = replace(RECIPE, max_epochs=12, cosine=False, learning_rate=3e-3, views_per_step=1)
    run(folder, tmp_path / "a.safetensors", recipe)
    log = [json.loads(line) for line in (tmp_path / "a.log.jsonl").read_text().splitlines()]
    assert log[-1]["train_loss"] < 0.8 * log[0]["train_loss"]


def test_scenes_that_are_left_out_are_not_trained_on(folder: Path, tmp_path: Path) -> None:
    left_out = run(folder, tmp_path / "a.safetensors", leave_out=Fold(1, 2))
    write(tmp_path / "even" / "train", [labelled_view(0)])
    save_scene(tmp_path / "even" / "train" / "scene_0000002.npz", {"number": 2}, [labelled_view(2)])
    fit("tesnet", [tmp_path / "even"], [folder / "validation"], RECIPE, tmp_path / "b.safetensors", threads=1)
    data = left_out["data"]
    assert isinstance(data, dict)
    assert (data["scenes"], data["views"], data["leave_out"]) == (3, 2, {"index": 1, "count": 2})
    one, other = (weights.load(tmp_path / f"{name}.safetensors")[0] for name in "ab")
    assert all(torch.equal(one[name], other[name]) for name in one)


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


def test_the_calibration_is_fitted_where_it_is_told_to_be(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path / "apart.safetensors", epochs=1, calibration=[folder / "train"])
    run(folder, tmp_path / "same.safetensors", epochs=1)
    (apart, _), (same, _) = (networks.load(tmp_path / f"{name}.safetensors") for name in ("apart", "same"))
    torch.testing.assert_close(apart.state_dict(), same.state_dict())  # what is learned does not depend on it
    _, header = weights.load(tmp_path / "apart.safetensors")
    views = list(load_views([folder / "train"], apart.preparation))
    scored = evaluating.score_views(apart, views)
    joined = [np.concatenate(parts) for parts in zip(*scored, strict=True)]
    assert header.calibration == pytest.approx(metrics.fit_calibration(*joined))
    assert header.calibration != weights.load(tmp_path / "same.safetensors")[1].calibration


@pytest.mark.parametrize("name", ["edgegrasp", "gatv2", "tesnet-paper", "pointnetgpd", "gpd"])
def test_the_recipe_of_comparisons_is_that_of_the_weights_that_were_compared(name: str) -> None:
    _, header = weights.load(weights.default_weights(name))
    recorded = (header.training or {})["recipe"]
    assert len(recorded) >= 10
    assert {key: asdict(PRESETS["comparison"])[key] for key in recorded} == recorded


def test_recipes_differ_from_the_default_in_what_is_told_of_them() -> None:
    default = asdict(Recipe())
    told = {
        "default": {},
        "refine": {"learning_rate": 1e-3, "weight_decay": 0.02, "max_epochs": 3},
        "product": {
            "learning_rate": 7e-4, "weight_decay": 0.02, "views_per_step": 10, "max_epochs": 3,
            "candidates_per_view": 160, "blocked_per_view": 40, "keep": "last", "vary": True,
            "network": {
                "told": True, "doubt": True, "caution": 8.0, "mirrored": 64, "evenness": 4.0, "rims": 4.0,
            },
        },
        "comparison": {
            "learning_rate": 1e-3, "max_epochs": 8, "views_per_step": 2, "blocked_per_view": 80, "keep": "last",
        },
        "paper": {
            "optimiser": "adam", "learning_rate": 1e-4, "weight_decay": 0.0, "patience": 6,
            "smallest_learning_rate": 1e-6, "max_epochs": 200, "cosine": False, "views_per_step": 1,
            "candidates_per_view": 2000, "blocked_per_view": 0,
        },
    }  # fmt: skip
    found = {
        name: {key: value for key, value in asdict(recipe).items() if value != default[key]}
        for name, recipe in PRESETS.items()
    }
    assert found == told
