"""That a stranger finds the test of a line: the rule of CONTRIBUTING.md, "Where the test of a line is"."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

ELSEWHERE = {
    "service/__main__.py": "tests/service/test_process.py",
    "client/__main__.py": "tests/client/test_command.py",
    "simharness/__main__.py": "tests/simharness/test_cli.py",
    "training/__main__.py": "tests/training/test_command.py",
    "tesnet/notices.py": "tests/tesnet/test_predictor.py",
    "tesnet/result.py": "tests/tesnet/test_predictor.py",
}
"""What `python -m` starts is tested as its user meets it, and an answer and its warnings by what fills it."""


@pytest.mark.parametrize("package", ["client", "service", "simharness", "tesnet", "training"])
def test_every_module_has_a_test_file_of_its_name_or_of_its_package(package: str) -> None:
    modules = [path.relative_to(ROOT) for path in sorted((ROOT / package).rglob("*.py")) if path.name != "__init__.py"]
    assert modules
    without = []
    for module in modules:
        own = ROOT / "tests" / module.parent / f"test_{module.name}"
        of_its_package = ROOT / "tests" / module.parent.parent / f"test_{module.parent.name}.py"
        elsewhere = ROOT / ELSEWHERE.get(module.as_posix(), "none")
        if not (own.exists() or of_its_package.exists() or elsewhere.exists()):
            without.append(module.as_posix())
    assert without == []


CHANGE = {
    "service/batching.py": {"_Running"},
    "service/middleware.py": {"RequestRecord"},
    "service/turns.py": {"Job"},
    "simharness/play/crew.py": {"_Process"},
    "tesnet/formats/ply.py": {"_Element"},
    "training/fit.py": {"_Progress"},
}
"""What is noted as things go on; every other value stays as it was made."""


def test_values_stay_as_they_were_made() -> None:
    changing: dict[str, set[str]] = {}
    for package in ("client", "service", "simharness", "tesnet", "training"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                made = [one for one in getattr(node, "decorator_list", []) if "dataclass" in ast.unparse(one)]
                if made and "frozen=True" not in ast.unparse(made[0]) and isinstance(node, ast.ClassDef):
                    changing.setdefault(path.relative_to(ROOT).as_posix(), set()).add(node.name)
    assert changing == CHANGE


def test_every_refusal_names_the_field_and_then_says_what_is_wrong_with_it() -> None:
    seen = 0
    for package in ("client", "service", "tesnet"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call) or len(node.args) < 2:
                    continue
                if ast.unparse(node.func) not in ("Invalid", "InvalidQuery", "InvalidArgument", "InvalidSetting"):
                    continue
                field, words = (
                    "".join(str(part.value) for part in ast.walk(argument) if isinstance(part, ast.Constant))
                    for argument in node.args[:2]
                )
                where = f"{path.relative_to(ROOT)}:{node.lineno}"
                assert field.count(" ") <= 1, where
                assert words.count(" ") > 1 or isinstance(node.args[1], ast.Name | ast.Call), where
                seen += 1
    assert seen > 50
