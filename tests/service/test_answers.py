"""What clients may ask for with `Accept`, and that a .npz holds what the JSON does."""

from __future__ import annotations

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.answers import encode_json, encode_npz, encoder_for
from service.errors import NotAcceptable
from service.schemas import GraspOptions, GraspResponse
from tesnet.geometry import GraspSet, Pose, quaternions_xyzw
from tesnet.hands import HANDS
from tesnet.predictor import ModelInfo
from tesnet.result import REJECTIONS, GraspCounts, GraspResult
from tests.service.test_contract import OPTIONS, steady
from tests.service.wire import url_options

NPZ, JSON = "application/x-npz", "application/json"


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        ([], JSON),
        ([""], JSON),
        (["*/*"], JSON),
        (["application/*"], JSON),
        ([JSON], JSON),
        ([NPZ], NPZ),
        (["Application/X-NPZ ; q=0.2"], NPZ),
        ([f"{NPZ}, */*;q=0.1"], NPZ),
        ([f"{NPZ}, */*"], NPZ),
        ([f"{NPZ}, {JSON}"], JSON),
        ([f"{NPZ};q=0.4, {JSON};q=0.3"], NPZ),
        ([f"{NPZ};q=0.4, */*;q=0.5"], JSON),
        ([f"{JSON};q=0, */*"], NPZ),
        (["text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"], JSON),
        (["text/html", NPZ], NPZ),
        ([f"{NPZ};q=often"], NPZ),
        ([f"{NPZ};q=7, {JSON}"], JSON),  # no weight is more than 1
        ([f"{NPZ};q=0.1, {JSON};q=-1"], NPZ),
        ([f"{JSON}; charset=utf-8"], JSON),
    ],
)
def test_the_format_is_the_one_that_the_client_ranks_highest(accept: list[str], expected: str) -> None:
    assert encoder_for(accept).content_type == expected


@pytest.mark.parametrize("accept", ["text/html", "*/*;q=0", f"{NPZ};q=0, {JSON};q=0", "json", "image/*"])
def test_no_common_format_is_not_acceptable(accept: str) -> None:
    with pytest.raises(NotAcceptable, match=r"application/json, application/x-npz"):
        encoder_for([accept])


@pytest.mark.parametrize("convention", ["panda", "contact_graspnet"])
def test_a_npz_holds_what_the_json_does(http: httpx.Client, cloud: NDArray[np.float32], convention: str) -> None:
    def ask(accept: str) -> httpx.Response:
        url = f"/grasps?{url_options({**OPTIONS, 'frame_convention': convention})}"
        headers = {"Content-Type": "application/octet-stream", "Accept": accept}
        return http.post(url, content=cloud.tobytes(), headers=headers)

    answer, document = ask(NPZ), ask(JSON).json()
    assert (answer.status_code, answer.headers["Content-Type"], answer.headers["Vary"]) == (200, NPZ, "Accept")
    with np.load(io.BytesIO(answer.content), allow_pickle=False) as file:
        arrays: dict[str, NDArray[Any]] = dict(file)
    meta = json.loads(str(arrays.pop("meta")))
    grasps = document.pop("grasps")
    assert steady(meta) == steady(document)
    assert set(meta) | {"grasps"} == set(GraspResponse.model_fields)
    assert len(grasps) == len(arrays["scores"]) > 0
    columns = {
        "scores": "score",
        "poses": "matrix",
        "widths": "width",
        "approach_points": "approach_point",
        "contact_points": "contact_point",
    }
    for name, field in columns.items():
        np.testing.assert_array_equal(arrays.pop(name), [grasp[field] for grasp in grasps])
    for name, field in {"hand_poses": "hand_pose", "pregrasps": "pregrasp"}.items():
        poses = arrays.pop(name)
        np.testing.assert_array_equal(poses[:, :3, 3], [grasp[field]["position"] for grasp in grasps])
        np.testing.assert_array_equal(
            quaternions_xyzw(poses[:, :3, :3]), [grasp[field]["quaternion_xyzw"] for grasp in grasps]
        )
    assert not arrays


