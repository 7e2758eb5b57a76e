from __future__ import annotations

import json
import operator
import pickle
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import datetime, timedelta, timezone
from email.utils import format_datetime
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

import client
from client.reply import Answer, grasp_reply, model_reply, problem
from tesnet.geometry import Pose
from tesnet.hands import HANDS
from tests.client.conftest import model_document

if TYPE_CHECKING:
    from tests.client.conftest import Answering


def _answer(document: object, status: int = 200) -> Answer:
    return Answer(status, {"content-type": "application/json"}, json.dumps(document).encode())


def test_the_hand_that_answered_is_a_gripper_and_older_services_say_none(found: dict[str, Any]) -> None:
    hand = HANDS["rg2"].gripper.with_sizes({"max_width": 0.05})
    told: dict[str, Any] = {"name": "mine", **hand.sizes(), "parts": []}
    reply = grasp_reply(_answer({**found, "gripper": told}))
    assert reply.gripper == hand
    assert reply.gripper.name == "mine"
    assert grasp_reply(_answer({name: value for name, value in found.items() if name != "gripper"})).gripper is None
    with pytest.raises(client.UnexpectedResponse, match="no hand"):
        grasp_reply(_answer({**found, "gripper": {**told, "finger_depth": 0.001}}))


def test_every_field_of_the_document_arrives(found: dict[str, Any]) -> None:
    reply = grasp_reply(_answer(found))
    assert len(reply) == len(reply.grasps) == 3
    for index, (grasp, wire) in enumerate(zip(reply.grasps, found["grasps"], strict=True)):
        assert grasp.score == reply.scores[index] == wire["score"]
        np.testing.assert_allclose(grasp.pose.matrix, wire["matrix"], atol=1e-12)
        np.testing.assert_allclose(grasp.position, wire["position"])
        np.testing.assert_allclose(abs(grasp.quaternion_xyzw @ wire["quaternion_xyzw"]), 1)
        np.testing.assert_allclose(grasp.hand_pose.translation, wire["hand_pose"]["position"])
        np.testing.assert_allclose(grasp.pregrasp.translation, wire["pregrasp"]["position"])
        assert grasp.width == reply.widths[index] == wire["width"]
        np.testing.assert_array_equal(grasp.approach_point, wire["approach_point"])
        np.testing.assert_array_equal(grasp.contact_point, wire["contact_point"])
        np.testing.assert_array_equal(reply.poses[index], grasp.pose.matrix)
        np.testing.assert_array_equal(reply.hand_poses[index], grasp.hand_pose.matrix)
        np.testing.assert_array_equal(reply.pregrasps[index], grasp.pregrasp.matrix)
        np.testing.assert_array_equal(reply.approach_points[index], grasp.approach_point)
        np.testing.assert_array_equal(reply.contact_points[index], grasp.contact_point)
    assert (reply.counts.points, reply.counts.returned) == (200, 3)
    assert dict(reply.counts.rejected) == found["counts"]["rejected"]
    assert reply.reason is None
    assert list(reply.warnings) == found["warnings"]
    assert dict(reply.timings_ms) == found["timings_ms"]
    assert (reply.model.name, reply.model.weights_sha256) == ("tesnet", "ab" * 32)
    assert reply.request_id == "r-1"
    assert reply.to_dict() == found


def test_no_number_of_the_document_is_taken_for_another(found: dict[str, Any]) -> None:
    """All of them differ here, hand and pregrasp turned as no service turns them."""
    rng = np.random.default_rng(0)
    for wire in found["grasps"]:
        for name in ("hand_pose", "pregrasp"):
            pose = Pose.random(rng, reach=0.3)
            wire[name] = {"position": pose.translation.tolist(), "quaternion_xyzw": pose.quaternion_xyzw.tolist()}
        wire["width"] = float(rng.uniform(0, 0.08))
    numbers = iter(range(1, 100))
    for group in (found["counts"], found["counts"]["rejected"], found["timings_ms"]):
        group.update({name: next(numbers) for name, value in group.items() if not isinstance(value, dict)})
    reply = grasp_reply(_answer(found))
    for grasp, wire in zip(reply.grasps, found["grasps"], strict=True):
        for name in ("hand_pose", "pregrasp"):
            pose, told = getattr(grasp, name), wire[name]
            np.testing.assert_allclose(pose.translation, told["position"], atol=1e-12)
            np.testing.assert_allclose(abs(pose.quaternion_xyzw @ told["quaternion_xyzw"]), 1)
        assert grasp.width == wire["width"]
    counts = asdict(replace(reply.counts, rejected=dict(reply.counts.rejected)))
    assert counts == found["counts"]
    assert dict(reply.timings_ms) == found["timings_ms"]


