from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

from bench.mutants import (
    HARMLESS,
    PACKAGES,
    ROOT,
    BrokenTests,
    Laboratory,
    Mutant,
    as_json,
    known_harmless,
    limit,
    mirror_of,
    mutant,
    places,
    sample,
    table,
    try_all,
)

SOURCE = """from __future__ import annotations

LIMIT: float | None = 3.0


def is_near(a: float, b: float | None = None) -> bool | None:
    if b is None:
        return None
    return a - b < LIMIT
"""


def all_mutants(source: str) -> list[Mutant]:
    made = [mutant("a/b.py", source, change) for place in places(source) for change in place]
    return [one for one in made if one is not None]


def test_a_module_meets_the_tests_of_its_name_and_of_its_package(tmp_path: Path) -> None:
    for name in ("tests/a/test_b.py", "tests/a/nets/test_large.py", "tests/a/test_nets.py"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert mirror_of("a/b.py", tmp_path) == ("tests/a/test_b.py",)
    assert mirror_of("a/nets/small.py", tmp_path) == ("tests/a/test_nets.py",)
    assert mirror_of("a/nets/large.py", tmp_path) == ("tests/a/nets/test_large.py", "tests/a/test_nets.py")
    assert mirror_of("a/other.py", tmp_path) == ()


def test_every_package_has_tests_to_meet() -> None:
    for package in PACKAGES:
        modules = [path.relative_to(ROOT).as_posix() for path in (ROOT / package).rglob("*.py")]
        assert sum(bool(mirror_of(module, ROOT)) for module in modules) >= 5, package


def test_every_fault_is_one_change_of_code_that_runs() -> None:
    faults = all_mutants(SOURCE)
    assert {(fault.line, fault.after) for fault in faults} >= {
        (3, "LIMIT: float | None = 4.0"),
        (7, "if b is not None:"),
        (9, "return a + b < LIMIT"),
        (9, "return a - b <= LIMIT"),
    }
    for fault in faults:
        ast.parse(fault.code)
        assert fault.code != SOURCE
        assert SOURCE.splitlines()[fault.line - 1].strip() == fault.before
        changed = [pair for pair in zip(SOURCE.splitlines(), fault.code.splitlines(), strict=False) if len({*pair}) > 1]
        assert changed[0][0].strip() == fault.before


def test_options_of_dataclasses_are_left_alone() -> None:
    source = "@dataclass(frozen=True)\nclass A:\n    b: int = 1\n"
    assert {fault.line for fault in all_mutants(source)} <= {1, 3}
    assert not any("False" in fault.after for fault in all_mutants(source))


def test_annotations_are_left_alone_and_so_are_bits_where_there_are_none() -> None:
    afters = [fault.after for fault in all_mutants(SOURCE)]
    assert all("float | None" in after for after in afters if "float" in after)
    assert not any("<<" in after or "^" in after for after in afters)
    assert "x = a & b" in [fault.after for fault in all_mutants("x = a | b\n")]


def test_a_sample_is_repeatable_and_of_different_places() -> None:
    first, again = (sample("training", 12, seed=3, root=ROOT) for _ in range(2))
    assert first == again
    assert len(first) == 12
    assert len({fault.key for fault in first}) == 12
    assert first != sample("training", 12, seed=4, root=ROOT)


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository whose module has a test of one of its two lines."""
    monkeypatch.setattr("bench.mutants.ROOT", tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "tests" / "a").mkdir(parents=True)
    (tmp_path / "a" / "b.py").write_text("one = 1\ntwo = 2\n")
    (tmp_path / "tests" / "a" / "test_b.py").write_text(
        "import time\nfrom a.b import one\n\n"
        "def test_one():\n    while one > 1: time.sleep(0.01)\n    assert one == 1\n"
    )
    monkeypatch.setattr("bench.mutants._tracked", lambda: ["a/b.py", "tests/a/test_b.py"])
    return tmp_path


def test_a_fault_is_noticed_by_a_test_that_fails_or_does_not_end_and_the_tree_stays_as_it_is(tree: Path) -> None:
    def fault(code: str) -> Mutant:
        return Mutant("a/b.py", 1, "", "", code)

    with Laboratory(1) as laboratory:
        tests = ["tests/a/test_b.py"]
        assert laboratory.seconds(tests) > 0
        assert laboratory.notice(fault("one = 0\ntwo = 2\n"), tests, limit(0))
        assert not laboratory.notice(fault("one = 1\ntwo = 3\n"), tests, limit(0))
        assert laboratory.notice(fault("one = 2\ntwo = 2\n"), tests, limit_s=5)
        assert laboratory.notice(fault("one = \n"), tests, limit(0))
        assert laboratory.seconds(["tests/a/test_b.py"]) > 0
    assert (tree / "a" / "b.py").read_text() == "one = 1\ntwo = 2\n"


def test_what_a_modules_own_tests_miss_meets_those_of_its_package(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tree / "tests" / "a" / "test_c.py").write_text("from a.b import two\n\ndef test_two():\n    assert two < 4\n")
    monkeypatch.setattr("bench.mutants.PACKAGES", ("a",))
    monkeypatch.setattr("bench.mutants._tracked", lambda: ["a/b.py", "tests/a/test_b.py", "tests/a/test_c.py"])
    values = ((0, 2), (1, 4), (1, 3), (1, 5))
    faults = [Mutant("a/b.py", 2, "", f"{one}, {two}", f"one = {one}\ntwo = {two}\n") for one, two in values]
    assert try_all(faults, workers=2) == faults[2:3]
    assert try_all(faults, workers=2, harmless=[fault.key for fault in faults]) == faults[1:]


def test_tests_that_fail_without_a_fault_are_told(tree: Path) -> None:
    (tree / "tests" / "a" / "test_b.py").write_text("def test_one():\n    assert False\n")
    with Laboratory(1) as laboratory, pytest.raises(BrokenTests, match=r"tests/a/test_b\.py: do not pass"):
        laboratory.seconds(["tests/a/test_b.py"])


def test_a_survivor_with_a_reason_is_harmless_and_not_counted() -> None:
    faults = [Mutant("training/fit.py", line, f"x = {line}", f"x = {line + 1}", "") for line in range(10)]
    listed = json.loads(as_json(faults[:3]))
    assert [set(item) for item in listed] == [{"module", "before", "after", "why"}] * 3
    harmless = known_harmless(json.dumps([{**listed[0], "why": "only said in a message"}]))
    assert [fault.key in harmless for fault in faults[:3]] == [True, False, False]
    row = table(faults, faults[:3], harmless).splitlines()[-1].split()
    assert row == ["training", "10", "7", "1", "2", "77.8"]


def test_every_harmless_fault_is_one_of_today_and_says_why() -> None:
    for (module, before, after), why in known_harmless((ROOT / HARMLESS).read_text(encoding="utf-8")).items():
        lines = [line.strip() for line in (ROOT / module).read_text(encoding="utf-8").splitlines()]
        assert before in lines, f"{module} has no line {before!r} any more; take the fault off {HARMLESS}"
        assert before != after
        assert len(why.split()) >= 3, (module, before)