def test_nothing_found_is_a_npz_of_empty_arrays(http: httpx.Client) -> None:
    answer = http.post("/grasps", json={"points": [[0, 0, 1]]}, headers={"Accept": NPZ})
    with np.load(io.BytesIO(answer.content), allow_pickle=False) as file:
        assert file["poses"].shape == file["hand_poses"].shape == (0, 4, 4)
        assert file["approach_points"].shape == (0, 3)
        assert json.loads(str(file["meta"]))["reason"] == "too_few_points"


def test_a_refusal_is_a_problem_document_whatever_is_accepted(http: httpx.Client) -> None:
    answer = http.post("/grasps", json={"points": []}, headers={"Accept": NPZ, "Content-Encoding": "gzip"})
    assert answer.headers["Content-Type"] == "application/problem+json"


def test_no_number_of_a_result_is_taken_for_another_in_either_format() -> None:
    """All of them differ; a hand whose base link is turned and whose tips swing."""
    rng = np.random.default_rng(0)
    hand = HANDS["rg2"].gripper
    poses = [Pose.random(rng, reach=0.3) for _ in range(3)]
    scores, widths = np.array([0.9, 0.5, 0.25]), np.array([0.05, 0.06, 0.07])
    points = rng.uniform(-1, 1, (2, 3, 3))
    grasps = GraspSet(scores, np.stack([pose.matrix for pose in poses]), widths, points[0], points[1], hand)
    rejected = {name: 100 + number for number, name in enumerate(REJECTIONS)}
    counts = GraspCounts(1, 2, 3, 4, 5, rejected, ignored_points=6)
    result = GraspResult(grasps, counts, None, ("be warned", "again"), {"network": 1.0})
    model = ModelInfo("gpd", "7", "ab" * 32, {}, {})
    options = GraspOptions(pregrasp_distance=0.125)
    timings = {"decode": 1.23456, "network": 2.0}
    document = json.loads(encode_json(result, options, model, timings, "r-1"))
    assert document["counts"] == {
        "points": 1,
        "prepared_points": 2,
        "candidates": 3,
        "collision_free": 4,
        "returned": 5,
        "ignored_points": 6,
        "rejected": rejected,
    }
    assert document["model"] == {"name": "gpd", "version": "7", "weights_sha256": "ab" * 32}
    told = {name: document[name] for name in ("reason", "warnings", "timings_ms", "frame", "request_id")}
    assert told == {
        "reason": None,
        "warnings": ["be warned", "again"],
        "timings_ms": {"decode": 1.235, "network": 2.0},
        "frame": "cloud",
        "request_id": "r-1",
    }
    assert document["gripper"]["name"] == "rg2"
    with np.load(io.BytesIO(encode_npz(result, options, model, timings, "r-1")), allow_pickle=False) as file:
        arrays: dict[str, NDArray[Any]] = dict(file)
    assert json.loads(str(arrays["meta"])) == {name: value for name, value in document.items() if name != "grasps"}
    for row, (pose, found) in enumerate(zip(poses, document["grasps"], strict=True)):
        hand_pose = pose @ hand.T_grasp_hand(float(widths[row]))
        pregrasp = pose @ Pose(np.eye(3), np.array([0.0, 0.0, -0.125]))
        assert (found["score"], found["width"]) == (scores[row], widths[row])
        assert (arrays["scores"][row], arrays["widths"][row]) == (scores[row], widths[row])
        for name, expected, array in (
            ("approach_point", points[0, row], "approach_points"),
            ("contact_point", points[1, row], "contact_points"),
            ("matrix", pose.matrix, "poses"),
        ):
            np.testing.assert_allclose(found[name], expected, atol=1e-12)
            np.testing.assert_allclose(arrays[array][row], expected, atol=1e-12)
        for one, expected_pose in ((found, pose), (found["hand_pose"], hand_pose), (found["pregrasp"], pregrasp)):
            np.testing.assert_allclose(one["position"], expected_pose.translation, atol=1e-9)
            np.testing.assert_allclose(abs(np.dot(one["quaternion_xyzw"], expected_pose.quaternion_xyzw)), 1)
        np.testing.assert_allclose(arrays["hand_poses"][row], hand_pose.matrix, atol=1e-9)
        np.testing.assert_allclose(arrays["pregrasps"][row], pregrasp.matrix, atol=1e-9)
