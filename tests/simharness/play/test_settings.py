from __future__ import annotations

import json
import math
from typing import Any

import pytest

from simharness.play.settings import Interval, RunSettings, flags


def test_settings_come_back_from_json(make_settings: Any) -> None:
    settings = make_settings(seeds=(3, 1), noise_std=0.002, dex_noise=True)
    assert RunSettings.from_json(json.loads(json.dumps(settings.to_json()))) == settings


def test_settings_of_a_run_from_before_an_option_existed_are_without_it(make_settings: Any) -> None:
    values = make_settings().to_json()
    for name in ("dex_noise", "polar_deg", "voxel_size"):
        del values[name]
    assert RunSettings.from_json(values) == make_settings()


def test_settings_that_lack_one_or_have_one_too_many_are_refused(make_settings: Any) -> None:
    values = make_settings().to_json()
    with pytest.raises(TypeError, match="colour"):
        RunSettings.from_json({**values, "colour": "red"})
    del values["executor"]
    with pytest.raises(TypeError, match="executor"):
        RunSettings.from_json(values)


def test_noise_may_be_none_or_any_under_a_metre() -> None:
    asked = {name: flag.within for name, (_, flag) in flags().items() if flag.within is not None and "noise" in name}
    assert len(asked) == 2
    for within in asked.values():
        assert [value in within for value in (0, 0.0008, 0.9, 1)] == [True, True, True, False]


def test_an_interval_says_what_it_holds() -> None:
    open_, closed = Interval(0, 90, "degrees"), Interval(0, 1, "metres", from_low=True)
    assert str(open_) == "degrees, more than 0 and less than 90"
    assert str(closed) == "metres, 0 or more and less than 1"
    assert [value in open_ for value in (0, 89.9, 90)] == [False, True, False]
    assert [value in closed for value in (0, -0.1, 1, math.nan)] == [True, False, False, False]
