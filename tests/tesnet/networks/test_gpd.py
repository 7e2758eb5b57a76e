from __future__ import annotations

import functools
from dataclasses import asdict

import numpy as np
import torch

from tesnet import candidates
from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.networks import gpd
from tesnet.visibility import depth_behind
from tests.tesnet.scenes import prepared, tabletop_query


@functools.cache
def example() -> tuple[PreparedCloud, Candidates]:
    query = tabletop_query(max_candidates=30)
    ready = prepared(query, **asdict(gpd.GPD.preparation))
    return ready, candidates.generate(ready, query, candidates.CandidateConfig())[0]


def test_images_are_those_that_a_loop_over_points_and_places_paints() -> None:
    """Heights, normals and hidden places of each pixel, averaged one by one in float64; channels as published."""
    ready, found = example()
    sign = torch.where(torch.arange(len(found)) % 2 == 0, 1.0, -1.0)
    images = gpd.images(ready, found.Ts_canonical_grasp, sign).numpy()
    assert images.shape == (len(found), 15, 24, 24)
    low, size = gpd.REGION.low.numpy(), gpd.REGION.size.numpy()
    steps = (np.arange(12) + 0.5) / 12
    share_of_places = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    painted = 0
    for row in range(0, len(found), 4):
        T = found.Ts_canonical_grasp[row].double().numpy()
        mirror = np.array([float(sign[row]), 1, 1])
        share = ((ready.points.double().numpy() - T[:3, 3]) @ T[:3, :3] * mirror - low) / size
        normals = ready.normals.double().numpy() @ T[:3, :3] * mirror
        inside = ((share > 0) & (share < 1)).all(axis=1)
        places = ((low + share_of_places * size) * mirror) @ T[:3, :3].T + T[:3, 3]
        hidden = share_of_places[(depth_behind(ready, torch.tensor(places).float()) > 0.003).numpy()]
        for view, (along, down, right) in enumerate(((0, 1, 2), (1, 0, 2), (2, 0, 1))):
            expected = np.zeros((5, 24, 24))
            for pixel in np.ndindex(24, 24):
                there = inside & (np.floor(share[:, [down, right]] * 24) == pixel).all(axis=1)
                if there.any():
                    expected[:4, pixel[0], pixel[1]] = [share[there, along].mean(), *normals[there].mean(axis=0)]
                unseen = (np.floor(hidden[:, [down, right]] * 12) == np.array(pixel) // 2).all(axis=1)
                if unseen.any():
                    expected[4, pixel[0], pixel[1]] = hidden[unseen, along].mean()
            wrong = np.abs(images[row, 5 * view : 5 * view + 5] - expected).max(axis=0) > 1e-4
            painted += int((expected[0] > 0).sum())
            assert wrong.mean() < 0.01  # rounding moves a point to the next pixel, a place out of the shadow
    assert painted > 500


def test_what_is_not_there_leaves_a_blank_image() -> None:
    ready, found = example()
    away = found.Ts_canonical_grasp.clone()
    away[:, :3, 3] += 10
    assert not gpd.images(ready, away, torch.ones(len(found))).any()
