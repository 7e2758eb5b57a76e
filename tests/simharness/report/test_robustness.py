"""Worse sensing: conditions, and what a study says of their runs."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from simharness.__main__ import main
from simharness.errors import UsageError
from simharness.play.records import Latency, ModelRecord, NoGraspRecord, Run
from simharness.play.round import camera_sensor
from simharness.play.settings import RunSettings
from simharness.report.robustness import AXES, AXIS_NAMES, Condition, Study, conditions
from simharness.sim.sensors.catalogue import SENSORS

MODEL = ModelRecord("tesnet", "1.2", "ab" * 32)


def finished(settings: RunSettings, make_round: Any, model: ModelRecord = MODEL) -> Run:
    rounds = (make_round(0, 0, ["success"] * 5), make_round(0, 1, ["success", "slip", "slip"], (), "two_failures"))
    return Run(settings, 1, model, None, rounds, None)


def test_every_condition_changes_what_it_says_and_no_scene(make_settings: Any) -> None:
    base = make_settings()
    found = {condition.name: condition.settings(base) for condition in conditions(AXIS_NAMES)}
    # Three axes share the unchanged run, two of them those without noise and with giga's.
    assert len(found) == sum(len(axis.levels) for axis in AXES.values()) - 4
    assert found["unchanged"] == base
    assert camera_sensor(found["unchanged"]).point_sigma == 0.0008
    assert camera_sensor(found["noise-4mm"]).point_sigma == 0.004
    assert camera_sensor(found["noise-giga"]) == SENSORS["dex"]
    assert found["polar-75deg"].polar_deg == 75
    assert (found["d415-distance-500mm"].distance, found["d415-distance-500mm"].sensor) == (0.5, "d415")
    assert not any(name.startswith("d415-distance-3") for name in found)
    assert found["voxel-5mm"].voxel_size == 0.005
    for settings in found.values():
        assert (settings.seeds, settings.scene, settings.objects) == (base.seeds, base.scene, base.objects)


def test_a_study_gives_counts_and_intervals_beside_every_rate(make_settings: Any, make_round: Any) -> None:
    study = Study(make_settings(), ["points"])
    for condition in conditions(["points"]):
        study.add(condition, finished(condition.settings(make_settings()), make_round))
    content = study.report({"python": "3.11"})
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["complete"] is True
    measured = content["conditions"]["voxel-5mm"]
    assert (measured["successes"], measured["attempts"], measured["objects_total"]) == (6, 8, 10)
    assert (measured["changes"], measured["points_median"]) == ({"voxel_size": 0.005}, 100.0)
    assert "| 5 mm | 75.0 [40.9, 92.9] | 6 of 8 | 60.0 [31.3, 83.2] | 6 of 10 | 100 |" in study.table()
    drawing = ET.fromstring(study.plot())
    assert len(drawing.findall(".//{*}circle/{*}title")) == 2 * len(AXES["points"].levels)


def test_the_points_of_a_condition_are_those_of_all_its_requests(make_settings: Any, make_round: Any) -> None:
    """Of looks that gave no grasp, which have the fewest, too; no request was made where the camera saw nothing."""
    one, two = finished(make_settings(), make_round).rounds
    tried = tuple(replace(attempt, counts={"points": 10 * number}) for number, attempt in enumerate(one.attempts, 7))
    unseen = NoGraspRecord(5, "no_points_in_workspace", {}, None)
    looks = tuple(NoGraspRecord(number, "no_candidates", {"points": number}, Latency(1.0, 2.0)) for number in range(7))
    run = replace(
        finished(make_settings(), make_round),
        rounds=(replace(one, attempts=tried), replace(two, attempts=(), no_grasps=(*looks, unseen))),
    )
    study = Study(make_settings(), ["points"])
    study.add(conditions(["points"])[0], run)
    (measured,) = study.report({})["conditions"].values()
    assert measured["points_median"] == median([*range(7), 70, 80, 90, 100, 110])


def test_a_study_that_was_broken_off_says_so(make_settings: Any, make_round: Any) -> None:
    study = Study(make_settings(), AXIS_NAMES)
    first = conditions(AXIS_NAMES)[0]
    study.add(first, finished(first.settings(make_settings()), make_round))
    assert study.report({})["complete"] is False
    assert f"Incomplete: 1 of {len(conditions(AXIS_NAMES))} conditions." in study.table()
    holding = sum(first.name in (level.name for level in axis.levels) for axis in AXES.values())
    assert len(ET.fromstring(study.plot()).findall(".//{*}circle/{*}title")) == 2 * holding


def test_runs_of_two_models_are_not_compared(make_settings: Any, make_round: Any) -> None:
    study = Study(make_settings(), ["noise"])
    first, second = conditions(["noise"])[:2]
    study.add(first, finished(make_settings(), make_round))
    with pytest.raises(UsageError, match=f"{second.name} was played with"):
        study.add(second, finished(make_settings(), make_round, ModelRecord("tesnet", "1.3", "cd" * 32)))


@pytest.mark.sim
def test_the_command_plays_the_same_tables_in_every_condition_and_resumes(
    start_stub: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    levels = (Condition("unchanged", "every point"), Condition("voxel-10mm", "10 mm", {"voxel_size": 0.01}))
    monkeypatch.setattr("simharness.report.robustness.AXES", {"points": AXES["points"].__class__("voxels", levels, 2)})
    command = ["robustness", "--rounds", "1", "--workers", "1", "--against", "points", "--out", str(tmp_path)]
    assert main([*command, "--url", start_stub()]) == 0
    content = json.loads((tmp_path / "robustness.json").read_text())
    all_points, thinned = (content["conditions"][level.name] for level in levels)
    assert content["complete"] is True
    assert all_points["objects_total"] == thinned["objects_total"]
    assert thinned["points_median"] < 0.2 * all_points["points_median"]
    for level in levels:
        assert (tmp_path / level.name / "report.html").exists()
    assert (tmp_path / "robustness.md").read_text() in capsys.readouterr().out
    assert ET.parse(tmp_path / "robustness.svg").getroot().tag.endswith("svg")
    # Finished conditions are not played again: nobody serves there.
    assert main([*command, "--url", "http://127.0.0.1:9", "--resume"]) == 0
    assert json.loads((tmp_path / "robustness.json").read_text()) == content


@pytest.mark.parametrize("condition", conditions(AXIS_NAMES), ids=lambda condition: condition.name)
def test_a_condition_changes_what_its_name_tells_and_nothing_else(condition: Condition, make_settings: Any) -> None:
    expected: dict[str, Any] = {}
    name = condition.name
    if name.endswith("-calibrated"):
        expected["calibrate"], name = True, name.removesuffix("-calibrated")
    if name.startswith(("d435-", "d415-")):
        expected["sensor"], name = name.split("-", 1)
    kind, _, level = name.partition("-")
    if kind == "polar":
        expected["polar_deg"] = float(level.removesuffix("deg"))
    elif kind in ("distance", "voxel"):
        field = {"distance": "distance", "voxel": "voxel_size"}[kind]
        expected[field] = pytest.approx(float(level.removesuffix("mm")) / 1000)
    elif kind == "sensor":
        expected["sensor"] = level
    elif kind == "noise":
        expected |= (
            {"noise_std": 0.0, "dex_noise": True}
            if level == "giga"
            else {"noise_std": float(level.removesuffix("mm")) / 1000}
        )
    else:
        assert condition.name == "unchanged"
    assert asdict(condition.settings(make_settings())) == asdict(make_settings()) | expected
