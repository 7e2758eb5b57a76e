from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.play.records import Run
from simharness.report.report import package_versions, report, table
from tesnet.calibration import calibrated
from tesnet.query import GraspQuery
from tests.tesnet.scenes import CAMERA, UP


def test_the_report_has_rates_counts_settings_and_model(run: Run) -> None:
    content = report(run, {"python": "3.11"})
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["complete"] is True
    assert (content["successes"], content["attempts"]) == (7, 10)
    assert (content["objects_grasped"], content["objects_total"]) == (7, 20)
    assert content["gsr"] == 0.7
    assert content["dr"] == 0.35
    assert content["gsr_interval"][0] < 0.7 < content["gsr_interval"][1]
    assert content["failures"] == {"pregrasp": 0, "approach": 1, "slip": 1, "drop": 1}
    assert content["no_grasps"] == {"no_candidates": 4}
    assert content["rounds_ended"] == {"empty": 2, "two_failures": 1, "no_grasps": 1}
    assert content["latencies"]["service_total_ms"]["median"] == 11.0
    assert content["model"] == {"name": "tesnet", "version": "1.2", "weights_sha256": "ab" * 32}
    assert content["versions"] == {"python": "3.11"}
    settings = content["settings"]
    assert {name: settings[name] for name in run.settings.to_json()} == run.settings.to_json()
    assert (settings["workers"], settings["url"], settings["service_threads"], settings["device"]) == (
        2,
        None,
        1,
        "cpu",
    )


@pytest.mark.parametrize("scale", [1.03, 1.0])
def test_what_the_service_says_it_corrected_is_counted(run: Run, scale: float) -> None:
    rng = np.random.default_rng(0)
    table_points = np.column_stack([rng.uniform(-0.25, 0.25, (20_000, 2)), rng.normal(0, 1e-4, 20_000)])
    seen = CAMERA + scale * (table_points - CAMERA)
    query = GraspQuery(seen, viewpoints=CAMERA, up=UP, support_height=0.0 if scale > 1 else 5.0, calibrate=True)
    said = tuple(calibrated(query)[1])
    assert said
    first = run.rounds[0]
    told = [replace(attempt, warnings=("up not given", *said)) for attempt in first.attempts[:2]]
    records = (replace(first, attempts=(*told, *first.attempts[2:])), *run.rounds[1:])
    asked = replace(run, rounds=records, settings=replace(run.settings, calibrate=True))
    assert report(asked, {})["corrected"] == (2 if scale > 1 else 0)
    assert f"corrected in {2 if scale > 1 else 0} of 10 attempts" in table(asked)
    assert "corrected" not in table(run)


def test_seeds_are_pooled_and_told_apart(run: Run) -> None:
    content = report(run, {})
    assert [content["by_seed"][seed]["gsr"] for seed in ("0", "1")] == [5 / 7, 2 / 3]
    assert "GSR seed 1" in table(run)


def test_a_run_without_attempts_has_no_rate(make_settings: Any) -> None:
    broken = Run(make_settings(), 1, None, None, (), "the service ended with code 1")
    content = report(broken, {})
    assert content["gsr"] is None
    assert content["complete"] is False
    assert content["stopped_by"] == "the service ended with code 1"
    assert "INCOMPLETE: the service ended with code 1" in table(broken)


def test_the_table_says_rates_intervals_and_failures(run: Run) -> None:
    text = table(run)
    assert "70.0 %" in text
    assert "7 of 10 attempts" in text
    assert "7 of 20 objects" in text
    assert "approach 1, slip 1, drop 1" in text
    assert "no candidates 4" in text


def test_the_versions_of_what_decides_results_are_named() -> None:
    versions = package_versions()
    assert {"python", "numpy", "pybullet"} <= set(versions)
    root = Path(__file__).resolve().parents[3]
    assert ("commit" in versions) == (root / ".git").exists()
    if "commit" in versions:
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        assert head.stdout.startswith(versions["commit"].removesuffix("-dirty"))
