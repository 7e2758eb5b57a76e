from __future__ import annotations

import numpy as np
import torch

from tesnet import networks
from tesnet.networks.balls import balls, nearest_in_ball
from tesnet.networks.tesnet_paper import TesNetPaper, centred_directions
from tests.tesnet.scenes import prepared, tabletop_query


def some_balls() -> torch.Tensor:
    """(4, 100, 3) points about four approach points, seen from these."""
    points = prepared(tabletop_query()).points
    centres = torch.arange(0, len(points), len(points) // 4)[:4]
    return points[balls(points, centres, 0.05, 100)] - points[centres][:, None]


def test_cosine_neighbours_are_those_at_the_smallest_angles_about_the_centroid() -> None:
    """Against all cosines in float64; angles that differ by rounding may change places."""
    points = some_balls()
    neighbours = nearest_in_ball(centred_directions(points), 16).view(4, 100, 16)
    for number, ball in enumerate(points.double().numpy()):
        unit = ball - ball.mean(axis=0)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        for row in range(0, 100, 7):
            distance = 1 - unit @ unit[row]
            chosen = neighbours[number, row].numpy() - 100 * number
            assert row in chosen
            assert len(set(chosen.tolist())) == 16
            assert distance[chosen].max() <= np.sort(distance)[15] + 1e-6


def test_cosine_neighbours_look_along_rays_and_not_across_the_surface() -> None:
    directions = torch.cat([torch.eye(3), -torch.eye(3)])
    points = torch.cat([0.01 * directions, 0.03 * directions])[None] + 0.2
    near, far = torch.arange(6), torch.arange(6, 12)
    found = nearest_in_ball(centred_directions(points), 2).sort(dim=1).values
    expected = torch.stack([near, far], dim=1).repeat(2, 1)
    assert torch.equal(found, expected)


def test_the_two_variants_differ_in_their_graph_alone() -> None:
    paper, euclidean = networks.build("tesnet-paper"), networks.build("tesnet-euclidean")
    assert isinstance(paper, TesNetPaper)
    assert isinstance(euclidean, TesNetPaper)
    euclidean.load_state_dict(paper.state_dict())
    points = some_balls() / 0.02
    with torch.inference_mode():
        normals = torch.randn(4, 100, 3, generator=torch.Generator().manual_seed(0))
        first, second = (network.point_features(points, normals) for network in (paper, euclidean))
    assert first.shape == (4, 100, 160)
    assert (first - second).abs().mean() > 1e-3
