"""What the README shows works as it stands there, against a real server."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.scene import five_objects
from service.schemas import GraspOptions
from tests.conftest import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHOWN_URL = "http://127.0.0.1:8000"


def _snippet(language: str, containing: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)
    (block,) = [block for block in blocks if containing in block]
    assert isinstance(block, str)
    return block


def _run(command: list[str]) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.needs("curl")
def test_the_curl_command_returns_three_ranked_grasps(service_url: str) -> None:
    answer = json.loads(_run(["bash", "-c", _snippet("sh", "curl").replace(SHOWN_URL, service_url)]))
    scores = [grasp["score"] for grasp in answer["grasps"]]
    assert len(scores) == 3, answer
    assert scores == sorted(scores, reverse=True)
    assert answer["warnings"] == []


def test_the_python_snippet_prints_ten_grasps(service_url: str) -> None:
    printed = _run(
        [sys.executable, "-W", "error", "-c", _snippet("python", "GraspClient").replace(SHOWN_URL, service_url)]
    )
    assert len(re.findall(r"^[01]\.\d\d  TCP at \[", printed, flags=re.MULTILINE)) == 10, printed


def test_the_first_two_commands_are_demo_and_test() -> None:
    commands = [
        line.split("#")[0].strip() for line in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)[0].splitlines()
    ]
    assert commands == ["make demo", "make test"]


def test_the_options_table_lists_the_options_of_the_wire_in_order() -> None:
    table = README.split("## Options")[1].split("##")[0]
    names = [name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)]
    assert names == list(GraspOptions.model_fields)


def test_links_lead_to_files() -> None:
    for page in ("README.md", "CONVENTIONS.md", "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)]+)\)", (ROOT / page).read_text(encoding="utf-8")):
            assert (ROOT / target).is_file(), f"{page} links to {target}"


def test_the_example_cloud_is_the_benchmark_scene() -> None:
    points = np.load(ROOT / "examples" / "clutter.npy", allow_pickle=False)
    np.testing.assert_allclose(points, five_objects(len(points)).points_world, atol=1e-6)
