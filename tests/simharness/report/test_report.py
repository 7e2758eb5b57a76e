from __future__ import annotations

import dataclasses
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from simharness.errors import UsageError
from simharness.play.folder import RunFolder
from simharness.play.photographer import FAILURES, FIRST_ROUNDS, VIEWS, attempts_to_show, keep_only, picture_name
from simharness.play.pictures import (
    PICTURE_SIZE,
    close_up,
    cloud_picture,
    hand_lines,
    png,
    segmentation_colours,
    widen,
)
from simharness.play.records import ModelRecord, RoundRecord, Run, Serving
from simharness.report.page import page
from simharness.report.report import package_versions, report, table
from tesnet.geometry import PANDA, Pose

MODEL = ModelRecord("tesnet", "1.2", "ab" * 32)
SERVING = Serving(None, 1, "cpu")


@pytest.fixture
def run(make_settings: Any, make_round: Any) -> Run:
    rounds = (
        make_round(0, 0, ["success"] * 5),
        make_round(0, 1, ["slip", "drop"], ("no_candidates",), "two_failures"),
        make_round(1, 0, ["success", "approach", "success"]),
        make_round(1, 1, [], ("no_candidates",) * 3, "no_grasps"),
    )
    return Run(make_settings(seeds=(0, 1)), 2, MODEL, SERVING, rounds, None)


def test_the_report_has_rates_counts_settings_and_model(run: Run) -> None:
    content = report(run, {"python": "3.11"})
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["complete"] is True
    assert (content["successes"], content["attempts"]) == (7, 10)
    assert (content["objects_grasped"], content["objects_total"]) == (7, 20)
    assert content["gsr"] == 0.7
    assert content["dr"] == 0.35
    assert content["gsr_interval"][0] < 0.7 < content["gsr_interval"][1]
    assert content["failures"] == {"pregrasp": 0, "approach": 1, "slip": 1, "drop": 1}
    assert content["no_grasps"] == {"no_candidates": 4}
    assert content["rounds_ended"] == {"empty": 2, "two_failures": 1, "no_grasps": 1}
    assert content["latencies"]["service_total_ms"]["median"] == 11.0
    assert content["model"] == {"name": "tesnet", "version": "1.2", "weights_sha256": "ab" * 32}
    assert content["versions"] == {"python": "3.11"}
    settings = content["settings"]
    assert {name: settings[name] for name in run.settings.to_json()} == run.settings.to_json()
    assert (settings["workers"], settings["url"], settings["service_threads"], settings["device"]) == (
        2,
        None,
        1,
        "cpu",
    )


def test_seeds_are_pooled_and_told_apart(run: Run) -> None:
    content = report(run, {})
    assert [content["by_seed"][seed]["gsr"] for seed in ("0", "1")] == [5 / 7, 2 / 3]
    assert "GSR seed 1" in table(run)


def test_a_run_without_attempts_has_no_rate(make_settings: Any) -> None:
    broken = Run(make_settings(), 1, None, None, (), "the service ended with code 1")
    content = report(broken, {})
    assert content["gsr"] is None
    assert content["complete"] is False
    assert content["stopped_by"] == "the service ended with code 1"
    assert "INCOMPLETE: the service ended with code 1" in table(broken)


def test_the_table_says_rates_intervals_and_failures(run: Run) -> None:
    text = table(run)
    assert "70.0 %" in text
    assert "7 of 10 attempts" in text
    assert "7 of 20 objects" in text
    assert "approach 1, slip 1, drop 1" in text
    assert "no candidates 4" in text


def test_the_versions_of_what_decides_results_are_named() -> None:
    assert {"python", "numpy", "pybullet"} <= set(package_versions())


