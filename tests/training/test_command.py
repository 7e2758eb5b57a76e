from __future__ import annotations

import argparse
import inspect
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tesnet import networks
from training import __main__ as command
from training.__main__ import main
from training.fit import PRESETS
from training.generate import GenerateConfig
from training.viewing import MoreViews
from training.views import Fold

Told = list[dict[str, Any]]


def test_the_command_says_what_is_wrong_with_its_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {"--data": tmp_path / "none", "--validation": tmp_path, "--out": tmp_path / "a", "--threads": 1}
    assert main(["fit", *(str(word) for pair in paths.items() for word in pair)]) == 2
    assert "python -m training generate" in capsys.readouterr().err


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> dict[str, Told]:
    """What each command's function is told, by the names of its parameters; the functions do nothing."""
    calls: dict[str, Told] = {}

    def noting(function: Callable[..., Any], calls_of_it: Told) -> Callable[..., dict[str, str]]:
        def noted(*arguments: Any, **options: Any) -> dict[str, str]:
            bound = inspect.signature(function).bind(*arguments, **options)
            bound.apply_defaults()
            calls_of_it.append(dict(bound.arguments))
            return {"done": function.__name__}

        return noted

    for name in (
        "generate",
        "pack",
        "unpack",
        "fit",
        "mean",
        "learn_centring",
        "learn_second_look",
        "evaluate",
        "compare",
    ):
        monkeypatch.setattr(command, name, noting(getattr(command, name), calls.setdefault(name, [])))
    return calls


GENERATE = {
    "scene": "pile", "objects": "procedural,ycb", "exclude": "few.txt", "seed": 7, "views": 3, "labels_per_view": 11,
    "colliding_share": 0.25, "mine": "w.safetensors", "camera": "any", "sensor": "d435", "gripper": "rg2",
    "model": "gpd", "scale": (0.4, 0.6), "mass": (0.05, 0.2), "friction": (0.3, 0.9), "things": 4,
    "labels": 500, "workers": 6, "out": "labels", "resume": True, "ray": "head:6379",
}  # fmt: skip
UNPACK = {
    "archive": "archive", "objects": "procedural,ycb", "out": "rendered", "workers": 3, "scenes": 12, "seed": 5,
    "model": "gpd", "more_views": 2, "camera": "any", "sensor": "tof",
}  # fmt: skip
FIT = {
    "model": "gpd", "data": ("one", "two"), "validation": ("three", "four"), "calibration": ("five", "six"),
    "preset": "paper", "start": "w.safetensors", "epochs": 3, "threads": 5, "seed": 9, "version": "1.2",
    "out": "o/new.w", "objects": "procedural,ycb", "more_views": 2, "camera": "top", "sensor": "d415",
    "device": "cuda:1", "leave_out": "1/3",
}  # fmt: skip
EVALUATE = {"model": "gpd", "weights": "w.safetensors", "data": ("one", "two"), "seed": 4}
MEAN = {
    "weights": ("a.w", "b.w"), "validation": ("one", "two"), "preset": "product", "seed": 8, "version": "1.3",
    "out": "o/mean.w",
}  # fmt: skip
CENTRING = {
    "archive": "packed", "objects": "procedural,ycb", "scenes": 12, "workers": 3, "samples": "drawn", "epochs": 4,
    "seed": 6, "version": "1.4", "out": "o/centring.w",
}  # fmt: skip
SECOND_LOOK = {"weights": "w.safetensors", **CENTRING, "version": "1.5", "scored_by": ("c.w", "d.w")}
COMPARE = {"data": "runs", "out": "tables", "validation": ("one", "two")}
PACK = {"data": ("one", "two"), "out": "archive"}
EVERY_OPTION: dict[str, dict[str, Any]] = {
    "generate": GENERATE, "pack": PACK, "unpack": UNPACK, "fit": FIT, "mean": MEAN, "evaluate": EVALUATE,
    "centring": CENTRING, "second-look": SECOND_LOOK, "compare": COMPARE,
}  # fmt: skip


def words(options: dict[str, Any]) -> list[str]:
    """Options as a command line has them."""
    line: list[str] = []
    for name, value in options.items():
        line.append(f"--{name.replace('_', '-')}")
        if value is not True:
            line += map(str, value) if isinstance(value, tuple) else [str(value)]
    return line


def paths(names: Any) -> list[Path]:
    return [Path(name) for name in names]


def test_every_option_of_every_command_is_in_the_lists_that_are_tested() -> None:
    (commands,) = [action for action in command._parser()._actions if isinstance(action, argparse._SubParsersAction)]
    assert set(commands.choices) == set(EVERY_OPTION)
    for name, parser in commands.choices.items():
        assert {action.dest for action in parser._actions} - {"help"} == set(EVERY_OPTION[name])
        for option, value in EVERY_OPTION[name].items():
            assert parser.get_default(option) != value, option  # or it could be ignored unnoticed


