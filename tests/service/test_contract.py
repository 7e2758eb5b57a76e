"""The 200s of api.md, over a real server with the shipped weights."""

from __future__ import annotations

import json
import urllib.parse
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.schemas import GraspOptions, GraspResponse
from tesnet.geometry import PANDA, Pose
from tesnet.result import REJECTIONS
from tests.service.wire import npy, post_octets, url_options

VOLATILE = ("timings_ms", "request_id")

OPTIONS: dict[str, Any] = {
    "viewpoint": [0.35, 0.0, 0.5],
    "up": [0, 0, 1],
    "workspace": {"min": [-0.2, -0.2, -0.05], "max": [0.2, 0.2, 0.3]},
    "support_height": 0.0,
    "target": {"box": {"min": [-0.05, -0.05, 0.0], "max": [0.05, 0.05, 0.2]}},
    "approach": {"direction": [0, 0, -1], "max_angle_deg": 120},
    "max_grasps": 5,
    "min_score": 0.0,
    "min_separation": {"translation": 0.005, "rotation_deg": 10},
    "num_approach_points": 24,
    "max_candidates": 400,
    "gripper": {"max_width": 0.075},
    "unseen": "free",
    "width": "full",
    "calibrate": True,
    "pregrasp_distance": 0.08,
    "frame_convention": "panda",
    "seed": 3,
    "model": "tesnet",
}
"""Every option."""


def steady(answer: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in answer.items() if key not in VOLATILE}


def test_every_option_of_the_interface_is_in_the_list_that_is_tested() -> None:
    assert set(OPTIONS) == set(GraspOptions.model_fields)


def test_every_content_type_gives_the_same_grasps_for_the_same_points(
    http: httpx.Client, cloud: NDArray[np.float32]
) -> None:
    expected = steady(post_octets(http, cloud, **OPTIONS))
    assert expected["grasps"]

    as_json = http.post("/grasps", json={"points": cloud.tolist(), **OPTIONS})
    assert steady(as_json.json()) == expected

    halves = http.post(
        f"/grasps?{url_options({key: OPTIONS[key] for key in ('up', 'viewpoint', 'model')})}",
        json={"points": cloud.tolist(), **{k: v for k, v in OPTIONS.items() if k not in ("up", "viewpoint", "model")}},
    )
    assert steady(halves.json()) == expected

    for array in (
        cloud,
        cloud.astype(np.float64),
        cloud.astype(">f8"),
        np.asfortranarray(cloud),
    ):
        answer = http.post(
            f"/grasps?{url_options(OPTIONS)}", content=npy(array), headers={"Content-Type": "application/x-npy"}
        )
        assert steady(answer.json()) == expected


def test_the_answer_is_what_the_schema_documents(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    answer = post_octets(http, cloud, **OPTIONS)

    strict = {"extra": "forbid", "strict": True}
    parsed = GraspResponse.model_validate_json(json.dumps(answer), **strict)  # type: ignore[arg-type]

    assert answer == json.loads(parsed.model_dump_json())
    assert tuple(answer["counts"]["rejected"]) == REJECTIONS
    assert parsed.counts.points == len(cloud)
    assert parsed.counts.returned == len(parsed.grasps) <= 5
    assert parsed.reason is None
    scores = [grasp.score for grasp in parsed.grasps]
    assert scores == sorted(scores, reverse=True)
    assert 0 < parsed.timings_ms.network < parsed.timings_ms.total


def test_hand_pose_and_pregrasp_lie_behind_the_grasp(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    for grasp in post_octets(http, cloud, **OPTIONS)["grasps"]:
        matrix = np.array(grasp["matrix"])
        pose = Pose.from_quaternion(np.array(grasp["quaternion_xyzw"]), np.array(grasp["position"]))
        np.testing.assert_allclose(pose.matrix, matrix, atol=1e-6)
        back = np.array([0, 0, -1.0])
        np.testing.assert_allclose(grasp["hand_pose"]["position"], pose.apply(PANDA.hand_to_tcp * back), atol=1e-6)
        np.testing.assert_allclose(grasp["pregrasp"]["position"], pose.apply(0.08 * back), atol=1e-6)
        assert grasp["pregrasp"]["quaternion_xyzw"] == grasp["quaternion_xyzw"]


@pytest.mark.parametrize("convention", ["graspnet", "contact_graspnet"])
def test_frame_convention_changes_the_pose_and_nothing_else(
    http: httpx.Client, cloud: NDArray[np.float32], convention: str
) -> None:
    ours = post_octets(http, cloud, **OPTIONS)["grasps"]
    theirs = post_octets(http, cloud, **{**OPTIONS, "frame_convention": convention})["grasps"]
    columns = {"graspnet": ([2, 1, 0], [1, 1, -1]), "contact_graspnet": ([1, 0, 2], [1, -1, 1])}
    order, signs = columns[convention]
    changed = ("position", "quaternion_xyzw", "matrix")
    for panda, other in zip(ours, theirs, strict=True):
        rotation = np.array(panda["matrix"])[:3, :3][:, order] * signs
        np.testing.assert_allclose(np.array(other["matrix"])[:3, :3], rotation, atol=1e-12)
        origin = panda["hand_pose"]["position"] if convention == "contact_graspnet" else panda["position"]
        np.testing.assert_allclose(other["position"], origin, atol=1e-12)
        assert {k: v for k, v in panda.items() if k not in changed} == {
            k: v for k, v in other.items() if k not in changed
        }


def test_same_seed_same_answer(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    first, again = (steady(post_octets(http, cloud, **OPTIONS)) for _ in range(2))
    assert first == again


def test_options_left_out_or_null_mean_the_default(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    body = {"points": cloud.tolist(), "max_candidates": 300}
    left_out = http.post("/grasps", json=body)
    given = http.post("/grasps", json={**body, "seed": 0, "up": None, "min_separation": None, "unseen": "free"})
    assert steady(left_out.json()) == steady(given.json())
    assert len(left_out.json()["warnings"]) >= 2  # neither viewpoint nor up


def test_a_plain_word_in_a_url_may_be_quoted_or_not(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    bare, quoted = (
        http.post(
            f"/grasps?max_candidates=200&unseen={urllib.parse.quote(word)}",
            content=cloud.tobytes(),
            headers={"Content-Type": "application/octet-stream"},
        ).json()
        for word in ("occupied", '"occupied"')
    )
    assert steady(bare) == steady(quoted)


@pytest.mark.parametrize("points", [[[0.1, 0.2, 0.3]], []])
def test_one_point_and_none_have_no_grasps_and_are_no_error(http: httpx.Client, points: list[list[float]]) -> None:
    answer = http.post("/grasps", json={"points": points})
    assert answer.status_code == 200
    assert answer.json()["grasps"] == []
    assert answer.json()["reason"] == "too_few_points"


def test_whole_numbers_are_coordinates_too(http: httpx.Client) -> None:
    answer = http.post("/grasps", json={"points": [[0, 0, 1], [1, 0, -0.0], [1e-3, 1, 0]]})
    assert answer.status_code == 200
    assert answer.json()["counts"]["points"] == 3


def test_an_empty_workspace_says_so(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    answer = post_octets(http, cloud, workspace={"min": [5, 5, 5], "max": [6, 6, 6]})
    assert answer["reason"] == "no_points_in_workspace"


def test_a_million_points_pass(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    million = np.tile(cloud, (167, 1))[:1_000_000]
    assert post_octets(http, million, max_candidates=100)["counts"]["points"] == 1_000_000
