from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest

from simharness.errors import UsageError
from simharness.flags_from_settings import (
    compare_parser,
    out_of,
    robustness_parser,
    run_parser,
    settings_of,
    trials_of,
)
from simharness.play.settings import RunSettings, flags
from simharness.report.compare import Trial


def asked(*arguments: str) -> RunSettings:
    return settings_of(run_parser().parse_args(arguments))


def test_nothing_said_asks_for_the_defaults_of_the_flags() -> None:
    settings = asked()
    for name, (_, flag) in flags().items():
        assert getattr(settings, name) == (flag.default if name != "objects" else "procedural")
    assert (settings.seeds, settings.max_grasps) == ((0,), 1)


@pytest.mark.parametrize("name", list(flags()))
def test_every_flag_reaches_its_setting_and_no_other(name: str) -> None:
    kind, flag = flags()[name]
    value: Any = "other"
    literal = next((one for one in (kind, *get_args(kind)) if get_origin(one) is Literal), None)
    if flag.choices is not None:
        value = next(choice for choice in flag.choices if choice != flag.default)
    elif literal is not None:
        value = next(choice for choice in get_args(literal) if choice != flag.default)
    elif flag.least is not None:
        value = flag.least
    elif flag.within is not None:
        value = (flag.within.low + flag.within.high) / 2
    elif bool in get_args(kind):
        value = True
    option = f"--{name.replace('_', '-')}"
    given, nothing = asked(option, *([] if value is True else [str(value)])), asked()
    changed = {
        field.name for field in fields(RunSettings) if getattr(given, field.name) != getattr(nothing, field.name)
    }
    assert getattr(given, name) == value
    # Other scenes have other objects; the camera that the flag is given here, the side view, calibrates.
    assert changed == {"scene": {"scene", "objects"}, "camera": {"camera", "calibrate"}}.get(name, {name})


def test_only_seeds_and_the_number_of_grasps_are_asked_for_otherwise() -> None:
    assert {field.name for field in fields(RunSettings)} - set(flags()) == {"seeds", "max_grasps"}
    assert asked("--seed", "3").seeds == (3,)
    assert asked("--seeds", "3", "1").seeds == (3, 1)
    assert asked("--watch").max_grasps > 1


def test_help_states_every_default() -> None:
    text = " ".join(run_parser().format_help().split())
    for name, (_, flag) in flags().items():
        assert f"--{name.replace('_', '-')}" in text
        if flag.default is not None:
            assert f"(default {flag.default})" in text


def test_the_side_view_calibrates_unless_told_otherwise() -> None:
    assert asked("--camera", "giga").calibrate
    assert asked("--camera", "giga").shows_table
    assert not asked("--camera", "giga", "--no-calibrate").shows_table
    assert not asked("--sensor", "dex").calibrate
    assert not asked("--camera", "giga", "--no-table-in-view").shows_table


def test_piles_are_made_of_other_objects_unless_some_are_named() -> None:
    assert asked("--scene", "pile").objects == "pybullet-random"
    assert asked("--scene", "pile", "--objects", "procedural").objects == "procedural"


def test_files_are_found_again_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "list.txt").write_text("")
    monkeypatch.chdir(tmp_path)
    settings = asked("--objects", "list.txt", "--exclude", "list.txt", "--only", "missing.txt")
    assert settings.objects == settings.exclude == str((tmp_path / "list.txt").resolve())
    assert settings.only == "missing.txt"


def test_a_study_has_the_random_camera_as_it_is() -> None:
    options = robustness_parser().parse_args(["--rounds", "3"])
    assert settings_of(options) == asked("--rounds", "3")
    with pytest.raises(SystemExit):
        robustness_parser().parse_args(["--voxel-size", "0.005"])


def test_flags_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(UsageError, match="named twice"):
        asked("--seeds", "1", "1")
    with pytest.raises(UsageError, match="leave out --ray"):
        asked("--watch", "--ray", "auto")
    with pytest.raises(UsageError, match="--out"):
        asked("--resume")


def test_reports_go_where_they_are_wanted() -> None:
    options = run_parser().parse_args(["--out", "here"])
    assert out_of(options, "packed") == Path("here")
    found = out_of(run_parser().parse_args([]), "robustness-pile-strict")
    assert found.parent == Path("runs")
    assert found.name.startswith("robustness-pile-strict-")


def compared(*arguments: str) -> list[Trial]:
    return trials_of(compare_parser().parse_args(arguments))


def test_a_comparison_plays_every_scene_and_executor_with_every_network(tmp_path: Path) -> None:
    path = tmp_path / "gpd-0.safetensors"
    path.touch()
    trials = compared(
        "--models", f"tesnet,gpd={path}", "heuristic", "--executors", "edge", "strict", "--rounds", "7", "--out", "x"
    )
    assert [trial.name for trial in trials[:3]] == ["packed-edge/tesnet", "packed-edge/gpd-0", "packed-edge/heuristic"]
    assert [trial.condition for trial in trials[::3]] == ["packed-edge", "packed-strict", "pile-edge", "pile-strict"]
    assert [trial.contestant.weights for trial in trials[:3]] == [None, path, None]
    assert {trial.settings.rounds for trial in trials} == {7}
    assert trials[1].settings == asked("--model", "gpd", "--rounds", "7")
    assert trials[-1].settings == asked(
        "--scene", "pile", "--executor", "strict", "--model", "heuristic", "--rounds", "7"
    )
    assert {trial.condition for trial in compared("--models", "tesnet", "--scenes", "pile")} == {"pile-edge"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tesnet,tesnet"], "different names"),
        ([","], "different names"),
        (["gpd=nowhere.safetensors"], "no file nowhere"),
        (["gpd="], "without a name"),
        (["tesnet", "--resume"], "--out"),
    ],
)
def test_networks_that_cannot_be_compared_are_refused(arguments: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        compared("--models", *arguments)


def test_a_running_service_brings_its_own_weights(tmp_path: Path) -> None:
    path = tmp_path / "gpd-0.safetensors"
    path.touch()
    with pytest.raises(UsageError, match="leave out --url"):
        compared("--models", f"gpd={path}", "--url", "http://robot:8000")
