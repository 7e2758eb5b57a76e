"""What the pages in docs/ state of the code is so."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from service.deploy.replicas import Replicas
from service.metrics import Metrics
from service.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")


def default(field: FieldInfo) -> str:
    """A field's default, as the tables have it: in words within the meaning where it is no constant."""
    if field.default_factory is not None or field.default is None:
        return ""
    return f"`{field.default:g}`" if isinstance(field.default, float) else f"`{field.default}`"


def table(model: type[BaseModel], spelling: Callable[[str], str]) -> str:
    rows = (
        f"| `{spelling(name)}` | {field.description} | {default(field)} |" for name, field in model.model_fields.items()
    )
    return "\n".join(rows)


def test_the_settings_are_those_of_the_service() -> None:
    assert table(Settings, lambda field: f"GRASP_{field.upper()}") in PAGE


def test_the_options_are_those_of_the_command() -> None:
    assert table(Replicas, lambda field: f"--{field.replace('_', '-')}") in PAGE


def test_the_metrics_are_those_that_are_exported() -> None:
    metrics = Metrics()
    metrics.watch(lambda: 0, lambda: 0, lambda: True, lambda: 0)
    exported = set(re.findall(r"^# TYPE (grasp_\w+) ", metrics.text().decode(), re.MULTILINE))
    exported -= {name for name in exported if name.endswith("_created")}
    assert set(re.findall(r"`(grasp_\w+)`", PAGE)) == exported


def test_files_and_modules_that_it_names_exist() -> None:
    for path in re.findall(r"service/deploy/[\w/.-]+", PAGE):
        assert (ROOT / path).exists(), path
    for module in re.findall(r"python -m ([\w.]+)", PAGE):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


def test_no_page_holds_the_marks_of_an_unfinished_merge() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("*/*.md")]
    assert len(pages) > 5
    for page in pages:
        assert not re.search(r"^(<{7} |={7}$|>{7} )", page.read_text(encoding="utf-8"), re.MULTILINE), page
