"""Small faults put into the code, one at a time, and which of them no test notices: `make mutants`.

Cosmic Ray makes the faults: another operator, comparison or number, a negated condition, a `break` for a `continue`. A
fault in `a/b.py` meets the tests of `a/b.py`, as CONTRIBUTING.md has it ("Where the test of a line is"), and what they
miss all tests of its package. Faults are put into copies of the tree, never into the tree itself.

Ends with 0 where every fault was noticed or stands in `bench/harmless_mutants.json`, else with 1 and the list of the
others, in that file's form, in `--out`.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from tqdm import tqdm

if TYPE_CHECKING:
    from typing_extensions import Self

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tesnet", "simharness/sim", "simharness/play", "training")
"""Where success is judged and weights are made: what the figures rest on."""

HARMLESS = Path("bench/harmless_mutants.json")
SURVIVORS = "survivors.json"

PASSED, NO_TESTS = 0, 5
"""Exit codes of pytest."""

_RARE = ("LShift", "RShift", "BitOr", "BitAnd", "BitXor", "Is", "IsNot")
"""Operators that nobody writes by mistake for one that is not among them."""

Span = tuple[tuple[int, int], tuple[int, int]]
"""Begin and end in a file: line from 1, column from 0."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One fault.

    Args:
        module: path of the file, from the root.
        line: where, from 1; moves with other changes, so it does not name the fault.
        before: the line without spaces around it.
        after: the same line, or lines, with the fault.
        code: the whole file with the fault.
    """

    module: str
    line: int
    before: str
    after: str
    code: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What names the fault in the list of harmless ones."""
        return self.module, self.before, self.after


@dataclass(frozen=True, slots=True)
class Change:
    """What Cosmic Ray could do: its operator, which of the operator's places in the file, and the line of that."""

    operator: str
    occurrence: int
    line: int


class BrokenTests(Exception):
    """Tests that fail, or are none, before any fault is put in."""


def mirror_of(module: str, root: Path) -> tuple[str, ...]:
    """The test files of a module's name and of its package's; none where there are none."""
    path = Path(module)
    folder = Path("tests") / path.parent
    named = (folder / f"test_{path.name}", folder.parent / f"test_{folder.name}.py")
    return tuple(found.as_posix() for found in named if (root / found).is_file())


def package_of(module: str) -> str:
    """The one of `PACKAGES` that a module belongs to."""
    return next(package for package in PACKAGES if module.startswith(f"{package}/"))


def places(source: str) -> list[list[Change]]:
    """For each place of a module where something can be changed, every change of it, in the order of the file.

    Annotations and the options of dataclasses are no such places: the type checker holds them.
    """
    nodes = list(ast_nodes(get_ast(source)))
    quiet = [span for node in _checked(ast.parse(source)) if (span := _span(node)) is not None]
    found: dict[Span, list[Change]] = defaultdict(list)
    for name in filter(_is_plausible, operator_names()):
        kind = get_operator(name)
        spans = [span for node in nodes for span in kind().mutation_positions(node)]
        for occurrence, span in enumerate(spans):
            if not any(begin <= span[0] and span[1] <= end for begin, end in quiet):
                found[span].append(Change(name, occurrence, span[0][0]))
    return [found[span] for span in sorted(found)]


def _is_plausible(operator: str) -> bool:
    """Whether somebody could have made the fault: not shifted bits where numbers are added, which fails at once."""
    if get_operator(operator).arguments():  # of names, which are others in every file
        return False
    _, *change = operator.split("_")
    return not change or change[-1] not in _RARE or change[0] in _RARE


def mutant(module: str, source: str, change: Change) -> Mutant | None:
    """A change carried out; None where the code is as it was."""
    code: str | None = mutate_code(source, get_operator(change.operator)(), change.occurrence)
    if code is None or code == source:
        return None
    before, after, line = source.splitlines(), code.splitlines(), change.line
    end = line + len(after) - len(before)
    return Mutant(module, line, before[line - 1].strip(), " ".join(map(str.strip, after[line - 1 : end])), code)


