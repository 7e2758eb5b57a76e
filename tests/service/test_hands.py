"""Other hands on the wire: by every door, in answers, and at `/model`."""

from __future__ import annotations

import io
import json
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from service.errors import Invalid
from service.hands import described, gripper_of
from service.schemas import GraspResponse, GripperOut, GripperSize, HandOut, ModelResponse
from tesnet.geometry import PANDA, Gripper, Pose
from tesnet.hands import HANDS
from tests.service.wire import OCTETS, npy

OPTIONS = {"viewpoint": [0.38, 0.55, 0.48], "up": [0, 0, 1], "support_height": 0.05, "max_candidates": 200}


def by_json(http: httpx.Client, cloud: NDArray[np.float32], gripper: Any) -> Any:
    return http.post("/grasps", json={"points": cloud.tolist(), **OPTIONS, "gripper": gripper}).json()


def query(gripper: Any) -> str:
    texts = {name: json.dumps(value) for name, value in {**OPTIONS, "gripper": gripper}.items()}
    return "&".join(f"{name}={quote(text)}" for name, text in texts.items())


def by_query(http: httpx.Client, cloud: NDArray[np.float32], gripper: Any) -> Any:
    return http.post(f"/grasps?{query(gripper)}", content=cloud.tobytes(), headers=OCTETS).json()


def by_form(http: httpx.Client, cloud: NDArray[np.float32], gripper: Any) -> Any:
    options = json.dumps({**OPTIONS, "gripper": gripper})
    return http.post("/grasps", files={"cloud": ("c.npy", npy(cloud))}, data={"options": options}).json()


def by_npz(http: httpx.Client, cloud: NDArray[np.float32], gripper: Any) -> Any:
    headers = {**OCTETS, "Accept": "application/x-npz"}
    answer = http.post(f"/grasps?{query(gripper)}", content=cloud.tobytes(), headers=headers)
    with np.load(io.BytesIO(answer.content)) as arrays:
        meta: dict[str, Any] = json.loads(str(arrays["meta"]))
        return {**meta, "grasps": [{"width": width} for width in arrays["widths"]]}


def by_inference_protocol(http: httpx.Client, cloud: NDArray[np.float32], gripper: Any) -> Any:
    points = {"name": "points", "datatype": "FP32", "shape": list(cloud.shape), "data": cloud.tolist()}
    parameters = {**OPTIONS, "gripper": gripper if isinstance(gripper, str) else json.dumps(gripper)}
    answer = http.post("/v2/models/tesnet/infer", json={"inputs": [points], "parameters": parameters}).json()
    outputs = {output["name"]: output["data"] for output in answer["outputs"]}
    return {**json.loads(outputs["meta"][0]), "grasps": [{"width": width} for width in outputs["widths"]]}


DOORS = {door.__name__: door for door in (by_json, by_query, by_form, by_npz, by_inference_protocol)}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ("robotiq_2f85", HANDS["robotiq_2f85"].gripper),
        (
            {"name": "rg2", "max_width": 0.07},
            HANDS["rg2"].gripper.with_sizes({"max_width": 0.07}),
        ),
        ({"max_width": 0.12, "hand_to_tcp": 0.2}, PANDA.with_sizes({"max_width": 0.12, "hand_to_tcp": 0.2})),
    ],
    ids=["name", "name and sizes", "sizes"],
)
def test_a_hand_is_named_or_described_at_every_door_and_told_in_the_answer(
    door: str, asked: Any, expected: Gripper, http: httpx.Client, cloud: NDArray[np.float32]
) -> None:
    answer = DOORS[door](http, cloud, asked)
    assert answer["gripper"] == json.loads(json.dumps(described(expected)))
    widths = {grasp["width"] for grasp in answer["grasps"]}
    if expected.travel:  # tips that swing arrive no wider open than what they will hold asks for
        assert 0 < min(widths) < max(widths) <= expected.max_width
    else:
        assert widths == {expected.max_width}
    assert not any("network was trained with" in note for note in answer["warnings"])  # it is told the hand


