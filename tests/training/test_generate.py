from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from simharness.sim.outcome_kinds import OUTCOME_KINDS
from simharness.sim.protocol import query_about
from simharness.sim.scene import SCALE_RANGES, make_scene, restore_scene, scales_for
from simharness.sim.world import World
from tesnet import networks, weights
from tesnet.cloud import MINIMUM_POINTS, PreparationConfig, PreparedCloud, prepare
from tesnet.hands import HANDS
from tesnet.predictor import GraspPredictor
from tesnet.query import GraspQuery
from tests.tesnet.scenes import fresh_network
from tests.training.synthetic import labelled_view
from training import generate as generating
from training import viewing
from training.generate import GenerateConfig, generate
from training.viewing import viewings_of
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
        assert {"seed", "number", "views"} <= set(description)
        assert len(description["views"]) == len(views)
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


def test_a_scene_that_is_missing_is_made_and_the_others_are_left(labels: Path, tmp_path: Path) -> None:
    generate(CONFIG, 1, 1, tmp_path / "again")
    account = json.loads((tmp_path / "again" / "account.json").read_text())
    first, *others = scene_files([tmp_path / "again"])
    lost, kept = first.read_bytes(), {path: path.stat().st_mtime_ns for path in others}
    first.unlink()
    generate(CONFIG, account["labels"], 1, tmp_path / "again", resume=True)
    assert first.read_bytes() == lost
    assert {path: path.stat().st_mtime_ns for path in others} == kept
    # What is there counts: with as many labels as were asked for, nothing is made.
    assert generate(CONFIG, account["labels"], 1, tmp_path / "again", resume=True)["labels"] == account["labels"]
    assert scene_files([tmp_path / "again"]) == sorted([first, *others])


