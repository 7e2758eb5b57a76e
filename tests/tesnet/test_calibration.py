"""`calibrate`: scaled and tilted views come back to where they were, and only where a support tells of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tesnet import calibration
from tesnet.calibration import MOST_SCALE, MOST_TILT_DEG, Correction, calibrated, correction
from tesnet.geometry import Pose
from tesnet.query import GraspQuery
from tests.tesnet.scenes import CAMERA, UP, ask, fresh_predictor, tabletop
from tests.tesnet.test_support import table

Array = NDArray[np.float64]

OTHER_CAMERA = np.array([-0.4, 0.3, 0.55])


def scene(seed: int, noise: float = 0.0) -> Array:
    """Things on a table at height 0."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([tabletop(seed), table(0.25, count=12_000)])
    return points + rng.normal(0, noise, points.shape)


def tilted(axis: Array, degrees: float) -> Array:
    """Rotation about an axis across `UP`."""
    half = np.deg2rad(degrees) / 2
    return Pose.from_quaternion([*np.sin(half) * axis / np.linalg.norm(axis), np.cos(half)], np.zeros(3)).rotation


def seen_wrongly(points: Array, viewpoint: Array, scale: float, turn: Array) -> Array:
    """What a view shows whose depth is `scale` times too large and that is turned."""
    return viewpoint + scale * (points - viewpoint) @ turn.T


def calibrating(points: Array, **options: Any) -> GraspQuery:
    given = {"viewpoints": CAMERA, "up": UP, "support_height": 0.0, "calibrate": True, **options}
    return ask(points, **given)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 3),
    st.floats(-0.07, 0.07),
    st.floats(0, 3.5),
    st.floats(0, 2 * np.pi),
    st.sampled_from([0.0, 0.001, 0.004]),
)
def test_a_scaled_and_tilted_view_comes_back_within_its_noise(
    seed: int, scale: float, degrees: float, towards: float, noise: float
) -> None:
    """Unless it is nearly as wrong as a view may be: then 4 mm of noise hide a part of the plane from the first fit."""
    right = scene(seed)
    turn = tilted(np.array([np.cos(towards), np.sin(towards), 0.0]), degrees)
    shown = seen_wrongly(right, CAMERA, 1 + scale, turn)
    shown += np.random.default_rng(seed).normal(0, noise, shown.shape)
    answer, notes = calibrated(calibrating(shown))
    # Noise and the feet of things move the plane; the far side of the scene moves most.
    off = np.abs(answer.points - (right + (shown - seen_wrongly(right, CAMERA, 1 + scale, turn))))
    assert np.median(off) < 0.0005 + 0.15 * noise
    assert off.max() < 0.002 + 0.6 * noise
    assert len(notes) == 1
    assert "depth is multiplied" in notes[0]


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.004])
def test_calibrating_again_changes_nothing(noise: float) -> None:
    shown = seen_wrongly(scene(1, noise), CAMERA, 1.03, tilted(np.array([1.0, 2.0, 0.0]), 1.5))
    once, _ = calibrated(calibrating(shown))
    twice, _ = calibrated(once)
    assert np.abs(twice.points - once.points).max() < 0.0002


def test_nothing_changes_unless_it_is_asked_for() -> None:
    query = calibrating(seen_wrongly(scene(0), CAMERA, 1.03, np.eye(3)), calibrate=False)
    assert calibrated(query) == (query, [])


def test_the_frame_makes_no_difference() -> None:
    motion = Pose.random(np.random.default_rng(5), reach=0.5)
    shown = seen_wrongly(scene(2), CAMERA, 0.97, tilted(np.array([1.0, 0.0, 0.0]), 1.0))
    here, _ = calibrated(calibrating(shown))
    up = motion.rotate(UP)
    there, _ = calibrated(
        calibrating(
            motion.apply(shown),
            viewpoints=motion.apply(CAMERA),
            up=up,
            support_height=float(motion.translation @ up),
        )
    )
    np.testing.assert_allclose(there.points, motion.apply(here.points.astype(np.float64)), atol=2e-5)


def test_each_view_has_a_scale_of_its_own_and_a_view_without_support_stays() -> None:
    right, wrong = scene(0), [(CAMERA, 1.04), (OTHER_CAMERA, 0.96)]
    shown = [seen_wrongly(right, viewpoint, scale, np.eye(3)) for viewpoint, scale in wrong]
    things = tabletop(0)
    answer, notes = calibrated(
        calibrating(
            np.concatenate([*shown, things]),
            viewpoints=np.stack([CAMERA, OTHER_CAMERA, CAMERA]),
            view_index=np.repeat([0, 1, 2], [len(right), len(right), len(things)]),
        )
    )
    np.testing.assert_allclose(answer.points[: 2 * len(right)], np.concatenate([right, right]), atol=2e-3)
    np.testing.assert_array_equal(answer.points[2 * len(right) :], things.astype(np.float32))
    assert [note.partition(":")[0] for note in notes] == [f"calibrate, view {view}" for view in range(3)]
    assert "depth is multiplied by 0.96" in notes[0]
    assert "depth is multiplied by 1.04" in notes[1]
    assert "nothing was corrected" in notes[2]


