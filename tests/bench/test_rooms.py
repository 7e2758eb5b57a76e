"""Rooms are those of their seed; what their truth says stands where it says in the depth image."""

from __future__ import annotations

import numpy as np
import pytest

from bench import rooms
from tesnet.geometry import Pose


@pytest.mark.parametrize("name", list(rooms.KINDS))
def test_the_truth_is_seen_in_the_image(name: str) -> None:
    rng = np.random.default_rng(3)
    room = rooms.KINDS[name](rng)
    frame = rooms.photograph(room, (160, 120), 0.0, rng)
    points = frame.intrinsics.back_project(frame.counts * rooms.DEPTH_SCALE)
    heights = points @ frame.truth.up - frame.truth.height
    assert (np.abs(heights) < 0.002).mean() > 0.05
    assert (((heights > 0.01) & (heights < 0.3)).mean() > 0.001) == (name != "empty")
    assert (heights < -0.1).any() == (name != "empty")
    np.testing.assert_allclose(frame.T_world_camera.apply(frame.truth.outline)[:, 2], room.height)


def test_a_frame_is_that_of_its_seed_and_its_noise_is_that_which_was_asked_for() -> None:
    def frame(noise: float, seed: int) -> rooms.RoomFrame:
        rng = np.random.default_rng(seed)
        return rooms.photograph(rooms.overhead(rng), (160, 120), noise, rng)

    still, noisy = frame(0.0, 1), frame(0.003, 1)
    np.testing.assert_array_equal(noisy.counts, frame(0.003, 1).counts)
    assert (noisy.counts == 0).mean() == pytest.approx(0.02, abs=0.005)
    seen = (noisy.counts > 0) & (still.counts > 0)
    depth = still.counts[seen] * rooms.DEPTH_SCALE
    off = (noisy.counts[seen] * rooms.DEPTH_SCALE - depth) / depth**2
    assert off.std() == pytest.approx(0.003, rel=0.05)
    assert not np.array_equal(frame(0.0, 2).counts, still.counts)


def test_frames_go_through_every_kind() -> None:
    named = list(rooms.frames(len(rooms.KINDS), 0, ((64, 48),)))
    assert [name.split("_")[1] for name, _ in named] == list(rooms.KINDS)
    assert all(isinstance(frame.T_world_camera, Pose) for _, frame in named)
