from __future__ import annotations

import numpy as np
import pytest

from simharness.sim.protocol import query_about
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT
from tesnet.query import GraspQuery
from tests.simharness.play.test_planner import observation


@pytest.mark.parametrize("views", [1, 3])
def test_the_query_tells_the_protocol_and_leaves_the_rest_at_its_default(views: int) -> None:
    seen = observation(views=views)
    query = query_about(seen, seed=5)
    np.testing.assert_array_equal(query.points, seen.points_world)
    np.testing.assert_array_equal(query.viewpoints, seen.viewpoints)
    np.testing.assert_array_equal(query.up, [0.0, 0.0, 1.0])
    assert query.workspace is not None
    np.testing.assert_array_equal(query.workspace.minimum, PERCEPTION_BOX.minimum)
    np.testing.assert_array_equal(query.workspace.maximum, PERCEPTION_BOX.maximum)
    assert (query.support_height, query.seed) == (TABLE_HEIGHT, 5)
    plain, told = GraspQuery(seen.points_world), {"points", "viewpoints", "up", "workspace", "support_height", "seed"}
    rest = set(GraspQuery.__dataclass_fields__) - told
    assert all(getattr(query, name) == getattr(plain, name) for name in rest)
