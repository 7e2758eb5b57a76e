from __future__ import annotations

import numpy as np
import pytest

from tesnet.geometry import Box


@pytest.mark.parametrize(
    ("maximum", "says"),
    [
        ([1.0, 0.0, 1.0], r"min \[0.0, 0.0, 0.0\] is not below max \[1.0, 0.0, 1.0\] on every axis"),
        ([1.0, np.nan, 1.0], "maximum holds a value that is not finite"),
        ([1.0, 1.0], r"maximum has shape \(2,\); expected \(3,\)"),
    ],
)
def test_a_box_must_have_a_volume(maximum: list[float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Box(np.zeros(3), np.array(maximum))


def test_a_box_keeps_its_corners_to_itself() -> None:
    corner = np.ones(3)
    box = Box(np.zeros(3), corner)
    corner[0] = -1.0
    assert box.maximum.tolist() == [1, 1, 1]
    assert not box.maximum.flags.writeable
