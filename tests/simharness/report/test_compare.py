"""Several networks on the same scenes: what a comparison says of its runs."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from simharness.__main__ import main
from simharness.errors import UsageError
from simharness.play.records import Run
from simharness.report.compare import Comparison, Contestant, Trial
from tests.simharness.recorded import MODEL


@pytest.fixture
def trials(make_settings: Any) -> list[Trial]:
    return [
        Trial(contestant, make_settings(scene=scene, model=contestant.network))
        for scene in ("packed", "pile")
        for contestant in (Contestant("edgegrasp", Path("/w/edgegrasp-0.safetensors")), Contestant("tesnet", None))
    ]


def finished(trial: Trial, make_round: Any) -> Run:
    outcomes = ["success", "slip"] if trial.contestant.network == "edgegrasp" else ["success", "success"]
    rounds = (make_round(0, 0, ["success"] * 5), make_round(0, 1, outcomes))
    return Run(trial.settings, 1, MODEL, None, rounds, None)


def test_every_network_has_counts_intervals_and_its_difference_to_tesnet(trials: list[Trial], make_round: Any) -> None:
    comparison = Comparison(trials, {"python": "3.11", "tes-net": "1.2.3", "commit": "0a1b2c3"})
    for trial in trials:
        comparison.add(trial.name, finished(trial, make_round))
    content = comparison.report()
    assert content["versions"]["commit"] == "0a1b2c3"
    assert content["objects"] == {"packed-edge": trials[0].settings.objects, "pile-edge": trials[-1].settings.objects}
    assert "Played by version 1.2.3, commit 0a1b2c3." in comparison.table()
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert (content["complete"], content["reference"], list(content["conditions"])) == (
        True,
        "tesnet",
        ["packed-edge", "pile-edge"],
    )
    measured = content["conditions"]["packed-edge"]["edgegrasp-0"]
    assert (measured["successes"], measured["attempts"], measured["objects_total"]) == (6, 7, 10)
    assert measured["paired"]["gsr_difference"] == pytest.approx(-1 / 7)
    assert measured["paired"]["gsr_difference_interval"] == pytest.approx([-0.5, 0.0])
    assert content["conditions"]["packed-edge"]["tesnet"]["paired"]["dr_difference"] == 0
    row = (
        "| edgegrasp-0 | 85.7 [48.7, 97.4] | 6 of 7 | -14.3 [-50.0, +0.0] "
        "| 60.0 [31.3, 83.2] | 6 of 10 | -10.0 [-20.0, +0.0] | 90.6 / 92.2 |"
    )
    assert row in comparison.table()
    assert "| tesnet | 100.0 [64.6, 100.0] | 7 of 7 |  | 70.0 [39.7, 89.2] | 7 of 10 |  |  |" in comparison.table()
    texts = [text.text for text in ET.fromstring(comparison.chart().svg()).iter("{http://www.w3.org/2000/svg}text")]
    assert texts.count("edgegrasp-0") == texts.count("85.7") == 2


def test_pairs_are_made_in_whatever_order_the_runs_come(trials: list[Trial], make_round: Any) -> None:
    tables = []
    for order in (trials, trials[::-1]):
        comparison = Comparison(trials, {})
        for trial in order:
            comparison.add(trial.name, finished(trial, make_round))
        tables.append(comparison.table())
    assert tables[0] == tables[1]


def test_a_comparison_that_was_broken_off_says_so_and_shows_what_it_has(trials: list[Trial], make_round: Any) -> None:
    comparison = Comparison(trials, {})
    comparison.add(trials[0].name, finished(trials[0], make_round))
    content = comparison.report()
    assert content["complete"] is False
    assert content["conditions"]["packed-edge"]["edgegrasp-0"]["paired"] is None
    assert content["conditions"]["pile-edge"] == {}
    assert "Incomplete: 1 of 4 runs." in comparison.table()
    ET.fromstring(comparison.chart().svg())


def test_without_tesnet_the_first_is_the_one_to_compare_with(trials: list[Trial]) -> None:
    assert Comparison(trials[:1], {}).report()["reference"] == "edgegrasp-0"


def test_runs_on_other_scenes_are_not_compared(trials: list[Trial], make_round: Any) -> None:
    comparison = Comparison(trials, {})
    comparison.add(trials[0].name, finished(trials[0], make_round))
    other = Run(trials[1].settings, 1, MODEL, None, (make_round(3, 0, ["success"]),), None)
    with pytest.raises(UsageError, match="no round in common"):
        comparison.add(trials[1].name, other)


@pytest.mark.sim
def test_the_command_plays_the_same_tables_with_every_network_and_resumes(
    start_stub: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The stand-in's second model finds no grasp.
    command = ["compare", "--models", "heuristic,tesnet", "--scenes", "packed", "--rounds", "1", "--workers", "1"]
    command += ["--out", str(tmp_path)]
    assert main([*command, "--url", start_stub()]) == 0
    content = json.loads((tmp_path / "table2.json").read_text())
    assert content["complete"] is True
    found = content["conditions"]["packed-edge"]
    assert found["heuristic"]["objects_total"] == found["tesnet"]["objects_total"]
    assert (found["heuristic"]["gsr"], found["heuristic"]["dr"]) == (None, 0)
    assert found["tesnet"]["attempts"] > 0
    for name in ("heuristic", "tesnet"):
        assert (tmp_path / "packed-edge" / name / "report.html").exists()
    assert (tmp_path / "table2.md").read_text() in capsys.readouterr().out
    assert ET.parse(tmp_path / "table2.svg").getroot().tag.endswith("svg")
    with Image.open(tmp_path / "table2.png") as image:
        assert image.width > image.height > 0
    # Finished runs are not played again: nobody serves there.
    assert main([*command, "--url", "http://127.0.0.1:9", "--resume"]) == 0
    assert json.loads((tmp_path / "table2.json").read_text()) == content


@pytest.mark.sim
def test_a_network_that_is_not_there_is_named_before_anything_is_played(
    start_stub: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["compare", "--scenes", "packed", "--rounds", "1", "--out", str(tmp_path), "--workers", "1", "--models"]
    assert main([*command, "heuristic", "gpd", "--url", start_stub()]) == 2
    assert "has tesnet, heuristic" in capsys.readouterr().err
    assert main([*command, "heuristic", "nonsense"]) == 2
    said = capsys.readouterr().err
    assert "nonsense cannot be played" in said
    assert "pointnetgpd" in said
    assert not list(tmp_path.glob("**/run.json"))


@pytest.mark.sim
def test_a_run_that_breaks_off_ends_the_command_and_keeps_what_was_compared(start_stub: Any, tmp_path: Path) -> None:
    command = ["compare", "--scenes", "packed", "--rounds", "1", "--out", str(tmp_path), "--workers", "1", "--models"]
    assert main([*command, "heuristic", "--url", start_stub()]) == 0
    # The second network's service dies in its round; the first one's is not played again.
    again = [*command, "heuristic", "tesnet", "--resume", "--url", start_stub("--die-after", "0")]
    assert main(again) == 3
    content = json.loads((tmp_path / "table2.json").read_text())
    assert content["complete"] is False
    assert list(content["conditions"]["packed-edge"]) == ["heuristic"]


def test_published_figures_stand_beside_the_executor_that_they_were_measured_with(
    trials: list[Trial], make_round: Any
) -> None:
    strict = [replace(trial, settings=replace(trial.settings, executor="strict")) for trial in trials]
    tables = []
    for each in (trials, strict):
        comparison = Comparison(each, {})
        for trial in each:
            comparison.add(trial.name, finished(trial, make_round))
        tables.append(comparison.table())
    assert ["90.6 / 92.2" in table for table in tables] == [True, False]
