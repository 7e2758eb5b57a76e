from __future__ import annotations

import dataclasses

import numpy as np

from tesnet import candidates
from tesnet.networks.pairs import pair_features
from tests.tesnet.scenes import prepared, tabletop_query


def test_pair_features_are_the_distance_and_three_cosines() -> None:
    query = tabletop_query(max_candidates=60)
    cloud = prepared(query)
    found, _ = candidates.generate(cloud, query, candidates.CandidateConfig())
    features = pair_features(cloud, found)
    for row in range(0, len(found), 9):
        a, c = int(found.approach[row]), int(found.contact[row])
        p, q, n, m = (x.double().numpy() for x in (*cloud.points[[a, c]], *cloud.normals[[a, c]]))
        length = np.linalg.norm(q - p)
        expected = [length / 0.02, n @ (q - p) / length, m @ (q - p) / length, n @ m]
        np.testing.assert_allclose(features[row], expected, atol=1e-5)


def test_a_pair_of_one_point_has_finite_features() -> None:
    cloud = prepared(tabletop_query())
    query = tabletop_query(max_candidates=5)
    found, _ = candidates.generate(cloud, query, candidates.CandidateConfig())
    same = dataclasses.replace(found, contact=found.approach)
    np.testing.assert_allclose(pair_features(cloud, same)[:, :3], 0, atol=1e-6)