def test_the_limits_of_a_service_arrive_each_in_its_place() -> None:
    document = model_document()
    document["limits"] = {name: 10 + place for place, name in enumerate(document["limits"])}
    document["models"] += [{**document["models"][0], "name": "gpd", "version": "7", "weights_sha256": None}]
    reply = model_reply(_answer(document))
    assert asdict(reply.limits) == document["limits"]
    assert [(model.name, model.version, model.weights_sha256) for model in reply.models] == [
        ("tesnet", "1", "ab" * 32), ("gpd", "7", None),
    ]  # fmt: skip
    assert (reply.device, list(reply.frame_conventions)) == ("cpu", document["frame_conventions"])


def test_nothing_found_is_a_reply_with_a_reason_and_empty_stacks(nothing_found: dict[str, Any]) -> None:
    reply = grasp_reply(_answer(nothing_found))
    assert reply.grasps == ()
    assert reply.reason == "all_in_collision"
    assert reply.poses.shape == reply.hand_poses.shape == reply.pregrasps.shape == (0, 4, 4)
    assert reply.approach_points.shape == reply.contact_points.shape == (0, 3)


def test_a_reply_cannot_be_changed_not_even_after_pickling(found: dict[str, Any]) -> None:
    reply = grasp_reply(_answer(found))
    for same in (reply, pickle.loads(pickle.dumps(reply))):
        for array in (same.scores, same.poses, same.widths, same.grasps[0].position, same.grasps[0].contact_point):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1
        with pytest.raises(AttributeError):
            setattr(same, "reason", "other")  # noqa: B010 - mypy would refuse the assignment itself
        with pytest.raises(TypeError):
            operator.setitem(cast("dict[str, int]", same.counts.rejected), "support", 0)
        assert same.to_dict() == found


def test_fields_that_a_later_service_adds_are_ignored(found: dict[str, Any]) -> None:
    found["grasps"][0]["novel"] = found["novel"] = 1
    assert len(grasp_reply(_answer(found))) == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda document: document.pop("counts"), "counts"),
        (lambda document: document["grasps"][1].update(score="high"), r"grasps\.1\.score"),
        (lambda document: document["grasps"][0]["matrix"][0].__setitem__(0, 9.0), "no rigid pose"),
        (lambda document: document["grasps"][0]["hand_pose"].update(quaternion_xyzw=[0, 0, 0, 0]), "no rigid pose"),
    ],
)
def test_another_document_is_an_unexpected_response_that_names_the_place(
    found: dict[str, Any], change: Callable[[dict[str, Any]], None], words: str
) -> None:
    change(found)
    with pytest.raises(client.UnexpectedResponse, match=words):
        grasp_reply(_answer(found))


@pytest.mark.parametrize("body", [b"", b"<html>hello</html>", b"[]", b"\xff\xfe"])
def test_a_body_that_is_no_document_is_an_unexpected_response(body: bytes) -> None:
    for parse in (grasp_reply, model_reply):
        with pytest.raises(client.UnexpectedResponse, match=f"{len(body)} bytes"):
            parse(Answer(200, {"content-type": "text/html"}, body))


KINDS = {
    400: client.BadRequest,
    401: client.Unauthorized,
    404: client.ProblemError,
    413: client.PayloadTooLarge,
    415: client.UnsupportedMediaType,
    422: client.InvalidRequest,
    429: client.Overloaded,
    500: client.ServiceFault,
    503: client.Overloaded,
    504: client.DeadlineExceeded,
}


@pytest.mark.parametrize("status", KINDS)
def test_every_status_has_its_class(status: int, refusing: Callable[..., Answering]) -> None:
    wire = refusing(status)
    error = problem(Answer(status, {}, wire.body))
    assert type(error) is KINDS[status]
    for same in (error, pickle.loads(pickle.dumps(error))):
        assert isinstance(same, client.ProblemError)
        assert (same.status, same.title, same.detail, same.request_id) == (status, "A title", "A detail.", "r-1")
        assert dict(same.problem) == json.loads(wire.body)
        assert str(same) == f"{status} A title: A detail. (request r-1)"


@pytest.mark.parametrize("status", [401, 413, 429, 503, 504])
def test_a_proxy_that_refuses_in_its_own_words_is_the_same_kind_of_problem(status: int) -> None:
    error = problem(Answer(status, {"retry-after": "3"}, b"<html>no</html>"))
    assert type(error) is KINDS[status]
    assert isinstance(error, client.ProblemError)
    assert "proxy" in error.detail
    assert error.retry_after == 3