def test_labels_show_the_clouds_as_the_service_prepares_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit, so that no network learns from normals of another neighbourhood than it is served."""
    queries: list[GraspQuery] = []

    def noted(*arguments: Any, **options: Any) -> GraspQuery:
        queries.append(query_about(*arguments, **options))
        return queries[-1]

    monkeypatch.setattr(viewing, "query_about", noted)
    _, (view,) = generating.label_scene(CONFIG, generating.object_sets(CONFIG), 0, generating.Judge.of(CONFIG))
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
    assert {view.gripper for view in views} == {HANDS["rg2"].gripper}
    assert {view.gripper.name for view in views} == {"rg2"}
    assert all((view.widths <= view.gripper.max_width + 1e-6).all() for view in views)


def test_every_scene_may_have_a_new_hand(tmp_path: Path) -> None:
    random_hands = replace(CONFIG, gripper="random", labels_per_view=2)
    judge = generating.Judge.of(random_hands)
    sets = generating.object_sets(random_hands)
    scenes = [generating.label_scene(random_hands, sets, number, judge)[1] for number in range(4)]
    hands = {view.gripper.max_width for views in scenes for view in views}
    assert len(hands) >= 3
    # What is drawn of hands does not change the cameras.
    described = [generating.label_scene(config, sets, 0, judge)[0]["views"] for config in (random_hands, CONFIG)]
    assert described[0][0]["cameras"] == described[1][0]["cameras"]


def test_views_through_any_sensor_are_told_so_that_they_can_be_taken_again() -> None:
    config = replace(CONFIG, camera="any", sensor="random", labels_per_view=2, views=3)
    sets, judge = generating.object_sets(config), generating.Judge.of(config)
    description, views = generating.label_scene(config, sets, 1, judge)
    assert len(description["views"]) == len(views) > 1
    for name in ("seed", "cameras"):  # each view has its own
        assert len({json.dumps(look[name]) for look in description["views"]}) == len(views)
    assert [look["sensor"] for look in description["views"]] == [view.sensor for view in views]
    models = {model.name: model for some in sets for model in some}
    with World() as world:
        restore_scene(world, description, models)
        for look, view in zip(viewings_of(description), views, strict=True):
            query = look.query(look.observe(world), 0, view.gripper)
            again = prepare(query, judge.preparation, torch.device("cpu"))
            assert again is not None
            assert abs(len(again) - len(view.cloud)) <= 0.02 * len(view.cloud)
            one, other = (
                torch.from_numpy(seen.T_cloud_canonical.apply(seen.points.numpy())) for seen in (again, view.cloud)
            )
            distance = torch.cdist(one, other).min(dim=1).values
            assert distance.quantile(0.9) < 1e-3


def test_clouds_are_prepared_as_a_network_wants_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert generating.Judge.of(replace(CONFIG, model="gpd")).preparation == networks.NETWORKS["gpd"][0].preparation
    fine = PreparationConfig(voxel_size=0.003)
    network, header = networks.load(weights.default_weights())
    header = replace(header, configuration={**header.configuration, "preparation": asdict(fine)})
    monkeypatch.setattr(networks, "load", lambda _: (network, header))
    judge = generating.Judge.of(replace(CONFIG, mine=Path("weights")))
    assert judge.preparation == fine
    scene = generating.label_scene(CONFIG, generating.object_sets(CONFIG), 0, judge)
    usual = generating.label_scene(CONFIG, generating.object_sets(CONFIG), 0, generating.Judge.of(CONFIG))
    assert len(scene[1][0].cloud) > 1.5 * len(usual[1][0].cloud)


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


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("colliding", [3, 40])
@pytest.mark.parametrize("mines", [False, True])
def test_the_candidates_that_are_tried_are_of_each_kind_as_many_as_asked_for(
    share: float, colliding: int, mines: bool
) -> None:
    """A share that meets the cloud, fewer where there are fewer; of the others a half from those a network likes."""
    view = labelled_view(0, count=100)
    free = torch.from_numpy(np.random.default_rng(1).permutation(100) >= colliding)
    config, network = replace(CONFIG, labels_per_view=30, colliding_share=share), fresh_network()
    chosen = generating._choose(
        view.cloud, view.candidates, free, config, np.random.default_rng(0), network if mines else None
    )
    assert len(set(chosen.tolist())) == len(chosen) == 30
    assert (np.diff(chosen) > 0).all()
    met = min(round(30 * share), colliding)
    assert int((~free[chosen]).sum()) == met
    with torch.inference_mode():
        logits = network.score(networks.encode(network, view.cloud), view.cloud, view.candidates)
    liked = set(sorted(free.nonzero()[:, 0].tolist(), key=lambda row: -logits[row])[: -(-int(free.sum()) // 4)])
    if mines:
        assert len(liked & set(chosen.tolist())) >= min(len(liked), (30 - met) // 2)
    if mines and colliding == 3:  # of the other half as many are liked as there are left
        draws = [
            generating._choose(view.cloud, view.candidates, free, config, np.random.default_rng(seed), network)
            for seed in range(20)
        ]
        half = (30 - met) // 2
        left = (30 - met - half) * (len(liked) - half) / (int(free.sum()) - half)
        assert np.mean([len(liked & set(draw.tolist())) for draw in draws]) == pytest.approx(half + left, abs=1.0)
    alike = replace(config, colliding_share=None)
    draws = [
        generating._choose(view.cloud, view.candidates, free, alike, np.random.default_rng(seed), None)
        for seed in range(40)
    ]
    assert {len(draw) for draw in draws} == {30}
    assert set(np.concatenate(draws).tolist()) == set(range(100))


@pytest.mark.parametrize(("most", "expected"), [(None, range(1, 6)), (1, range(1, 2)), (9, range(1, 10))])
def test_tables_hold_from_one_thing_to_as_many_as_they_may(most: int | None, expected: range) -> None:
    config = replace(CONFIG, things=most)
    counts = [generating._number_of_things(config, np.random.default_rng(seed)) for seed in range(600)]
    assert set(counts) == set(expected)
    shares = np.bincount(counts)[1:] / len(counts)
    wanted = np.array([1, 1, 1, 1, 2]) / 6 if most is None else np.full(most, 1 / most)
    np.testing.assert_allclose(shares, wanted, atol=0.06)


@pytest.mark.parametrize("name", ["franka", "rg2", "robotiq_2f140"])
@pytest.mark.parametrize("scale", [None, (0.4, 0.5)])
def test_things_are_as_large_as_the_hand_that_is_to_take_them(name: str, scale: tuple[float, float] | None) -> None:
    config = replace(CONFIG, gripper=name, scale=scale, views=0, things=5)
    low, high = scales_for("packed", HANDS[name].gripper, scale)
    assert (low, high) != scales_for("packed", HANDS["hand_e"].gripper, scale)
    sets, judge = generating.object_sets(config), generating.Judge.of(config)
    things = [item for number in range(3) for item in generating.label_scene(config, sets, number, judge)[0]["objects"]]
    sized = {model.name for some in sets for model in some if model.sized}
    middle = sum(SCALE_RANGES["packed"]) / 2
    hints = {model.name: model.scale_hint for some in sets for model in some}
    drawn = [item["scale"] / hints[item["name"]] * (middle if item["name"] in sized else 1.0) for item in things]
    assert len(drawn) >= 3
    assert low - 1e-9 <= min(drawn) < max(drawn) <= high + 1e-9


def test_views_of_fewer_points_than_the_service_answers_have_no_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a grid so coarse that some views of small things have too few."""
    config = replace(CONFIG, views=2, things=1, labels_per_view=2)
    sets, judge = generating.object_sets(config), generating.Judge(PreparationConfig(voxel_size=0.022))
    sizes: list[int] = []

    def noted(*arguments: Any) -> PreparedCloud | None:
        ready = prepare(*arguments)
        sizes.append(0 if ready is None else len(ready))
        return ready

    monkeypatch.setattr("tesnet.cloud.prepare", noted)
    for number in (2, 4, 5):
        sizes.clear()
        description, views = generating.label_scene(config, sets, number, judge)
        assert [len(view.cloud) for view in views] == [size for size in sizes if size >= MINIMUM_POINTS]
        assert len(description["views"]) == len(views) < len(sizes) == 2


