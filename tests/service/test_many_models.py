"""A service with two networks, over HTTP: `tesnet` and, without weights, `heuristic`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from tests.conftest import PATIENCE_S, StartService
from tests.service.conftest import Cloud


@pytest.fixture(scope="module")
def served(start_service: StartService) -> Iterator[httpx.Client]:
    with start_service(GRASP_MODELS="heuristic,tesnet", GRASP_MAX_BATCH="8") as service:
        service.wait_for("ready")
        with httpx.Client(base_url=service.url, timeout=PATIENCE_S) as client:
            yield client


def body(cloud: Cloud, **options: Any) -> dict[str, Any]:
    return {"points": cloud.tolist(), "viewpoint": [0.4, 0.2, 0.5], "up": [0, 0, 1], "max_candidates": 200, **options}


def test_the_option_model_picks_the_network_and_tesnet_answers_unasked_wherever_it_was_named(
    served: httpx.Client, cloud: Cloud
) -> None:
    listed = {model["name"]: model for model in served.get("/model").json()["models"]}
    assert list(listed) == ["tesnet", "heuristic"]
    assert listed["heuristic"]["weights_sha256"] is None
    assert listed["heuristic"]["configuration"]["network"]["antipodal"] > 0
    for asked, answered in ((None, "tesnet"), ("tesnet", "tesnet"), ("heuristic", "heuristic")):
        answer = served.post("/grasps", json=body(cloud, model=asked))
        assert answer.status_code == 200, answer.text
        identity = answer.json()["model"]
        assert identity == {key: listed[answered][key] for key in ("name", "version", "weights_sha256")}
        assert len(answer.json()["grasps"]) > 0


def test_concurrent_requests_for_both_are_answered_as_each_by_itself(served: httpx.Client, cloud: Cloud) -> None:
    def ask(model: str, seed: int) -> dict[str, Any]:
        answer = served.post("/grasps", json=body(cloud, model=model, seed=seed))
        assert answer.status_code == 200, answer.text
        document: dict[str, Any] = answer.json()
        return document

    asked = [(model, seed) for seed in range(3) for model in ("heuristic", "tesnet")]
    with ThreadPoolExecutor(len(asked)) as threads:
        together = list(threads.map(lambda one: ask(*one), asked))
    for (model, seed), answer in zip(asked, together, strict=True):
        assert answer["model"]["name"] == model
        alone = ask(model, seed)
        scores = [[grasp["score"] for grasp in document["grasps"]] for document in (answer, alone)]
        assert scores[0] == pytest.approx(scores[1], abs=1e-4)


def test_a_network_that_is_not_loaded_is_a_422_that_lists_those_that_are(served: httpx.Client, cloud: Cloud) -> None:
    for name in ("edgegrasp", "vgn"):
        answer = served.post("/grasps", json=body(cloud, model=name))
        assert (answer.status_code, answer.json()["field"]) == (422, "model")
        assert "loaded: tesnet, heuristic" in answer.json()["detail"]


def test_another_hand_is_for_tesnet_alone(served: httpx.Client, cloud: Cloud) -> None:
    narrow = {"max_width": 0.06}
    assert served.post("/grasps", json=body(cloud, gripper=narrow)).status_code == 200
    assert served.post("/grasps", json=body(cloud, gripper={"max_width": 0.08}, model="heuristic")).status_code == 200
    answer = served.post("/grasps", json=body(cloud, gripper=narrow, model="heuristic"))
    assert (answer.status_code, answer.json()["field"]) == (422, "gripper")
    assert "ask tesnet" in answer.json()["detail"]


def test_the_inference_protocol_has_a_path_for_each_network(served: httpx.Client, cloud: Cloud) -> None:
    tensor = {"name": "points", "datatype": "FP32", "shape": list(cloud.shape), "data": cloud.ravel().tolist()}
    parameters = {"up": "[0, 0, 1]", "max_candidates": 200}
    for name in ("tesnet", "heuristic"):
        assert served.get(f"/v2/models/{name}").json()["name"] == name
        answer = served.post(f"/v2/models/{name}/infer", json={"inputs": [tensor], "parameters": parameters}).json()
        assert answer["model_name"] == name
        (meta,) = (output["data"][0] for output in answer["outputs"] if output["name"] == "meta")
        assert json.loads(meta)["model"]["name"] == name
    other = {"inputs": [tensor], "parameters": {"model": "tesnet"}}
    refused = served.post("/v2/models/heuristic/infer", json=other)
    assert refused.status_code == 422
    assert refused.json()["error"] == "model: is tesnet, but the path names heuristic; leave it out"
    missing = served.get("/v2/models/gpd")
    assert missing.status_code == 404
    assert "loaded: tesnet, version" in missing.json()["error"]
    assert "; heuristic, version" in missing.json()["error"]


def test_metrics_count_the_answers_of_each_network(served: httpx.Client, cloud: Cloud) -> None:
    def counted() -> dict[str, float]:
        lines = [line for line in served.get("/metrics").text.splitlines() if "grasp_predictions_total{" in line]
        return {line.split('"')[1]: float(line.split()[-1]) for line in lines}

    before = counted()
    served.post("/grasps", json=body(cloud, model="heuristic"))
    after = counted()
    assert after["heuristic"] == before.get("heuristic", 0) + 1
    assert after.get("tesnet") == before.get("tesnet")
