from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs

import httpx
import numpy as np
import pytest

from simharness.errors import RunBroken, UsageError
from simharness.play.planner import REQUEST_TIMEOUT_S, HttpPlanner
from simharness.play.records import Latency
from simharness.sim.camera import Images, Observation

POSE = np.array([[0.0, 1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, -1.0, 0.08], [0.0, 0.0, 0.0, 1.0]])


def observation(count: int = 30, views: int = 1) -> Observation:
    points = np.random.default_rng(0).uniform(0.05, 0.25, (count, 3))
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, 3] = [[0.1 * view, 0.2, 0.7] for view in range(views)]
    blank = Images(np.zeros((2, 2)), np.zeros((2, 2, 3)), np.zeros((2, 2)))
    return Observation(points, poses[:, :3, 3], poses, (blank,) * views)


def answer(grasps: int, reason: str | None = None) -> dict[str, Any]:
    place = {"position": POSE[:3, 3].tolist(), "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    grasp = {
        **place,
        "matrix": POSE.tolist(),
        "hand_pose": place,
        "pregrasp": place,
        "width": 0.08,
        "approach_point": [0.1, 0.2, 0.1],
        "contact_point": [0.1, 0.2, 0.1],
    }
    rejected = dict.fromkeys(("support", "from_below", "approach", "target", "collision", "min_score", "duplicates"), 0)
    return {
        "grasps": [{**grasp, "score": 0.9 - 0.1 * index} for index in range(grasps)],
        "frame": "cloud",
        "model": {"name": "tesnet", "version": "1", "weights_sha256": "ab"},
        "counts": {
            "points": 30,
            "prepared_points": 20,
            "candidates": 9,
            "collision_free": 5,
            "returned": grasps,
            "rejected": rejected,
        },
        "reason": reason,
        "warnings": [],
        "timings_ms": dict.fromkeys(("decode", "queue", "prepare", "candidates", "network", "rank", "total"), 2.5),
        "request_id": "r",
    }


def planner(reply: Callable[[httpx.Request], httpx.Response], max_grasps: int = 1) -> HttpPlanner:
    return HttpPlanner("http://service.test", "tesnet", max_grasps, httpx.MockTransport(reply))


def test_the_request_carries_what_the_protocol_says() -> None:
    seen: list[httpx.Request] = []

    def reply(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer(1))

    view = observation()
    with planner(reply) as asked:
        asked.plan(view, seed=77)
    options = {name: json.loads(values[0]) for name, values in parse_qs(seen[0].url.query.decode()).items()}
    assert options == {
        "viewpoint": [[0.0, 0.2, 0.7]],
        "up": [0.0, 0.0, 1.0],
        "support_height": 0.05,
        "workspace": {"min": [0.02, 0.02, 0.055], "max": [0.28, 0.28, 0.3]},
        "max_grasps": 1,
        "seed": 77,
        "model": "tesnet",
    }
    np.testing.assert_array_equal(np.frombuffer(seen[0].content, "<f4").reshape(-1, 3), view.points_world)


def test_another_hand_is_asked_for_by_name() -> None:
    seen: list[httpx.Request] = []

    def reply(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer(1))

    for gripper in ("franka", "rg2"):
        with HttpPlanner("http://service.test", "tesnet", 1, httpx.MockTransport(reply), gripper=gripper) as asked:
            asked.plan(observation(), seed=1)
    franka, rg2 = (parse_qs(request.url.query.decode()) for request in seen)
    assert "gripper" not in franka  # older services know the default hand alone
    assert json.loads(rg2["gripper"][0]) == "rg2"


def test_the_service_is_told_to_calibrate_where_that_is_wanted() -> None:
    seen: list[httpx.Request] = []

    def reply(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer(1))

    for calibrate in (False, True):
        with HttpPlanner("http://service.test", "tesnet", 1, httpx.MockTransport(reply), calibrate=calibrate) as asked:
            asked.plan(observation(), seed=1)
    plain, calibrating = (parse_qs(request.url.query.decode()) for request in seen)
    assert "calibrate" not in plain  # older services know no such option
    assert calibrating["calibrate"] == ["true"]


