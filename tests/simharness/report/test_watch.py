from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.simharness.commands import WAIT_S, started

pytestmark = pytest.mark.sim


def test_the_run_can_be_watched(start_stub: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ("--rounds", 2, "--url", start_stub(), "--out", out, "--watch", "--watch-port", 0)
    with started(*command) as process:
        assert process.stderr is not None
        line = next(line for line in process.stderr if line.startswith("watch: "))
        page = httpx.get(line.removeprefix("watch: ").strip(), trust_env=False, timeout=WAIT_S)
        output, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == 0, errors
    assert page.status_code == 200
    assert "<html" in page.text
    assert output.startswith("packed scenes")
    report = json.loads((out / "report.json").read_text())
    assert report["complete"] is True
    assert (report["settings"]["workers"], report["settings"]["max_grasps"]) == (1, 10)


def test_a_run_on_single_views_needs_no_library_of_another_extra() -> None:
    heavy = "{'viser', 'scipy', 'trimesh', 'open3d', 'torch', 'fastapi'} & set(sys.modules)"
    script = f"import sys; import simharness.__main__; sys.exit(str({heavy}) if {heavy} else 0)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