def test_what_is_generated_is_what_the_options_say(told: dict[str, Told], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", *words(GENERATE)]) == 0
    (asked,) = told["generate"]
    of_run = {name: asked[name] for name in ("labels", "workers", "resume", "ray")}
    assert of_run == {name: GENERATE[name] for name in of_run}
    assert asked["out"] == Path("labels")
    config = asdict(asked["config"])
    assert config == {name: GENERATE[name] for name in config} | {
        "exclude": Path("few.txt"), "mine": Path("w.safetensors"),
    }  # fmt: skip
    assert json.loads(capsys.readouterr().out) == {"done": "generate"}
    assert main(["generate", *words({**GENERATE, "colliding_share": "natural"})]) == 0
    assert told["generate"][1]["config"].colliding_share is None
    assert main(["generate", *words({**GENERATE, "mass": (0.2, 0.1)})]) == 2
    assert "--mass 0.2 0.1" in capsys.readouterr().err
    needed = {name: GENERATE[name] for name in ("scene", "objects", "labels", "out")}
    assert main(["generate", *words(needed)]) == 0
    assert told["generate"][2]["config"] == GenerateConfig("pile", "procedural,ycb")


def test_what_is_packed_rendered_averaged_measured_and_compared_is_what_the_options_say(told: dict[str, Told]) -> None:
    for name in ("pack", "unpack", "mean", "evaluate", "compare"):
        assert main([name, *words(EVERY_OPTION[name])]) == 0
    assert told["pack"] == [{"folders": paths(["one", "two"]), "out": Path("archive")}]
    assert told["unpack"] == [
        {
            "archive": Path("archive"), "objects": "procedural,ycb", "out": Path("rendered"), "workers": 3,
            "more_views": MoreViews(2, "any", "tof"), "scenes": 12, "seed": 5,
            "preparation": networks.NETWORKS["gpd"][0].preparation,
        }
    ]  # fmt: skip
    assert told["mean"] == [
        {
            "files": paths(["a.w", "b.w"]), "validation": paths(["one", "two"]), "out": Path("o/mean.w"), "seed": 8,
            "version": "1.3", "settings": PRESETS["product"].network,
        }
    ]  # fmt: skip
    needed = {name: MEAN[name] for name in ("weights", "validation", "out")}
    assert main(["mean", *words(needed)]) == 0
    assert told["mean"][1]["settings"] == {}
    assert main(["centring", *words(CENTRING)]) == 0
    files = {name: Path(str(CENTRING[name])) for name in ("archive", "samples", "out")}
    assert told["learn_centring"] == [CENTRING | files]
    assert main(["second-look", *words(SECOND_LOOK)]) == 0
    asked = {name: value for name, value in SECOND_LOOK.items() if name != "weights"}
    weights = {"file": Path("w.safetensors"), "scored_by": paths(["c.w", "d.w"])}
    assert told["learn_second_look"] == [asked | files | weights]
    (evaluated,) = told["evaluate"]
    assert evaluated == {
        "name": "gpd", "path": Path("w.safetensors"), "data": paths(["one", "two"]), "seed": 4,
    }  # fmt: skip
    assert told["compare"] == [{"data": Path("runs"), "out": Path("tables"), "validation": paths(["one", "two"])}]


@pytest.mark.parametrize("is_archive", [False, True])
def test_what_is_trained_is_what_the_options_say(
    told: dict[str, Told], monkeypatch: pytest.MonkeyPatch, is_archive: bool
) -> None:
    """Archives among the data are rendered first, for the network that is trained, with the further views."""
    monkeypatch.setattr(command, "is_archive", lambda folder: is_archive and folder == Path("two"))
    assert main(["fit", *words(FIT)]) == 0
    rendered = Path("o") / "two-rendered"
    assert told["fit"] == [
        {
            "name": "gpd", "data": [Path("one"), rendered if is_archive else Path("two")],
            "validation": paths(["three", "four"]), "calibration": paths(["five", "six"]), "recipe": PRESETS["paper"],
            "out": Path("o/new.w"), "epochs": 3, "threads": 5, "device": "cuda:1", "seed": 9, "version": "1.2",
            "start": Path("w.safetensors"), "leave_out": Fold(1, 3),
        }
    ]  # fmt: skip
    assert told["unpack"] == [
        {
            "archive": Path("two"), "objects": "procedural,ycb", "out": rendered, "workers": 5,
            "more_views": MoreViews(2, "top", "d415"), "scenes": None, "seed": 0,
            "preparation": networks.NETWORKS["gpd"][0].preparation,
        }
    ] * is_archive  # fmt: skip


@pytest.mark.parametrize("fold", ["2/2", "-1/2", "1", "a/b"])
def test_a_fold_that_there_is_not_is_refused(fold: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["fit", f"--leave-out={fold}", "--data", "a", "--validation", "b", "--out", "c"])
    assert "--leave-out" in capsys.readouterr().err
