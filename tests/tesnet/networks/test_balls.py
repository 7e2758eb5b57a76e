from __future__ import annotations

import numpy as np
import torch

from tesnet.networks.balls import balls, nearest_in_ball
from tests.tesnet.scenes import prepared, tabletop_query


def test_a_ball_holds_points_within_its_radius_and_its_centre_first() -> None:
    points = prepared(tabletop_query()).points
    centres = torch.arange(0, len(points), 60)
    distance = np.linalg.norm(points.double().numpy()[:, None] - points[centres].double().numpy(), axis=2)
    for radius, count in ((0.05, 64), (0.006, 64)):
        members = balls(points, centres, radius, count)
        assert members.shape == (len(centres), count)
        for number, centre in enumerate(centres.tolist()):
            there = set(np.flatnonzero(distance[:, number] <= radius - 1e-6).tolist())
            chosen = members[number].tolist()
            assert chosen[0] == centre
            if len(there) > count:
                assert len(set(chosen)) == count
                assert max(distance[chosen, number]) <= radius + 1e-6
            else:
                assert there <= set(chosen)
                assert chosen[len(set(chosen)) :] == [centre] * (count - len(set(chosen)))
        assert any((distance[:, number] <= radius).sum() > count for number in range(len(centres))) == (radius > 0.01)


def test_neighbours_in_a_ball_are_the_nearest_of_that_ball() -> None:
    points = torch.randn(3, 20, 3, generator=torch.Generator().manual_seed(0))
    table = nearest_in_ball(points, 5).view(3, 20, 5)
    for number, ball in enumerate(points.double().numpy()):
        distance = np.linalg.norm(ball[:, None] - ball, axis=2)
        expected = np.argsort(distance, axis=1)[:, :5] + 20 * number
        np.testing.assert_array_equal(table[number], expected)


def test_a_ball_with_fewer_points_than_neighbours_has_them_all() -> None:
    table = nearest_in_ball(torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0)), 5)
    assert table.sort(dim=1).values.tolist() == [[0, 1, 2]] * 3 + [[3, 4, 5]] * 3
