"""What clients may ask for with `Accept`, and that a .npz holds what the JSON does."""

from __future__ import annotations

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.answers import encoder_for
from service.errors import NotAcceptable
from service.schemas import GraspResponse
from tesnet.geometry import quaternions_xyzw
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
