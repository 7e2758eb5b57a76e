from __future__ import annotations

from pathlib import Path
from typing import Any

from simharness.play.photographer import FAILURES, FIRST_ROUNDS, attempts_to_show, keep_only, picture_name


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


def test_a_first_attempt_that_failed_is_shown_once(make_round: Any) -> None:
    shown = attempts_to_show([make_round(0, number, ["slip", "slip"]) for number in range(FIRST_ROUNDS)], 0)
    places = [(attempt.round, attempt.attempt) for attempt in shown]
    assert len(set(places)) == len(places) == FIRST_ROUNDS + min(FAILURES, FIRST_ROUNDS)
