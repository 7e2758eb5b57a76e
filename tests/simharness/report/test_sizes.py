"""What a run cleared, by size: things are as narrow as they are, and each is counted once."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simharness.__main__ import main
from simharness.errors import UsageError
from simharness.play.folder import RunFolder
from simharness.play.round import play_round
from simharness.report.sizes import narrowest, sizes, sizes_table
from simharness.sim.objects import load_object_set
from simharness.sim.shapes import wide
from tests.simharness.planners import TopDown
from tests.simharness.recorded import MODEL, SERVING


def test_a_box_is_as_wide_as_its_shortest_side_however_it_lies() -> None:
    corners = np.stack(np.meshgrid([0, 0.03], [0, 0.05], [0, 0.2]), axis=-1).reshape(-1, 3)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert narrowest(corners @ turn.T + 1.0) == pytest.approx(0.03)


def test_things_are_counted_by_size() -> None:
    lines = sizes_table([(0.0601, True), (0.0649, False), (0.0651, True), (0.07, True)], 2).splitlines()
    assert [line.split(" | ")[-1] for line in lines[2:]] == ["1 of 2 |", "2 of 2 |"]
    assert lines[2].startswith("| 60.0 to 65.0 | 50.0 [")


def test_a_run_tells_what_was_grasped_of_which_size(
    make_settings: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = make_settings(scene="pile", objects="novel", rounds=1)
    objects = load_object_set("novel", "pile")
    record = play_round(settings, objects, TopDown(), 0, 0)
    found = sizes(settings, objects, [record])
    assert len(found) == len(record.objects)
    assert sum(taken for _, taken in found) == sum(len(attempt.grasped) for attempt in record.attempts) > 0
    folder = RunFolder(tmp_path)
    folder.prepare(settings, resume=False)
    folder.start(settings, MODEL, SERVING)
    folder.append(record)
    assert main(["sizes", str(tmp_path), "--bins", "3"]) == 0
    assert sizes_table(found, 3) in capsys.readouterr().out


def test_sizes_are_those_of_the_scene(make_settings: Any) -> None:
    settings = make_settings(scene="pile", objects="wide", rounds=1)
    objects = load_object_set("wide", "pile")
    record = play_round(settings, objects, TopDown(), 0, 0)
    found = sizes(settings, objects, [record])
    assert all(wide.NARROWEST * 0.99 <= size <= wide.WIDEST * 1.01 for size, _ in found)


def test_objects_from_files_have_no_size_here(make_settings: Any) -> None:
    with pytest.raises(UsageError, match="wide"):
        sizes(make_settings(objects="val.txt"), (), [])


def test_a_run_without_rounds_has_no_sizes_yet(make_settings: Any) -> None:
    with pytest.raises(UsageError, match="--resume"):
        sizes(make_settings(objects="wide"), (), [])


def test_of_several_things_alike_as_many_count_as_were_grasped(make_settings: Any) -> None:
    settings = make_settings(scene="pile", objects="wide", rounds=1)
    alike = load_object_set("wide", "pile")[:1]
    record = play_round(settings, alike, TopDown(), 0, 0)
    assert len(set(record.objects)) == 1
    name = record.objects[0]
    once = replace(record, attempts=(replace(record.attempts[0], grasped=(name,)),))
    for number in range(len(record.objects) + 1):
        found = sizes(settings, alike, [replace(record, attempts=once.attempts * number)])
        assert sum(taken for _, taken in found) == number
