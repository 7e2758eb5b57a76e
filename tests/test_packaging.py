"""What is declared is what is used: dependencies, constraints, package data, and nothing of one machine."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.conftest import PATIENCE_S

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
OURS = {"tesnet", "service", "client", "simharness", "training", "weights", "bench", "tests"}
# Where a distribution's name is not the name that is imported.
MODULES = {"import-linter": "importlinter", "pillow": "PIL", "python-neo-lzf": "lzf"}
# PyBullet's wheel brings the module of its data files; FastAPI's requests and responses are Starlette's;
# uvicorn's HTTP is h11's.
ALSO = {"pybullet": {"pybullet_data"}, "fastapi": {"starlette"}, "uvicorn": {"h11"}}
EXTRAS = {
    "client": (),
    "tesnet": ("service",),
    "service": ("service", "ray"),  # of which only service.deploy.ray needs Ray
    "simharness": ("sim", "fusion", "sensors", "watch", "ray"),  # of which only options need all but the first
    "training": ("service", "sim"),
    "bench": ("service", "dev", "mutants"),  # fuzzing needs what generates requests
}


def _declared(extras: tuple[str, ...]) -> set[str]:
    requirements = [*PROJECT["dependencies"]]
    for extra in extras:
        requirements += PROJECT["optional-dependencies"][extra]
    modules: set[str] = set()
    for requirement in requirements:
        name = canonicalize_name(Requirement(requirement).name)
        modules |= {MODULES.get(name, name.replace("-", "_"))} | ALSO.get(name, set())
    return modules


def _is_for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def _imported(path: Path) -> set[str]:
    """Top-level names of the modules that a file imports when it runs."""
    names: set[str] = set()
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "importlib.import_module":
            (argument,) = node.args
            names.add(ast.literal_eval(argument).split(".")[0])
        pending += [] if _is_for_types_only(node) else list(ast.iter_child_nodes(node))
    return names


@pytest.mark.parametrize("package", EXTRAS)
def test_every_import_of_a_package_is_declared_in_its_extra(package: str) -> None:
    allowed = _declared(EXTRAS[package]) | OURS | set(sys.stdlib_module_names)
    for path in sorted((ROOT / package).rglob("*.py")):
        assert _imported(path) <= allowed, f"{path.relative_to(ROOT)}: {sorted(_imported(path) - allowed)}"


def test_every_declared_dependency_of_an_extra_is_imported_by_its_packages() -> None:
    for extra, packages in {
        (): ("client",),
        ("files",): ("tesnet",),
        ("service",): ("tesnet", "service"),
        ("sim",): ("simharness",),
        ("fusion",): ("simharness",),
        ("sensors",): ("simharness",),
        ("watch",): ("simharness",),
        ("ray",): ("service",),
    }.items():
        used = {name for package in packages for path in (ROOT / package).rglob("*.py") for name in _imported(path)}
        core = _declared(()) if extra else set()
        unused = _declared(extra) - core - used - set().union(*ALSO.values())
        assert not unused, f"{extra}: {sorted(unused)}"


def test_every_dependency_has_a_lower_bound_and_a_tested_version() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    tested = {
        canonicalize_name(Requirement(line).name): Requirement(line) for line in lines if line[:1] not in ("#", "")
    }
    for group in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        for requirement in map(Requirement, group):
            if requirement.name == PROJECT["name"]:
                continue
            assert any(bound.operator == ">=" for bound in requirement.specifier), requirement
            (pin,) = tested[canonicalize_name(requirement.name)].specifier
            assert pin.operator == "=="
            assert requirement.specifier.contains(pin.version), f"{requirement} against {pin}"


def test_the_extra_all_holds_every_other_extra() -> None:
    extras = PROJECT["optional-dependencies"]
    (everything,) = map(Requirement, extras["all"])
    assert everything.extras == set(extras) - {"all"}


@pytest.mark.parametrize("package", ["client", "tesnet.geometry", "service.schemas", "tesnet.query", "tesnet.result"])
def test_light_modules_load_nothing_heavy(package: str) -> None:
    heavy = ("torch", "fastapi", "starlette", "uvicorn", "pybullet", "open3d", "trimesh", "matplotlib", "safetensors")
    program = f"import {package}, sys; print(*[name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert done.stdout.strip() == ""


def test_an_installation_carries_the_weights_their_card_and_their_checksum() -> None:
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["weights"]
    for name in ("tesnet.safetensors", "tesnet.md", "SHA256SUMS"):
        assert (ROOT / "weights" / name).is_file()
        assert any(Path(name).match(pattern) for pattern in patterns), name


@pytest.mark.needs("git")
def test_no_tracked_text_names_one_machine_or_a_package_host() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    forbidden = re.compile(r"/home/[a-z]|/opt/[w]heels|pypi[.]org|pythonhosted[.]org|registry[.]npmjs")
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.suffix in (".safetensors", ".npy", ".npz", ".png") or not path.is_file():
            continue
        assert not forbidden.search(path.read_text(encoding="utf-8")), name
