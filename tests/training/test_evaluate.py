from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tesnet import networks, weights
from tesnet.hands import HANDS
from tesnet.predictor import configuration_of
from tests.tesnet.scenes import fresh_network
from tests.training.synthetic import labelled_view, write
from training import metrics
from training.evaluate import by_group, evaluate, measure, score_views, validate
from training.views import LabelsError, load_views


def test_views_are_scored_where_the_observed_cloud_leaves_them_free_unless_all_are_asked_for() -> None:
    view = labelled_view(0)
    free = torch.arange(len(view.outcomes)) % 3 == 0
    views = [replace(view, collision_free=free), replace(view, collision_free=torch.zeros_like(free))]
    network = fresh_network()
    (logits, success), *others = score_views(network, views)
    assert others == []  # nothing of the second view is free
    np.testing.assert_array_equal(success, view.success[free])
    alone = network.score(networks.encode(network, view.cloud), view.cloud, view.candidates.select(free))
    np.testing.assert_allclose(logits, alone.detach().numpy(), atol=1e-5)
    assert [len(logits) for logits, _ in score_views(network, views, blocked=True)] == [len(free)] * 2


def test_the_calibration_is_fitted_to_every_other_view_and_judged_on_the_rest() -> None:
    rng = np.random.default_rng(0)
    scored = [(rng.normal(size=80), rng.random(80) < share) for share in (0.3, 0.6, 0.4, 0.5)]
    found = measure(scored, seed=0)
    fitted, judged = (
        [np.concatenate([view[part] for view in scored[start::2]]) for part in (0, 1)] for start in (0, 1)
    )
    a, b = metrics.fit_calibration(*fitted)
    assert found["calibration"] == pytest.approx([a, b])
    assert found["served_loss"] == pytest.approx(metrics.cross_entropy(a * judged[0] + b, judged[1]))
    assert found["candidates"] == 320
    given = measure(scored, seed=0, calibration=(2.0, -0.7))
    logits, success = (np.concatenate([view[part] for view in scored]) for part in (0, 1))
    check_judged(given, logits, success, (2.0, -0.7))


def test_the_best_candidate_of_each_view_is_looked_at_by_itself() -> None:
    """And views too poor for the paper's metric count for all others."""
    rng = np.random.default_rng(1)
    scored = [(rng.normal(size=60), np.zeros(60, dtype=bool)) for _ in range(5)]
    for view, ((logits, success), best_succeeds) in enumerate(
        zip(scored, (True, False, True, True, False), strict=True)
    ):
        order = logits.argsort()
        success[order[: 12 if view else 3]] = True
        success[order[-1]] = best_succeeds
    found = measure(scored, seed=0)
    assert found["top1"] == pytest.approx(3 / 5)
    assert (found["views"], found["usable_views"], found["candidates"]) == (5, 4, 300)
    assert found["successes"] == sum(int(success.sum()) for _, success in scored)
    logits, success = (np.concatenate([view[part] for view in scored]) for part in (0, 1))
    for name, judge in (
        ("auroc", metrics.auroc),
        ("average_precision", metrics.average_precision),
        ("balanced_accuracy", metrics.balanced_accuracy),
    ):
        assert found[name] == pytest.approx(judge(logits, success))
    assert (found["accuracy"], found["balanced_loss"]) == metrics.edge_metric(scored[1:], 0)


def check_judged(
    found: dict[str, Any], logits: metrics.Logits, success: metrics.Success, calibration: tuple[float, float]
) -> None:
    """That error and loss are those of the score as it is served: sigmoid(a * logit + b)."""
    a, b = calibration
    assert found["calibration"] == pytest.approx([a, b])
    served = 1 / (1 + np.exp(-(a * logits + b)))
    loss = -np.mean(np.log(np.where(success, served, 1 - served)))
    assert found["served_loss"] == pytest.approx(loss, abs=1e-4)
    assert found["calibration_error"] == pytest.approx(metrics.calibration_error(served, success), abs=1e-3)


