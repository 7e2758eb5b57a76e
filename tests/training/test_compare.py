from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tesnet import networks
from tesnet.predictor import GraspPredictor
from tests.tesnet.scenes import tabletop_query
from tests.training.synthetic import labelled_view, write
from training import compare as comparing
from training.__main__ import main
from training.compare import Row, compare, markdown, milliseconds, panels, read_runs
from training.fit import Recipe, fit
from training.views import LabelsError

RECIPE = Recipe(max_epochs=2, views_per_step=1, candidates_per_view=20, keep="last")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of `edgegrasp` with two seeds and one of `tesnet`, two epochs on one view each."""
    root = tmp_path_factory.mktemp("comparison")
    write(root / "train", [labelled_view(0)])
    write(root / "validation", [labelled_view(1), labelled_view(2)])
    for name, seed in (("edgegrasp", 1), ("edgegrasp", 0), ("tesnet", 0)):
        out = root / "runs" / f"{name}-{seed}.safetensors"
        out.parent.mkdir(exist_ok=True)
        fit(name, [root / "train"], [root / "validation"], RECIPE, out, threads=1, seed=seed)
    return root


_clouds = comparing.clouds


@pytest.mark.sim
def test_the_clouds_that_are_timed_are_always_the_same_packed_and_pile_scenes() -> None:
    first, second = _clouds(2), _clouds(2)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert len(one.points) > 1000
    assert len(first[0].points) != len(first[1].points)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparing, "clouds", lambda count: [tabletop_query()])


def log_of(folder: Path, run: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "runs" / f"{run}.log.jsonl").read_text().splitlines()]


def test_the_table_has_a_line_for_each_network_with_the_mean_of_its_runs(folder: Path, tmp_path: Path) -> None:
    assert main(["compare", "--data", str(folder / "runs"), "--out", str(tmp_path)]) == 0
    table = json.loads((tmp_path / "table1.json").read_text())
    assert [(row["name"], row["seeds"]) for row in table] == [("edgegrasp", [0, 1]), ("tesnet (same data)", [0])]
    last = [log_of(folder, f"edgegrasp-{seed}")[-1]["with_blocked"] for seed in (0, 1)]
    for measure in comparing.MEASURES:
        assert table[0]["measures"][measure] == pytest.approx((last[0][measure] + last[1][measure]) / 2)
        assert table[0]["spread"][measure] == pytest.approx(abs(last[0][measure] - last[1][measure]))
    assert table[0]["parameters"] == sum(p.numel() for p in networks.build("edgegrasp").parameters())
    assert table[0]["approach_points"] == 16
    assert table[1]["spread"] == {}
    assert table[1]["approach_points"] is None
    text = (tmp_path / "table1.md").read_text().splitlines()
    accuracy = f"{100 * table[0]['measures']['accuracy']:.1f} +- "
    assert text[2].startswith(f"| edgegrasp | {table[0]['parameters']:,} | {accuracy}")
    assert "| 88.3, 0.282 |" in text[2]
    assert len({line.count("|") for line in text[:4]}) == 1
    assert (tmp_path / "figure6.svg").exists()
    assert (tmp_path / "figure6.png").exists()


def test_each_number_of_a_row_stands_under_its_name() -> None:
    """Rates in per cent; behind the mean of several runs half of what the largest and the smallest differ by."""
    measures = {
        "accuracy": 0.812,
        "balanced_loss": 0.3456,
        "balanced_accuracy": 0.723,
        "auroc": 0.8912,
        "average_precision": 0.567,
    }
    spread = {name: 0.02 * (1 + place) for place, name in enumerate(measures)}
    row = Row("edgegrasp", [3, 4], 1234, measures, spread, 56.0, 7.0, 890, 12345, 16)
    head, _, several, one = markdown([row, replace(row, spread={}, seeds=[3], approach_points=None)]).splitlines()[:4]
    names = [cell.strip() for cell in head.split("|")[1:-1]]
    cells = dict(zip(names, (cell.strip() for cell in several.split("|")[1:-1]), strict=True))
    assert cells == {
        "network": "edgegrasp", "parameters": "1,234", "accuracy %": "81.2 +- 1.0", "loss": "0.346 +- 0.020",
        "paper": "88.3, 0.282", "balanced accuracy %": "72.3 +- 3.0", "AUROC": "0.891 +- 0.040", "AP": "0.567 +- 0.050",
        "ms a cloud (network)": "56 (7)", "views": "890", "labels": "12,345 *16", "seeds": "3, 4",
    }  # fmt: skip
    alone = dict(zip(names, (cell.strip() for cell in one.split("|")[1:-1]), strict=True))
    assert (alone["accuracy %"], alone["AP"], alone["labels"]) == ("81.2", "0.567", "12,345")


def test_untrained_and_shipped_rows_are_measured_where_labels_are_given(folder: Path, tmp_path: Path) -> None:
    rows = compare(folder / "runs", tmp_path, [folder / "validation"])["rows"]
    assert [row["name"] for row in rows] == ["heuristic", "edgegrasp", "tesnet (same data)", "tesnet (shipped)"]
    assert rows[0]["parameters"] == 0
    assert rows[0]["views"] is None
    assert 0 <= rows[0]["measures"]["auroc"] <= 1


def test_curves_are_means_over_the_epochs_that_all_runs_of_a_network_have(folder: Path) -> None:
    runs = read_runs(folder / "runs")
    runs[0] = replace(runs[0], epochs=runs[0].epochs[:1])
    loss, accuracy = panels(runs)
    assert {name: len(values) for name, values in loss.series.items()} == {"edgegrasp": 1, "tesnet (same data)": 2}
    first = [log_of(folder, f"edgegrasp-{seed}")[0]["with_blocked"] for seed in (0, 1)]
    assert loss.series["edgegrasp"][0] == pytest.approx(sum(entry["balanced_loss"] for entry in first) / 2)
    assert accuracy.series["edgegrasp"][0] == pytest.approx(50 * sum(entry["accuracy"] for entry in first))


def test_an_epoch_that_was_logged_twice_counts_once(folder: Path, tmp_path: Path) -> None:
    for suffix in (".safetensors", ".log.jsonl"):
        (tmp_path / f"a{suffix}").write_bytes((folder / "runs" / f"tesnet-0{suffix}").read_bytes())
    log = tmp_path / "a.log.jsonl"
    log.write_text(log.read_text() + log.read_text().splitlines()[-1] + "\n")
    (run,) = read_runs(tmp_path)
    assert [entry["epoch"] for entry in run.epochs] == [1, 2]


def test_a_folder_without_what_is_needed_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tesnet-0.safetensors").write_bytes((folder / "runs" / "tesnet-0.safetensors").read_bytes())
    with pytest.raises(LabelsError, match=r"holds no \*\.log\.jsonl"):
        read_runs(tmp_path)
    (tmp_path / "a.log.jsonl").write_bytes((folder / "runs" / "tesnet-0.log.jsonl").read_bytes())
    with pytest.raises(LabelsError, match=r"a\.safetensors is missing"):
        read_runs(tmp_path)
    (tmp_path / "a.log.jsonl").write_text(json.dumps({"epoch": 1, "accuracy": 0.9}) + "\n")
    with pytest.raises(LabelsError, match="lacks measures of all candidates"):
        read_runs(tmp_path)


def test_of_other_seeds_the_logs_are_enough(folder: Path, tmp_path: Path) -> None:
    for source, target in (
        ("edgegrasp-0.safetensors", "edgegrasp.safetensors"),
        ("edgegrasp-0.log.jsonl", "edgegrasp.log.jsonl"),
        ("edgegrasp-1.log.jsonl", "edgegrasp-1.log.jsonl"),
        ("tesnet-0.safetensors", "shipped.safetensors"),
    ):
        (tmp_path / target).write_bytes((folder / "runs" / source).read_bytes())
    found = [(run.network, run.training["seed"], run.path.name) for run in read_runs(tmp_path)]
    assert found == [("edgegrasp", 0, "edgegrasp.safetensors"), ("edgegrasp", 1, "edgegrasp.safetensors")]
    assert [run.epochs for run in read_runs(tmp_path)] == [run.epochs for run in read_runs(folder / "runs")][:2]
    measured = [run.training["validation_with_blocked"] for run in read_runs(folder / "runs")][:2]
    assert [run.training["validation_with_blocked"] for run in read_runs(tmp_path)] == measured


def test_the_network_takes_a_part_of_the_time() -> None:
    total, of_network = milliseconds(GraspPredictor.without_weights("heuristic"), [tabletop_query()])
    assert 0 < of_network < total