def test_the_service_is_told_the_least_score_where_one_is_wanted() -> None:
    seen: list[httpx.Request] = []

    def reply(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer(1))

    for least in (None, 0.625):
        with HttpPlanner("http://service.test", "tesnet", 1, httpx.MockTransport(reply), min_score=least) as asked:
            asked.plan(observation(), seed=1)
    plain, choosy = (parse_qs(request.url.query.decode()) for request in seen)
    assert "min_score" not in plain
    assert choosy["min_score"] == ["0.625"]


def test_every_viewpoint_of_a_fused_cloud_is_sent() -> None:
    seen: list[httpx.Request] = []

    def reply(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer(1))

    with planner(reply) as asked:
        asked.plan(observation(views=3), seed=0)
    assert len(json.loads(parse_qs(seen[0].url.query.decode())["viewpoint"][0])) == 3


def test_a_plan_holds_the_grasps_in_order_and_what_the_service_said() -> None:
    with planner(lambda _: httpx.Response(200, json=answer(3)), max_grasps=3) as asked:
        plan = asked.plan(observation(), seed=0)
    assert len(plan) == 3
    np.testing.assert_array_equal(plan.Ts_world_grasp[0], POSE)
    np.testing.assert_allclose(plan.scores, [0.9, 0.8, 0.7])
    assert plan.counts["candidates"] == 9
    assert plan.latency == Latency(service=2.5, round_trip=plan.latency_ms or -1.0)
    assert not plan.Ts_world_grasp.flags.writeable


def test_no_grasps_come_with_the_services_reason() -> None:
    with planner(lambda _: httpx.Response(200, json=answer(0, "all_in_collision"))) as asked:
        plan = asked.plan(observation(), seed=0)
    assert len(plan) == 0
    assert plan.reason == "all_in_collision"


def test_a_cloud_without_points_is_not_sent() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise AssertionError(request.url)

    with planner(refuse) as asked:
        plan = asked.plan(observation(count=0), seed=0)
    assert plan.reason == "no_points_in_workspace"
    assert plan.latency is None


def test_a_service_that_cannot_be_reached_breaks_the_run() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("connection refused")

    with planner(refuse) as asked, pytest.raises(RunBroken, match=r"http://service\.test"):
        asked.plan(observation(), seed=0)


def test_a_refused_request_breaks_the_run_with_the_services_words() -> None:
    problem = {"type": "urn:x", "title": "invalid", "status": 422, "detail": "seed is odd", "request_id": "r"}
    with planner(lambda _: httpx.Response(422, json=problem)) as asked, pytest.raises(RunBroken, match="seed is odd"):
        asked.plan(observation(), seed=0)


def test_the_model_is_named_with_its_weights() -> None:
    document = model_document("tesnet")
    with planner(lambda _: httpx.Response(200, json=document)) as asked:
        record, whole = asked.model()
    assert (record.name, record.version, record.weights_sha256) == ("tesnet", "1", "ab")
    assert whole["device"] == "cpu"


def test_a_network_that_the_service_has_not_is_the_users_mistake() -> None:
    with (
        planner(lambda _: httpx.Response(200, json=model_document("gpd"))) as asked,
        pytest.raises(UsageError, match="gpd"),
    ):
        asked.model()


def test_an_address_that_is_no_url_is_the_users_mistake() -> None:
    with pytest.raises(UsageError, match="ftp://x"):
        HttpPlanner("ftp://x", "tesnet", 1)


def model_document(name: str) -> dict[str, Any]:
    gripper = ("max_width", "finger_depth", "finger_thickness", "finger_breadth", "hand_to_tcp")
    limits = (
        "max_points",
        "max_body_bytes",
        "max_grasps",
        "max_approach_points",
        "max_candidates",
        "max_candidates_of_large_hands",
        "queue_size",
        "max_timeout_s",
    )
    return {
        "models": [{"name": name, "version": "1", "weights_sha256": "ab", "card": {}, "configuration": {}}],
        "gripper": dict.fromkeys(gripper, 0.05),
        "frame_conventions": ["panda"],
        "content_types": [],
        "limits": dict.fromkeys(limits, 10),
        "device": "cpu",
    }


def test_a_service_that_does_not_answer_is_waited_for_as_long_as_the_harness_says() -> None:
    with HttpPlanner("http://service.test", "tesnet", 1) as asked:
        assert asked._client._timeout == REQUEST_TIMEOUT_S