class Page(HTMLParser):
    """Checks that tags are closed in order, and gathers what a browser would load."""

    VOID = frozenset({"meta", "img", "br", "link", "rect", "line", "circle"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read_page(run: Run, pictures: Path) -> Page:
    shown = attempts_to_show(run.rounds, run.settings.seeds[0])
    parsed = Page()
    parsed.feed(page(run, report(run, {}), shown, pictures))
    parsed.close()
    assert not parsed.open
    return parsed


def test_the_page_needs_no_other_file_and_no_network(run: Run, tmp_path: Path) -> None:
    for attempt in attempts_to_show(run.rounds, 0):
        for view in VIEWS:
            (tmp_path / picture_name(attempt, view)).write_bytes(png(np.zeros((48, 64, 3), np.uint8)))
    parsed = read_page(run, tmp_path)
    assert len(parsed.loaded) == 3 * len(attempts_to_show(run.rounds, 0))
    assert all(source.startswith("data:image/png;base64,") for source in parsed.loaded)
    assert not re.search(r"url\(|@import", "".join(parsed.text))


def test_the_page_shows_rates_and_outcomes(run: Run, tmp_path: Path) -> None:
    text = " ".join(read_page(run, tmp_path).text)
    for word in ("70.0 %", "35.0 %", "7 of 10", "approach", "By seed", "ab" * 32):
        assert word in text
    assert "Incomplete" not in text


def test_the_page_of_a_broken_run_says_so(run: Run, tmp_path: Path) -> None:
    broken = dataclasses.replace(run, rounds=run.rounds[:1], stopped_by="the service <died>")
    text = " ".join(read_page(broken, tmp_path).text)
    assert "Incomplete: 1 of 4 rounds" in text
    assert "the service <died>" in text


def test_names_are_escaped_on_the_page(run: Run, tmp_path: Path) -> None:
    odd = dataclasses.replace(run, settings=dataclasses.replace(run.settings, objects="<script>alert(1)</script>"))
    assert "<script>" not in page(odd, report(odd, {}), [], tmp_path)


def test_first_attempts_and_the_earliest_failures_are_shown(make_round: Any) -> None:
    rounds = [make_round(0, number, ["success", "slip"]) for number in range(20)]
    shown = attempts_to_show(reversed(rounds), 0)
    assert [(attempt.round, attempt.attempt) for attempt in shown] == [
        *((number, 0) for number in range(FIRST_ROUNDS)),
        *((number, 1) for number in range(FAILURES)),
    ]
    assert attempts_to_show(rounds, 1) == []


def test_pictures_that_are_not_shown_are_removed(make_round: Any, tmp_path: Path) -> None:
    kept, dropped = make_round(0, 0, ["success", "slip"]).attempts
    for attempt in (kept, dropped):
        (tmp_path / picture_name(attempt, "cloud")).write_bytes(b"")
    keep_only(tmp_path, [kept])
    assert [path.name for path in tmp_path.iterdir()] == [picture_name(kept, "cloud")]


# The folder


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


# Pictures


def test_the_drawn_hand_is_as_wide_as_the_grasp_and_ends_at_the_fingertips() -> None:
    T_world_grasp = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3])  # top-down: half a turn about x
    lines = hand_lines(T_world_grasp.matrix, 0.06)
    tips = lines[:2, 1]
    assert np.linalg.norm(tips[0] - tips[1]) == pytest.approx(0.06)
    np.testing.assert_allclose(tips[:, 2], 0.3 - PANDA.tip_offset)


def test_objects_keep_their_colour_when_others_go() -> None:
    bodies = np.array([[-1, 0, 3, 5]], dtype=np.int32)
    before, after = segmentation_colours(bodies, [3, 5]), segmentation_colours(bodies, [5])
    np.testing.assert_array_equal(before[0, 3], after[0, 3])
    assert len({tuple(pixel) for pixel in before[0].tolist()}) == 4


def test_the_cloud_picture_shows_points_and_hand() -> None:
    points = np.array([[0.15, 0.15, 0.08]], dtype=np.float32)
    grey = np.full((1, 3), 100, dtype=np.uint8)
    pose = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.15, 0.15, 0.15]).matrix
    picture = np.asarray(cloud_picture(points, grey, pose, 0.08, (220, 38, 38), np.array([0.15, -0.4, 0.5])))
    assert (picture == (220, 38, 38)).all(axis=2).any()
    assert (picture == (100, 100, 100)).all(axis=2).any()


def test_an_empty_cloud_gives_a_picture_too() -> None:
    nothing = np.empty((0, 3))
    picture = cloud_picture(
        nothing.astype(np.float32), nothing.astype(np.uint8), np.eye(4), 0.08, (1, 2, 3), np.array([0.5, 0.5, 0.6])
    )
    assert Image.open(io.BytesIO(png(picture))).size == PICTURE_SIZE


@pytest.mark.parametrize("corner", [(0, 0), (200, 300), (470, 630)])
def test_a_close_up_holds_the_objects(corner: tuple[int, int]) -> None:
    bodies = np.full((480, 640), -1, dtype=np.int32)
    bodies[corner[0] : corner[0] + 10, corner[1] : corner[1] + 10] = 4
    part = bodies[close_up(bodies, [4, 5])]
    assert part.shape == (120, 160)
    assert (part == 4).sum() == (bodies == 4).sum()


def test_a_close_up_grows_with_the_objects_up_to_the_image() -> None:
    bodies = np.zeros((480, 640), dtype=np.int32)
    bodies[100:300, 200:300] = 4
    rows, columns = close_up(bodies, [4])
    assert rows.start < 100
    assert rows.stop > 300
    assert (columns.stop - columns.start) * 3 == pytest.approx((rows.stop - rows.start) * 4, abs=4)
    bodies[:] = 4
    assert bodies[close_up(bodies, [4])].shape == bodies.shape
    assert bodies[close_up(bodies, [])].shape == bodies.shape


def test_points_beside_an_object_get_its_colour() -> None:
    image = np.zeros((3, 4, 3), np.uint8)
    image[1, 1] = 200
    known = np.zeros((3, 4), dtype=bool)
    assert (widen(image, known) == image).all()
    known[1, 1] = True
    assert (widen(image, known) == 200).all()


def test_what_points_hide_of_the_hand_is_pale() -> None:
    # A wall before the hand, seen from the side of negative y.
    x, z = np.meshgrid(np.linspace(-0.1, 0.4, 400), np.linspace(0.05, 0.3, 200))
    wall = np.stack([x.ravel(), np.full(x.size, 0.15), z.ravel()], axis=1).astype(np.float32)
    grey = np.full((len(wall), 3), 100, dtype=np.uint8)
    pose = Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [0.15, 0.2, 0.08]).matrix
    picture = np.asarray(cloud_picture(wall, grey, pose, 0.08, (220, 38, 38), np.array([0.15, -0.4, 0.3])))
    assert not (picture == (220, 38, 38)).all(axis=2).any()
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    assert ((red > green + 20) & (green == blue)).any()
