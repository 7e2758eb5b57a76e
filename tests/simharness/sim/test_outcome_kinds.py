from __future__ import annotations

import re
from pathlib import Path

from simharness.sim.outcome_kinds import FAILURE_KINDS, OUTCOME_KINDS, OUTCOMES

CONVENTIONS = Path(__file__).parents[3] / "CONVENTIONS.md"


def test_every_kind_has_words_of_its_own() -> None:
    assert tuple(OUTCOMES) == OUTCOME_KINDS
    assert len({words.meaning for words in OUTCOMES.values()}) == len(OUTCOMES)
    assert len({words.colour for words in OUTCOMES.values()}) == len(OUTCOMES)
    assert set(FAILURE_KINDS) == set(OUTCOME_KINDS) - {"success"}


def test_the_codes_in_the_shipped_labels_mean_what_they_meant() -> None:
    assert OUTCOME_KINDS[:5] == ("success", "pregrasp", "approach", "slip", "drop")


def test_the_conventions_say_the_same_in_the_same_order() -> None:
    entry = re.search(r"^- Outcomes: (.*?0 to (\d+).*?)$", CONVENTIONS.read_text(), re.MULTILINE | re.DOTALL)
    assert entry is not None
    told = re.findall(r"`(\w+)`\s+\((.+?)\)", entry[1].replace("\n ", ""))
    assert told == [(kind, words.meaning) for kind, words in OUTCOMES.items()]
    assert int(entry[2]) == len(OUTCOMES) - 1