def _checked(tree: ast.Module) -> Iterator[ast.AST | None]:
    """What the type checker holds, and tests need not."""
    for node in ast.walk(tree):
        yield getattr(node, "annotation", None)
        yield getattr(node, "returns", None)
        if isinstance(node, ast.ClassDef):
            yield from (call for call in node.decorator_list if isinstance(call, ast.Call))


def _span(node: ast.AST | None) -> Span | None:
    if isinstance(node, ast.expr) and node.end_lineno is not None and node.end_col_offset is not None:
        return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)
    return None


def sample(package: str, count: int, seed: int, root: Path) -> list[Mutant]:
    """Faults at so many different places of a package; the same seed draws the same ones from the same code."""
    rng = random.Random(f"{seed} {package}")
    paths = [path.relative_to(root).as_posix() for path in sorted((root / package).rglob("*.py"))]
    sources = {path: (root / path).read_text(encoding="utf-8") for path in paths if mirror_of(path, root)}
    everywhere = [(module, place) for module, source in sources.items() for place in places(source)]
    rng.shuffle(everywhere)
    made = (mutant(module, sources[module], rng.choice(place)) for module, place in everywhere)
    return list(islice((one for one in made if one is not None), count))


class Laboratory:
    """Copies of the tree, one for each of `workers` that try faults side by side."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._free: queue.Queue[Path] = queue.Queue()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        files = _tracked()
        for _ in range(self._workers):
            copy = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="mutants-")))
            for name in files:
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, copy / name)
            self._free.put(copy)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def seconds(self, tests: Sequence[str]) -> float:
        """How long test files take without a fault.

        Raises:
            BrokenTests: they do not pass.
        """
        with self._copy() as copy:
            began = time.perf_counter()
            code = _run(copy, tests, None)
        if code != PASSED:
            raise BrokenTests(f"{' '.join(tests)}: do not pass as they are (pytest ends with {code}); mend them first")
        return time.perf_counter() - began

    def notice(self, mutant: Mutant, tests: Sequence[str], limit_s: float) -> bool:
        """Whether tests fail with a fault, or take longer than the limit."""
        with self._copy() as copy:
            path = copy / mutant.module
            whole = path.read_text(encoding="utf-8")
            path.write_text(mutant.code, encoding="utf-8")
            try:
                code = _run(copy, tests, limit_s)
            finally:
                path.write_text(whole, encoding="utf-8")
        assert code != NO_TESTS
        return code != PASSED

    @contextmanager
    def _copy(self) -> Iterator[Path]:
        copy = self._free.get()
        try:
            yield copy
        finally:
            self._free.put(copy)


def _tracked() -> list[str]:
    """The files of the tree that git knows, or would know."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def _run(copy: Path, tests: Sequence[str], limit_s: float | None) -> int | None:
    """Exit code of pytest on files of a copy; None after `limit_s` seconds, when it is ended with what it started."""
    command = [sys.executable, "-m", "pytest", "--exitfirst", "--quiet", "-p", "no:cacheprovider", *tests]
    # Without bytecode, which Python would take for the next fault's where two are written within its clock's step.
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=copy, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        return None
    finally:
        with suppress(ProcessLookupError):  # of the whole group, as a rule
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def try_all(chosen: Sequence[Mutant], workers: int, harmless: Container[tuple[str, str, str]] = ()) -> list[Mutant]:
    """The faults that no test noticed: none of their modules', and of those left none of their packages'.

    Args:
        chosen: what is tried.
        workers: so many side by side.
        harmless: keys of faults that the tests of their packages need not be tried on.

    Raises:
        BrokenTests: tests that do not pass without a fault.
    """
    with Laboratory(workers) as laboratory, ThreadPoolExecutor(workers) as pool:

        def missed(mutants: Sequence[Mutant], tests: Sequence[tuple[str, ...]]) -> list[Mutant]:
            different = sorted(set(tests))
            limits = dict(zip(different, map(limit, pool.map(laboratory.seconds, different)), strict=True))
            tried = pool.map(laboratory.notice, mutants, tests, [limits[files] for files in tests])
            noticed = list(tqdm(tried, total=len(mutants), unit="fault", file=sys.stderr))
            return [mutant for mutant, seen in zip(mutants, noticed, strict=True) if not seen]

        left = missed(chosen, [mirror_of(mutant.module, ROOT) for mutant in chosen])
        unknown = [mutant for mutant in left if mutant.key not in harmless]
        unknown = missed(unknown, [(f"tests/{package_of(mutant.module)}",) for mutant in unknown])
    return [mutant for mutant in left if mutant in unknown or mutant.key in harmless]


