"""Routes beside `POST /grasps`."""

from __future__ import annotations

from dataclasses import asdict

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.schemas import ModelResponse
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


@pytest.mark.parametrize("path", ["/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready"])
def test_probes_may_ask_for_the_head_alone(http: httpx.Client, path: str) -> None:
    answer = http.head(path)
    assert (answer.status_code, answer.content) == (200, b"")
