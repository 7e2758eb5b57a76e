from __future__ import annotations

from pathlib import Path

import pytest

from training.__main__ import main


def test_the_command_says_what_is_wrong_with_its_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {"--data": tmp_path / "none", "--validation": tmp_path, "--out": tmp_path / "a", "--threads": 1}
    assert main(["fit", *(str(word) for pair in paths.items() for word in pair)]) == 2
    assert "python -m training generate" in capsys.readouterr().err