@pytest.mark.parametrize(("status", "phrase"), [(401, "Unauthorized"), (429, "Too Many Requests")])
@pytest.mark.parametrize("request_id", [None, "mine"])
@pytest.mark.parametrize("retry_after", [None, "3"])
def test_what_a_proxy_says_is_told_with_what_its_headers_say(
    status: int, phrase: str, request_id: str | None, retry_after: str | None
) -> None:
    given = {"x-request-id": request_id, "retry-after": retry_after}
    error = problem(Answer(status, {name: value for name, value in given.items() if value}, b"no"))
    assert isinstance(error, client.ProblemError)
    assert (error.status, error.title, error.request_id, dict(error.problem)) == (status, phrase, request_id, {})
    assert error.retry_after == (None if retry_after is None else 3.0)


def test_a_problem_of_the_service_is_told_by_its_document(refusing: Callable[..., Answering]) -> None:
    """Its own id, whatever a header says."""
    wire = refusing(429)
    error = problem(Answer(429, {"x-request-id": "of-a-proxy", "retry-after": " 7 "}, wire.body))
    assert isinstance(error, client.Overloaded)
    assert (error.request_id, error.retry_after) == ("r-1", 7.0)


@pytest.mark.parametrize("kind", [None, "text/html"])
def test_another_answer_is_told_by_its_status_type_and_size(kind: str | None) -> None:
    error = problem(Answer(418, {} if kind is None else {"content-type": kind}, b"short and stout"))
    assert f"(status 418, {kind or 'no content type'}, 15 bytes)" in str(error)
    assert isinstance(error, client.UnexpectedResponse)
    assert error.status == 418


@pytest.mark.parametrize("status", [204, 301, 404, 418])
def test_any_other_foreign_answer_is_unexpected(status: int) -> None:
    error = problem(Answer(status, {}, b"<html>no</html>"))
    assert type(error) is client.UnexpectedResponse
    assert error.status == status


def test_a_problem_document_with_another_status_than_its_answer_is_unexpected(
    refusing: Callable[..., Answering],
) -> None:
    for status, told in ((500, 400), (400, 500)):
        assert type(problem(Answer(status, {}, refusing(told).body))) is client.UnexpectedResponse


@pytest.mark.parametrize(("text", "seconds"), [("0", 0.0), ("12", 12.0), ("soon", None), ("-3", None), ("", None)])
def test_retry_after_in_seconds(text: str, seconds: float | None, refusing: Callable[..., Answering]) -> None:
    error = problem(Answer(503, {"retry-after": text}, refusing(503).body))
    assert isinstance(error, client.Overloaded)
    assert error.retry_after == seconds


def test_retry_after_as_a_date(refusing: Callable[..., Answering]) -> None:
    def retry_after(date: datetime) -> float | None:
        error = problem(Answer(503, {"retry-after": format_datetime(date, usegmt=True)}, refusing(503).body))
        assert isinstance(error, client.Overloaded)
        return error.retry_after

    now = datetime.now(timezone.utc)
    assert retry_after(now - timedelta(hours=1)) == 0
    later = retry_after(now + timedelta(hours=1))
    assert later is not None
    assert 3000 < later <= 3600


@pytest.mark.parametrize("here", ["UTC0", "JST-9", "EST5"])
@pytest.mark.parametrize("form", ["%a, %d %b %Y %H:%M:%S GMT", "%a, %d %b %Y %H:%M:%S -0000", "%a %b %d %H:%M:%S %Y"])
def test_a_date_to_retry_after_is_that_of_greenwich_wherever_the_client_runs(
    here: str, form: str, refusing: Callable[..., Answering], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In each of the forms that HTTP knows, two of which name no zone of their own."""
    text = (datetime.now(timezone.utc) + timedelta(hours=1)).strftime(form)
    try:
        with monkeypatch.context() as patch:
            patch.setenv("TZ", here)
            time.tzset()
            error = problem(Answer(503, {"retry-after": text}, refusing(503).body))
    finally:
        time.tzset()
    assert isinstance(error, client.Overloaded)
    assert error.retry_after is not None
    assert 3000 < error.retry_after <= 3600


def test_no_array_of_a_reply_can_be_changed(found: dict[str, Any]) -> None:
    reply = grasp_reply(_answer(found))
    names = ("scores", "poses", "hand_poses", "pregrasps", "widths", "approach_points", "contact_points")
    arrays = [getattr(reply, name) for name in names]
    for grasp in reply.grasps:
        arrays += [grasp.approach_point, grasp.contact_point, grasp.position, grasp.pose.rotation]
    for array in arrays:
        assert not array.flags.writeable


def test_the_hand_of_a_reply_has_every_size_that_was_told(found: dict[str, Any]) -> None:
    for name, known in HANDS.items():
        told: dict[str, Any] = {"name": name, **known.gripper.sizes(), "parts": []}
        hand = grasp_reply(_answer({**found, "gripper": told})).gripper
        assert hand is not None
        assert hand.sizes() == pytest.approx(known.gripper.sizes())
        assert hand.name == name
