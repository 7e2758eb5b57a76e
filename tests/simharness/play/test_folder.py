from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from simharness.errors import UsageError
from simharness.play import folder as folder_module
from simharness.play.folder import RunFolder
from simharness.play.records import RoundRecord, Run
from tests.simharness.recorded import MODEL, SERVING


def same(left: list[RoundRecord], right: list[RoundRecord]) -> bool:
    def plain(record: RoundRecord) -> Any:
        return record.to_json(), [attempt.to_json() for attempt in record.attempts]

    return [plain(record) for record in left] == [plain(record) for record in right]


def test_rounds_come_back_as_they_were_written(tmp_path: Path, make_settings: Any, run: Run) -> None:
    folder = RunFolder(tmp_path / "a" / "b")
    assert folder.prepare(make_settings(), resume=False) == []
    folder.start(make_settings(), MODEL, SERVING)
    for record in reversed(run.rounds):
        folder.append(record)
    assert same(folder.prepare(make_settings(), resume=True), list(run.rounds))
    lines = [json.loads(line) for line in (folder.path / "attempts.jsonl").read_text().splitlines()]
    keys = [(line["seed"], line["round"], line["attempt"]) for line in lines]
    assert keys == sorted(keys)
    assert folder.read_run() == (make_settings(), MODEL, SERVING)


def test_what_is_no_json_is_refused_and_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.write_json("a.json", {"rate": 0.5})
    with pytest.raises(ValueError, match="JSON"):
        folder.write_json("a.json", {"rate": float("nan")})
    assert json.loads((tmp_path / "a.json").read_text()) == {"rate": 0.5}


def test_a_round_that_a_crash_cut_short_is_played_again(tmp_path: Path, make_settings: Any, run: Run) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.start(make_settings(), MODEL, SERVING)
    for record in run.rounds[:3]:
        folder.append(record)
    attempts, rounds = tmp_path / "attempts.jsonl", tmp_path / "rounds.jsonl"
    # The third round's own line never came; of the second, an attempt was lost; and the file ends within a line.
    rounds.write_text("".join(rounds.read_text().splitlines(keepends=True)[:2]))
    lines = attempts.read_text().splitlines(keepends=True)
    attempts.write_text("".join(lines[:6] + lines[7:-1]) + lines[-1][:40])
    assert same(folder.prepare(make_settings(), resume=True), list(run.rounds[:1]))
    assert len(attempts.read_text().splitlines()) == 5


def test_a_round_is_told_of_once_all_its_attempts_are_written(tmp_path: Path, make_settings: Any, run: Run) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.append(run.rounds[0])
    (tmp_path / "attempts.jsonl").rename(tmp_path / "aside")
    (tmp_path / "attempts.jsonl").mkdir()  # where nothing can be written
    with pytest.raises(OSError, match=r"attempts\.jsonl"):
        folder.append(run.rounds[1])
    (tmp_path / "attempts.jsonl").rmdir()
    (tmp_path / "aside").rename(tmp_path / "attempts.jsonl")
    assert len((tmp_path / "rounds.jsonl").read_text().splitlines()) == 1
    assert same(folder.read_rounds(), [run.rounds[0]])


def test_resuming_refuses_other_settings_by_name(tmp_path: Path, make_settings: Any) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.start(make_settings(), MODEL, SERVING)
    with pytest.raises(UsageError, match=r"executor was 'edge', now 'strict'"):
        folder.prepare(make_settings(executor="strict"), resume=True)
    with pytest.raises(UsageError, match="rounds was 2, now 3"):
        folder.prepare(make_settings(rounds=3), resume=True)


def test_resuming_refuses_other_weights(tmp_path: Path, make_settings: Any) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.start(make_settings(), MODEL, SERVING)
    with pytest.raises(UsageError, match="weights_sha256"):
        folder.start(make_settings(), dataclasses.replace(MODEL, weights_sha256="cd" * 32), SERVING)


def test_resuming_refuses_another_version_of_the_harness(tmp_path: Path, make_settings: Any) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.start(make_settings(), MODEL, SERVING)
    folder.start(make_settings(), MODEL, SERVING)
    content = json.loads((tmp_path / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(content | {"version": "0.0.1"}))
    with pytest.raises(UsageError, match=r"version 0\.0\.1 played its rounds"):
        folder.start(make_settings(), MODEL, SERVING)
    del content["version"]  # as older versions wrote it
    (tmp_path / "run.json").write_text(json.dumps(content))
    folder.start(make_settings(), MODEL, SERVING)


def test_a_run_is_complete_with_its_last_round(tmp_path: Path, make_settings: Any, run: Run) -> None:
    folder, settings = RunFolder(tmp_path), make_settings(rounds=len(run.rounds))
    folder.prepare(settings, resume=False)
    assert not folder.is_complete(settings)
    folder.start(settings, MODEL, SERVING)
    for record in run.rounds:
        assert not folder.is_complete(settings)
        folder.append(record)
    assert folder.is_complete(settings)
    assert not folder.is_complete(make_settings(rounds=len(run.rounds) + 1))


def test_an_earlier_run_is_kept_beside_a_new_one(tmp_path: Path, make_settings: Any, run: Run) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    folder.start(make_settings(), MODEL, SERVING)
    folder.append(run.rounds[0])
    assert folder.prepare(make_settings(rounds=9), resume=False) == []
    assert not (tmp_path / "rounds.jsonl").exists()
    assert same(RunFolder(tmp_path / "earlier-1").read_rounds(), [run.rounds[0]])


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, make_settings: Any) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(UsageError, match="--out"):
        RunFolder(blocker / "out").prepare(make_settings(), resume=False)


def test_a_folder_without_a_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no run"):
        RunFolder(tmp_path).read_run()
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(UsageError, match="cannot be read"):
        RunFolder(tmp_path).read_run()
    with pytest.raises(UsageError, match="holds no run"):
        RunFolder(tmp_path / "run.json").read_run()


def test_files_are_rewritten_in_the_order_of_seeds_rounds_and_attempts(tmp_path: Path, run: Run) -> None:
    folder = RunFolder(tmp_path)
    folder.rewrite(reversed(run.rounds))
    for name in ("rounds.jsonl", "attempts.jsonl"):
        lines = [json.loads(line) for line in (tmp_path / name).read_text().splitlines()]
        keys = [(line["seed"], line["round"], line["attempt"] if name == "attempts.jsonl" else 0) for line in lines]
        assert keys == sorted(keys)
    assert same(folder.read_rounds(), list(run.rounds))


def test_nothing_of_an_earlier_run_is_left_among_the_files_of_a_new_one(tmp_path: Path, make_settings: Any) -> None:
    folder = RunFolder(tmp_path)
    folder.prepare(make_settings(), resume=False)
    names = {value for name, value in vars(folder_module).items() if name.endswith(("_FILE", "_LOG"))}
    assert len(names) == 7
    for name in names:
        (tmp_path / name).write_text("{}\n")
    (folder.pictures / "one.png").write_bytes(b"png")
    folder.prepare(make_settings(), resume=False)
    aside = tmp_path / "earlier-1"
    assert {path.name for path in tmp_path.iterdir()} == {"earlier-1", folder.pictures.name}
    assert {path.name for path in aside.iterdir()} == names | {folder.pictures.name}
    assert (aside / folder.pictures.name / "one.png").exists()
    assert not list(folder.pictures.iterdir())