def limit(seconds: float) -> float:
    """Seconds after which a fault counts as noticed, where its tests take so many without it: it runs for ever."""
    return 60 + 5 * seconds


def known_harmless(text: str) -> dict[tuple[str, str, str], str]:
    """The reason why each fault of the list is harmless."""
    return {(item["module"], item["before"], item["after"]): item["why"] for item in json.loads(text)}


def table(chosen: Iterable[Mutant], survivors: Iterable[Mutant], harmless: Mapping[tuple[str, str, str], str]) -> str:
    """One line per package: faults, those noticed, those known to be harmless, the others; noticed of what can be."""
    rows = [f"{'':16}  {'faults':>7}  {'noticed':>7}  {'harmless':>8}  {'survived':>8}  {'%':>5}"]
    chosen, survivors = list(chosen), list(survivors)
    for package in PACKAGES:
        tried = [mutant for mutant in chosen if package_of(mutant.module) == package]
        left = [mutant for mutant in survivors if package_of(mutant.module) == package]
        excused = sum(mutant.key in harmless for mutant in left)
        noticed = len(tried) - len(left)
        share = 100 * noticed / max(len(tried) - excused, 1)
        rows.append(f"{package:16}  {len(tried):7}  {noticed:7}  {excused:8}  {len(left) - excused:8}  {share:5.1f}")
    return "\n".join(rows)


def as_json(survivors: Iterable[Mutant]) -> str:
    """Survivors in the form of the list of harmless ones, where one goes with its reason."""
    items: list[dict[str, Any]] = [
        {"module": mutant.module, "before": mutant.before, "after": mutant.after, "why": ""} for mutant in survivors
    ]
    return json.dumps(items, indent=1, ensure_ascii=False) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.mutants", description=(__doc__ or "").split("\n")[0])
    add = parser.add_argument
    add("--each", type=int, default=40, metavar="N", help="faults in each package (default %(default)s)")
    add("--seed", type=int, default=0, help="of the sample (default %(default)s)")
    add("--workers", type=int, default=2, metavar="N", help="faults tried side by side (default %(default)s)")
    add("--packages", nargs="+", choices=PACKAGES, default=PACKAGES, help="which (default: all)")
    add("--out", type=Path, default=Path("mutants-report"), metavar="DIR", help="where the list goes")
    options = parser.parse_args(arguments)
    chosen = [one for package in options.packages for one in sample(package, options.each, options.seed, ROOT)]
    harmless = known_harmless((ROOT / HARMLESS).read_text(encoding="utf-8"))
    try:
        survivors = try_all(chosen, options.workers, harmless)
    except BrokenTests as error:
        print(f"mutants: {error}", file=sys.stderr)
        return 2
    new = [mutant for mutant in survivors if mutant.key not in harmless]
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / SURVIVORS).write_text(as_json(new), encoding="utf-8")
    for mutant in new:
        print(f"{mutant.module}:{mutant.line}\n    {mutant.before}\n    {mutant.after}")
    print(f"{table(chosen, survivors, harmless)}\n{options.out / SURVIVORS}")
    return 1 if new else 0


if __name__ == "__main__":
    sys.exit(main())
