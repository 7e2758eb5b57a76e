from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tesnet.clearance import LEAST_REACH, NEAREST, WANTED_REACH, stopping_short

WANTED, FARTHEST = 0.004, 0.007
TOLERANCE = 2e-5

metres = st.floats(-0.02, 0.02)


def stop(
    clearance: float, reach: float, error: float = 0.0, down: float = 1.0, farthest: float = FARTHEST
) -> tuple[float, bool]:
    back, too_near = stopping_short(
        *(torch.tensor([value], dtype=torch.float64) for value in (down, clearance, reach)),
        wanted=WANTED,
        error=error,
        farthest=torch.tensor([farthest], dtype=torch.float64),
    )
    return float(back), bool(too_near)


def stop_by_trying(clearance: float, reach: float, error: float, down: float) -> float | None:
    """The least of the best of all ways to stop, a hundredth of a millimetre apart."""
    back = np.linspace(0, FARTHEST, 701)
    have, left = clearance + back * down, reach - back
    allowed = (have >= min(WANTED, NEAREST + error)) & (left >= LEAST_REACH)
    clear = allowed & (have >= WANTED) & (left >= WANTED_REACH)
    if clear.any():
        return float(back[clear].min())
    if not allowed.any():
        return None
    below = allowed & (left >= WANTED_REACH)  # as clear as may be while the tips reach far enough
    return float(back[below].max() if below.any() else back[allowed].min())


@given(clearance=metres, reach=st.floats(0.0, 0.02), error=st.floats(0.0, 0.004), down=st.floats(0.6, 1.0))
@settings(max_examples=300, deadline=None)
def test_the_way_back_is_the_best_of_all_that_are_tried(
    clearance: float, reach: float, error: float, down: float
) -> None:
    if clearance >= WANTED:
        assert stop(clearance, reach, error, down) == (0.0, False)
        return
    best = stop_by_trying(clearance, reach, error, down)
    back, too_near = stop(clearance, reach, error, down)
    if too_near:
        assert best is None or back == 0.0
        # At the very limits rounding decides.
        assert best is None or stop_by_trying(clearance - 1e-4, reach - 1e-4, error, down) is None or best > 0.0069
    else:
        assert best is not None
        assert abs(back - best) < 5e-5


@given(clearance=metres, reach=st.floats(0.0, 0.02), error=st.floats(0.0, 0.004), down=st.floats(0.0, 1.0))
@settings(max_examples=300, deadline=None)
def test_tips_stay_over_the_plane_and_past_the_face(clearance: float, reach: float, error: float, down: float) -> None:
    back, too_near = stop(clearance, reach, error, down)
    assert 0 <= back <= FARTHEST
    if not too_near:
        assert clearance + back * down >= min(WANTED, NEAREST + error) - TOLERANCE
        assert back == 0 or reach - back >= LEAST_REACH - TOLERANCE


def test_a_thing_of_six_millimetres_is_taken_over_a_plane_that_is_known_alone() -> None:
    back, too_near = stop(clearance=-0.003, reach=0.009)
    assert not too_near
    assert abs(-0.003 + back - NEAREST) < TOLERANCE
    assert stop(clearance=-0.003, reach=0.009, error=0.003) == (0.0, True)


def test_hands_that_travel_level_do_not_get_clear() -> None:
    assert stop(clearance=0.003, reach=0.01, down=0.1) == (0.0, True)


def test_no_hand_stops_farther_short_than_it_may() -> None:
    assert stop(clearance=-0.004, reach=0.03) == (0.0, True)
    assert not stop(clearance=-0.004, reach=0.03, farthest=0.01)[1]
