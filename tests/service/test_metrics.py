"""What Prometheus reads."""

from __future__ import annotations

import httpx
import numpy as np
from numpy.typing import NDArray

from tests.service.wire import post_octets


def test_health_and_metrics(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    assert http.get("/health/live").json() == {"status": "live"}
    assert http.get("/health/ready").json() == {"status": "ready"}
    post_octets(http, cloud, max_candidates=50)
    text = http.get("/metrics").text
    for line in (
        'grasp_requests_total{method="POST",route="/grasps",status="200"}',
        'grasp_stage_seconds_count{stage="network"}',
        "grasp_queue_depth 0.0",
        "grasp_batch_size_count",
        "grasp_ready 1.0",
    ):
        assert line in text
