"""Routes beside `POST /grasps`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.schemas import MAX_TIMEOUT_S, ModelResponse
from tesnet import query
from tesnet.geometry import PANDA
from tests.service.wire import post_octets


def test_model_tells_networks_frames_gripper_and_limits(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    answer = http.get("/model")
    model = ModelResponse.model_validate(answer.json(), extra="forbid")
    identity = post_octets(http, cloud, max_candidates=50)["model"]
    assert (model.models[0].name, model.models[0].weights_sha256) == (identity["name"], identity["weights_sha256"])
    assert model.limits.max_points == 1_000_000
    assert model.limits.max_body_bytes == 64 * 2**20
    assert model.gripper.max_width == 0.08
    for told, part in zip(model.gripper.parts, PANDA.parts, strict=True):
        assert (told.name, told.side) == (part.name, part.side)
        assert [section.model_dump() for section in told.sections] == [asdict(section) for section in part.sections]
    assert model.models[0].card
    assert model.device == "cpu"


def test_every_limit_that_model_tells_is_the_one_that_holds(serve: Callable[..., Any]) -> None:
    url = serve(max_points=1001, max_body_mb=3.0, queue_size=7).url
    assert httpx.get(f"{url}/model").json()["limits"] == {
        "max_points": 1001,
        "max_body_bytes": 3 * 2**20,
        "max_grasps": query.MAX_GRASPS,
        "max_approach_points": query.MAX_APPROACH_POINTS,
        "max_candidates": query.MAX_CANDIDATES,
        "max_candidates_of_large_hands": query.MAX_CANDIDATES_OF_LARGE_HANDS,
        "queue_size": 7,
        "max_timeout_s": MAX_TIMEOUT_S,
    }


@pytest.mark.parametrize("path", ["/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready"])
def test_probes_may_ask_for_the_head_alone(http: httpx.Client, path: str) -> None:
    answer = http.head(path)
    assert (answer.status_code, answer.content) == (200, b"")