def test_normals_turn_with_their_points() -> None:
    turn = tilted(np.array([0.0, 1.0, 0.0]), 3.0)
    shown = seen_wrongly(scene(0), CAMERA, 1.0, turn)
    answer, _ = calibrated(calibrating(shown, normals=np.tile(turn @ UP, (len(shown), 1))))
    assert answer.normals is not None
    np.testing.assert_allclose(answer.normals, np.tile(UP, (len(shown), 1)), atol=2e-3)


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        ({"support_height": None}, "support_height"),
        ({"support_height": "auto"}, "support_height"),
        ({"up": None, "support_height": None}, "up"),
        ({"viewpoints": None}, "viewpoint"),
        ({"viewpoints": np.stack([CAMERA, OTHER_CAMERA])}, "view_index"),
        ({"support_height": 1.0}, "below the support"),
    ],
)
def test_what_is_missing_is_named_and_nothing_is_corrected(options: dict[str, Any], remedy: str) -> None:
    query = calibrating(seen_wrongly(scene(0), CAMERA, 1.03, np.eye(3)), **options)
    answer, notes = calibrated(query)
    np.testing.assert_array_equal(answer.points, query.points)
    assert len(notes) == 1
    assert remedy in notes[0]
    assert "nothing was corrected" in notes[0]


@pytest.mark.parametrize("seed", range(4))
def test_things_alone_are_no_support(seed: int) -> None:
    for noise in (0.0, 0.002, 0.004):
        points = tabletop(seed) + np.random.default_rng(seed).normal(0, noise, tabletop(seed).shape)
        points = points[points[:, 2] > 0.0055]
        assert "nothing was corrected" in calibrated(calibrating(points))[1][0]


@pytest.mark.parametrize(("scale", "degrees"), [(1.2, 0.0), (0.85, 0.0), (1.0, 6.0), (1.0, 9.0)])
def test_an_implausible_correction_is_refused_with_its_limits(scale: float, degrees: float) -> None:
    shown = seen_wrongly(scene(0), CAMERA, scale, tilted(np.array([1.0, 0.0, 0.0]), degrees))
    found = correction(shown, CAMERA, UP, 0.0)
    assert isinstance(found, str)
    assert f"{MOST_TILT_DEG:g} degrees" in found
    nothing_near = "no support is seen" in found
    assert nothing_near or f"(limits {1 - MOST_SCALE:g} to {1 + MOST_SCALE:g}, {MOST_TILT_DEG:g} degrees)" in found
    assert nothing_near == (degrees > 2 * MOST_TILT_DEG - 2)
    assert degrees or f"multiplied by {1 / scale:.3f}"[:-1] in found


def test_limits_are_those_that_are_told() -> None:
    def plausible(scale: float, degrees: float) -> bool:
        return Correction(CAMERA, scale, tilted(np.array([1.0, 0.0, 0.0]), degrees), 0.001).plausible

    assert plausible(1 + 0.99 * MOST_SCALE, 0.99 * MOST_TILT_DEG)
    assert not plausible(1 + 1.01 * MOST_SCALE, 0)
    assert not plausible(1 - 1.01 * MOST_SCALE, 0)
    assert not plausible(1, 1.01 * MOST_TILT_DEG)


def test_of_table_and_floor_the_table_at_the_known_height_counts() -> None:
    floor = table(1.2, height=-0.7, count=60_000)
    points = np.concatenate([seen_wrongly(np.concatenate([scene(0), floor]), CAMERA, 1.02, np.eye(3))])
    answer, notes = calibrated(calibrating(points))
    assert "multiplied by 0.98" in notes[0]
    assert abs(np.median(answer.points[-60_000:, 2]) + 0.7) < 0.002


def test_the_predictor_answers_for_the_corrected_cloud_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = fresh_predictor()
    shown = calibrating(seen_wrongly(scene(0), CAMERA, 1.04, np.eye(3)), max_candidates=200)
    corrected, notes = calibrated(shown)
    answer = predictor.predict(shown)
    monkeypatch.setattr(calibration, "calibrated", lambda query: (query, []))
    expected = predictor.predict(corrected)
    np.testing.assert_array_equal(answer.grasps.Ts_cloud_grasp, expected.grasps.Ts_cloud_grasp)
    assert notes[0] in answer.warnings


@pytest.mark.parametrize("scale", [0.92, 1.0, 1.09])
def test_the_noise_that_is_told_is_that_of_the_corrected_points(scale: float) -> None:
    plane = table(0.25, count=12_000)
    wrong = seen_wrongly(
        plane + np.random.default_rng(0).normal(0, [[0, 0, 0.002]], plane.shape), CAMERA, scale, np.eye(3)
    )
    found = correction(wrong, CAMERA, UP, 0.0)
    assert isinstance(found, Correction)
    heights = found.apply(wrong)[:, 2]
    spread = 1.4826 * float(np.median(np.abs(heights - np.median(heights))))
    assert spread == pytest.approx(0.002, rel=0.1)
    assert found.noise_sd == pytest.approx(spread, rel=0.03)
