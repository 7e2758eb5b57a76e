"""A program or library that is missing costs its tests and nothing else, unless gaps are forbidden."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import needs
from tests.conftest import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
BROWSED = "tests/service/test_viewer.py::test_a_browser_lists_and_draws_the_grasps_of_the_example"
COMPILED = "tests/test_examples.py::test_an_example_prints_the_best_grasps[cpp]"


def without_programs(tmp_path: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A command of Python's where no program is on the PATH."""
    return subprocess.run(
        [sys.executable, *command],
        cwd=ROOT,
        env={**os.environ, "PATH": str(tmp_path), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.mark.parametrize(("workers", "flags", "code"), [("0", [], 0), ("1", [], 0), ("0", ["--no-gaps"], 1)])
def test_what_is_left_out_is_told_in_one_block_with_one_line_that_brings_it(
    tmp_path: Path, workers: str, flags: list[str], code: int
) -> None:
    plugins = ["-p", "no:cacheprovider", "-n", workers]
    ended = without_programs(tmp_path, "-m", "pytest", *plugins, *flags, BROWSED, COMPILED)
    assert ended.returncode == code, ended.stdout
    block = ended.stdout.split("left out: what they need is not on this machine")[1].splitlines()
    assert block[1:10] == [
        "chromium (Debian: chromium), for",
        f"    {BROWSED}",
        "curl/curl.h (Debian: libcurl4-openssl-dev), for",
        f"    {COMPILED}",
        "g++ (Debian: g++), for",
        f"    {COMPILED}",
        "nlohmann/json.hpp (Debian: nlohmann-json3-dev), for",
        f"    {COMPILED}",
        "To run them all: apt-get install --no-install-recommends chromium g++ libcurl4-openssl-dev nlohmann-json3-dev",
    ]
    assert ("2 error" if code else "2 skipped") in ended.stdout.splitlines()[-1]


def test_the_table_says_what_is_missing_before_anything_is_installed(tmp_path: Path) -> None:
    ended = without_programs(tmp_path, "-S", "tests/needs.py")  # without installed packages
    programs = {"chromium", "curl", "g++", "git", "jq", "libcurl4-openssl-dev", "nlohmann-json3-dev", "nodejs", "rustc"}
    assert (ended.returncode, ended.stderr) == (0, "")
    assert programs <= set(ended.stdout.split())


def test_headers_and_libraries_are_looked_for_as_they_are_used() -> None:
    def part(name: str, kind: str) -> needs.Part:
        return needs.Part(name, "a-package", getattr(needs, f"_is_{kind}"))

    assert part("no-such-header.hpp", "header").missing
    assert part("libno-such-library.so.1", "library").missing
    assert not part("libc.so.6", "library").missing
    with pytest.raises(KeyError, match="no-such-need"):
        needs.missing(["no-such-need"])


def test_continuous_integration_installs_what_the_table_names_and_allows_no_gap() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "tests/needs.py" in script
    assert "--no-gaps" in script
