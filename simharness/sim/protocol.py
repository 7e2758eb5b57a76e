"""What is asked about an observation: one query, which the harness sends to a service and the training labels.

Knows no service and no network.
"""

from __future__ import annotations

import numpy as np

from simharness.sim.camera import Observation, perception_box
from tesnet.geometry import PANDA, Gripper
from tesnet.query import GraspQuery


def query_about(
    observation: Observation, seed: int = 0, gripper: Gripper = PANDA, *, calibrate: bool = False
) -> GraspQuery:
    """The cloud of an observation with all that the protocol tells of it; nothing else is changed from the defaults.

    Args:
        observation: with the table in view, if it is to calibrate.
        seed: of the query.
        gripper: of the query.
        calibrate: of the query.
    """
    return GraspQuery(
        observation.points_world,
        viewpoints=observation.viewpoints,
        up=np.array([0.0, 0.0, 1.0]),
        workspace=perception_box(observation.table_height),
        support_height=observation.table_height,
        gripper=gripper,
        seed=seed,
        calibrate=calibrate,
    )