@pytest.mark.parametrize("door", DOORS)
def test_a_hand_opens_as_far_as_was_asked_at_every_door(
    door: str, http: httpx.Client, cloud: NDArray[np.float32], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(OPTIONS, "width", "full")
    assert {grasp["width"] for grasp in DOORS[door](http, cloud, "rg2")["grasps"]} == {0.104}
    monkeypatch.setitem(OPTIONS, "width", "fitted")
    assert min(grasp["width"] for grasp in DOORS[door](http, cloud, "franka")["grasps"]) < 0.08


def test_without_a_hand_it_is_frankas_and_nobody_is_warned(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    plain, named, sized = (by_json(http, cloud, asked) for asked in (None, "franka", {"max_width": 0.08}))
    assert plain["gripper"]["name"] == named["gripper"]["name"] == "franka"
    assert plain["grasps"] == named["grasps"] == sized["grasps"]
    assert not any("hand" in note for answer in (plain, named, sized) for note in answer["warnings"])


def test_the_base_link_is_where_its_arc_has_it(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    hand = HANDS["robotiq_2f85"].gripper
    answer = GraspResponse.model_validate(by_json(http, cloud, "robotiq_2f85"))
    assert answer.grasps
    for grasp in answer.grasps:
        T = Pose.from_matrix(grasp.matrix)
        base = Pose.from_quaternion(grasp.hand_pose.quaternion_xyzw, grasp.hand_pose.position)
        np.testing.assert_allclose(base.translation, T.apply([0.0, 0.0, -hand.tcp_at(grasp.width)]), atol=1e-9)
        np.testing.assert_allclose(base.rotation[:, 0], T.rotation[:, 1], atol=1e-6)  # its x closes


def test_what_an_answer_says_of_a_hand_can_be_asked_for(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    first = by_json(http, cloud, {"name": "hand_e", "finger_depth": 0.05})
    again = by_query(http, cloud, {name: value for name, value in first["gripper"].items() if name != "parts"})
    assert again["gripper"] == first["gripper"]
    assert again["grasps"] == first["grasps"]


def test_the_known_hands_are_listed(http: httpx.Client) -> None:
    model = ModelResponse.model_validate(http.get("/model").json(), extra="forbid")
    assert [hand.name for hand in model.hands] == list(HANDS)
    for told, known in zip(model.hands, HANDS.values(), strict=True):
        sizes = told.model_dump(include=set(GripperSize.model_fields) - {"name"})
        assert sizes == known.gripper.sizes()
        assert (told.min_force, told.max_force, told.simulated) == (known.min_force, known.max_force, known.simulated)
    assert model.gripper.name == "franka"


def test_sizes_have_the_same_names_everywhere() -> None:
    names = {*HANDS["rg2"].gripper.sizes(), "name"}
    assert set(GripperSize.model_fields) == names
    assert set(GripperOut.model_fields) == names | {"parts"}
    assert set(HandOut.model_fields) - set(GripperOut.model_fields) == {
        "min_force",
        "max_force",
        "max_payload",
        "simulated",
    }
    defaults = {name: field.default for name, field in GripperSize.model_fields.items()}
    assert defaults == {**PANDA.sizes(), "name": "franka"}


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("robotiq_2f80", "did you mean robotiq_2f85.*valid: franka, .*or give its sizes"),
        (GripperSize(name="nobody's"), "no known hand.*valid"),
        (GripperSize(name="ag95", linkage_length=0.02), r"max_width is 0\.095; cranks .* open less than 0\.057 m"),
    ],
)
def test_a_hand_that_cannot_be_is_refused(option: Any, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        gripper_of(option)


def test_the_limit_of_the_opening_is_named(service_url: str) -> None:
    answer = httpx.post(f"{service_url}/grasps", json={"points": [[0, 0, 0]], "gripper": {"max_width": 0.17}})
    problem = answer.json()
    assert answer.status_code == 422
    assert problem["field"] == "gripper"
    for word in ("0.17", "0.16", "max_width", "opens at most"):
        assert word in problem["detail"]