@pytest.mark.parametrize("name", ["franka", "rg2"])
def test_what_is_stored_of_a_candidate_is_how_it_was_tried(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pose and opening, which of hands whose tips swing is what they will hold; each with its own outcome."""
    tried: list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = []

    def judged(world: Any, hand: Any, poses: Any, openings: Any, snapshot: int) -> list[str]:
        assert hand.gripper == HANDS[name].gripper
        tried.append((np.asarray(poses), np.asarray(openings)))
        return [OUTCOME_KINDS[number % len(OUTCOME_KINDS)] for number in range(len(openings))]

    monkeypatch.setattr(generating, "label_strict", judged)
    config = replace(CONFIG, gripper=name, labels_per_view=30)
    _, views = generating.label_scene(config, generating.object_sets(config), 0, generating.Judge.of(config))
    assert len(views) == len(tried) > 0
    for view, (poses, openings) in zip(views, tried, strict=True):
        assert len(view.outcomes) == len(openings) > 0
        np.testing.assert_allclose(view.widths.numpy(), openings, atol=1.1e-6)
        stored = view.cloud.T_cloud_canonical.matrix @ view.poses.double().numpy()
        np.testing.assert_allclose(stored, poses, atol=1e-6)
        assert view.outcomes.tolist() == [number % len(OUTCOME_KINDS) for number in range(len(openings))]
        is_narrow = openings < HANDS[name].gripper.max_width - 1e-6
        assert is_narrow.any() == (name == "rg2")


@pytest.mark.parametrize("number", range(2))
def test_a_scene_is_drawn_alike_whatever_hand_shall_take_its_things(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also how it is looked at; things are larger for a wider hand."""
    states: list[list[Any]] = []

    def noted(function: Any) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            rng = next(value for value in arguments if isinstance(value, np.random.Generator))
            states[-1].append((rng.bit_generator.state, options.get("num_objects")))
            return function(*arguments, **options)

        return call

    monkeypatch.setattr(generating, "make_scene", noted(make_scene))
    monkeypatch.setattr(generating, "draw_viewing", noted(viewing.draw_viewing))
    for gripper in ("franka", "random", "rg2"):
        states.append([])
        config = replace(CONFIG, gripper=gripper, views=2, labels_per_view=1)
        generating.label_scene(config, generating.object_sets(config), number, generating.Judge.of(config))
    assert len(states[0]) == 3
    assert states[0] == states[1] == states[2]
