from __future__ import annotations

from dataclasses import asdict

import torch

from tesnet import candidates
from tesnet.networks.closing import members_of, seen_from_hand
from tesnet.networks.pointnetgpd import REGION, PointNetGPD, PointNetGPDConfig
from tests.tesnet.scenes import prepared, tabletop_query


def test_a_score_is_the_head_of_the_largest_features_of_the_points_in_the_region() -> None:
    """As the paper writes it, one candidate and one point at a time; repeated points change no maximum."""
    torch.manual_seed(0)
    network = PointNetGPD(PointNetGPDConfig(points=4000)).eval()  # more than any region holds
    query = tabletop_query(max_candidates=12)
    cloud = prepared(query, **asdict(network.preparation))
    found, _ = candidates.generate(cloud, query, candidates.CandidateConfig())
    with torch.inference_mode():
        logits = network.score(None, cloud, found)
        for row in range(len(found)):
            pose = found.Ts_canonical_grasp[row : row + 1]
            members = members_of(cloud.points, pose, REGION)
            positions, _ = seen_from_hand(cloud, pose, None, members.row, members.point)
            features = torch.stack([network.point(position / 0.02) for position in positions])
            torch.testing.assert_close(logits[row], network.head(features.amax(dim=0))[0], atol=1e-5, rtol=0)


def test_an_empty_region_has_the_score_of_no_features() -> None:
    network = PointNetGPD(PointNetGPDConfig()).eval()
    query = tabletop_query(max_candidates=3)
    cloud = prepared(query)
    found, _ = candidates.generate(cloud, query, candidates.CandidateConfig())
    found.Ts_canonical_grasp[:, :3, 3] += 10
    with torch.inference_mode():
        expected = network.head(torch.zeros(1, 192))[0, 0]
        torch.testing.assert_close(network.score(None, cloud, found), expected.expand(len(found)))