def test_weights_are_judged_with_the_calibration_that_they_are_served_with(tmp_path: Path) -> None:
    network = fresh_network()
    header = weights.Header("tesnet", "1", configuration_of(network), (3.0, -0.7))
    weights.save(tmp_path / "a.safetensors", network.state_dict(), header)
    folder = write(tmp_path / "labels", [replace(labelled_view(0), collision_free=torch.arange(60) < 45)])
    found = evaluate("tesnet", tmp_path / "a.safetensors", [folder])
    views = list(load_views([folder], network.preparation))
    for measures, blocked in ((found["all"], False), (found["with_blocked"]["all"], True)):
        ((logits, success),) = score_views(network, views, blocked=blocked)
        check_judged(measures, logits, success, (3.0, -0.7))


def test_validation_judges_all_candidates_with_the_calibration_of_the_free_ones() -> None:
    network = fresh_network()
    views = [replace(labelled_view(seed), collision_free=torch.arange(60) < 45) for seed in range(3)]
    for apart in ((), [labelled_view(3)]):
        of_free, of_all = validate(network, views, 0, apart)
        fitted_to = score_views(network, apart or views[::2])
        a, b = metrics.fit_calibration(*(np.concatenate(parts) for parts in zip(*fitted_to, strict=True)))
        for measures, judged, blocked in (
            (of_free, views if apart else views[1::2], False),
            (of_all, views, True),
        ):
            scored = score_views(network, judged, blocked=blocked)
            logits, success = (np.concatenate(parts) for parts in zip(*scored, strict=True))
            check_judged(measures, logits, success, (a, b))


def test_measures_come_overall_by_scene_and_with_what_the_cloud_blocks(tmp_path: Path) -> None:
    free = torch.arange(60) < 45
    packed, pile = replace(labelled_view(0), collision_free=free), replace(labelled_view(1), scene="pile")
    network = fresh_network()
    weights.save(
        tmp_path / "a.safetensors", network.state_dict(), weights.Header("tesnet", "1", configuration_of(network))
    )
    found = evaluate("tesnet", tmp_path / "a.safetensors", [write(tmp_path / "labels", [packed, pile])])
    groups = {"by_hand", "by_sensor", "by_width"}
    assert set(found) == {"weights_sha256", "all", "packed", "pile", "with_blocked", *groups}
    assert all(sum(row["candidates"] for row in found[group].values()) == 105 for group in groups)
    assert found["weights_sha256"] == weights.sha256(tmp_path / "a.safetensors")
    assert [found[group]["candidates"] for group in ("all", "packed", "pile")] == [105, 45, 60]
    assert [found["with_blocked"][group]["candidates"] for group in ("all", "packed", "pile")] == [120, 60, 60]


def test_served_scores_are_judged_by_hand_sensor_and_opening() -> None:
    free = torch.arange(60) < 50
    views = [
        # Half a hand's last bit over its opening, as rounding may leave it.
        replace(labelled_view(0), collision_free=free, widths=torch.full((60,), 0.08 + 2e-7)),
        replace(
            labelled_view(1),
            gripper=(rg2 := HANDS["rg2"].gripper),
            widths=torch.full((60,), rg2.max_width),
            sensor="d435",
        ),
        replace(labelled_view(2), sensor="d435", collision_free=torch.zeros(60, dtype=torch.bool)),
    ]
    network, calibration = fresh_network(), (2.0, -0.3)
    found = by_group(network, views, calibration)
    first, second = score_views(network, views)
    assert found["by_hand"] == {
        "franka": metrics.served(*first, calibration),
        "rg2": metrics.served(*second, calibration),
    }
    assert found["by_sensor"] == {
        "camera": metrics.served(*first, calibration),
        "d435": metrics.served(*second, calibration),
    }
    assert found["by_width"] == {
        "60-80 mm": metrics.served(*first, calibration),
        "100-120 mm": metrics.served(*second, calibration),
    }


def test_views_without_ten_successes_are_refused() -> None:
    with pytest.raises(LabelsError, match="none of 1 views has 10 successes and a failure; label more"):
        measure([(np.zeros(30), np.arange(30) < 9)], seed=0)
