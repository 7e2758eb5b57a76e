"""What Prometheus reads."""

from __future__ import annotations

import httpx
import numpy as np
from numpy.typing import NDArray

from service.metrics import Metrics
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


def test_times_are_told_in_seconds_and_what_is_watched_is_looked_up_when_it_is_read() -> None:
    metrics, depth = Metrics(), [3]
    metrics.watch(lambda: depth[0], lambda: 2, lambda: False, lambda: 4096)
    metrics.prediction("tesnet", 1500, {"network": 250.0, "decode": 4.0})
    metrics.request("POST", "/grasps", 200, 0.75)
    metrics.batch(3)
    depth[0] = 5
    lines = set(metrics.text().decode().splitlines())
    assert lines >= {
        'grasp_stage_seconds_sum{stage="network"} 0.25',
        'grasp_stage_seconds_sum{stage="decode"} 0.004',
        'grasp_request_seconds_sum{route="/grasps"} 0.75',
        'grasp_requests_total{method="POST",route="/grasps",status="200"} 1.0',
        'grasp_predictions_total{model="tesnet"} 1.0',
        "grasp_points_sum 1500.0",
        "grasp_batch_size_sum 3.0",
        "grasp_queue_depth 5.0",
        "grasp_active_requests 2.0",
        "grasp_held_bytes 4096.0",
        "grasp_ready 0.0",
    }
