"""Around every request: its id and its log line."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from service.middleware import LOGGED_METHOD, LOGGED_PATH


def test_the_request_id_comes_back_or_is_made_up(http: httpx.Client) -> None:
    given = http.get("/health/live", headers={"X-Request-ID": "robot-7/cell:3"})
    assert given.headers["X-Request-ID"] == "robot-7/cell:3"
    for unfit in ("with space", "a" * 129, 'quote"'):
        made_up = http.get("/health/live", headers={"X-Request-ID": unfit}).headers["X-Request-ID"]
        assert made_up.isalnum()
        assert made_up != http.get("/health/live").headers["X-Request-ID"]


def test_one_log_line_a_request_tells_what_happened(
    http: httpx.Client, shared_service: Any, cloud: NDArray[np.float32]
) -> None:
    http.post(
        "/grasps?max_candidates=100",
        content=cloud.tobytes(),
        headers={"Content-Type": "application/octet-stream", "X-Request-ID": "logged-1"},
    )
    line = shared_service.wait_for("request", request_id="logged-1")
    assert (line["method"], line["path"], line["status"]) == ("POST", "/grasps", 200)
    assert (line["points"], line["bytes_in"]) == (len(cloud), 12 * len(cloud))
    assert line["timings_ms"]["total"] <= line["duration_ms"]
    assert sum(other.get("request_id") == "logged-1" for other in shared_service.lines) == 1


def test_a_log_line_repeats_little_of_what_a_client_makes_up(http: httpx.Client, shared_service: Any) -> None:
    path = "/" + "a" * 60_000
    assert http.request("B" * 50, path, headers={"X-Request-ID": "long-1"}).status_code == 404
    line = shared_service.wait_for("request", request_id="long-1")
    assert (len(line["path"]), line["path"][:100]) == (LOGGED_PATH, path[:100])
    assert (len(line["method"]), line["method"][0]) == (LOGGED_METHOD, "B")
    assert len(json.dumps(line)) < 1000
