from __future__ import annotations

import torch

from tesnet.networks.balls import nearest_in_ball
from tesnet.networks.edgegrasp import EdgeGrasp, EdgeGraspConfig


def test_a_points_features_are_those_of_three_pointnet_layers_on_its_ball() -> None:
    """Each layer as published: the maximum over the neighbours of an MLP of their features and offsets."""
    torch.manual_seed(0)
    network = EdgeGrasp(EdgeGraspConfig(channels=(8, 12, 16), neighbours=5)).eval()
    points, normals = torch.randn(2, 30, 3), torch.nn.functional.normalize(torch.randn(2, 30, 3), dim=2)
    with torch.inference_mode():
        features = network.point_features(points, normals)
        assert features.shape == (2, 30, 36)
        table = nearest_in_ball(points, 5)
        flat, x, depths = points.flatten(0, 1), torch.cat([points, normals], dim=2).flatten(0, 1), []
        for layer in network.layers:
            rows = [
                torch.stack(
                    [layer.local_nn(layer.first(torch.cat([x[j], flat[j] - flat[i]]))) for j in table[i]]  # type: ignore[operator]
                ).amax(dim=0)
                for i in range(60)
            ]
            x = torch.relu(torch.stack(rows))
            depths.append(x)
        torch.testing.assert_close(features, torch.cat(depths, dim=1).view(2, 30, 36), atol=1e-5, rtol=0)
