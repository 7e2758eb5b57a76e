"""An HTTP answer -> frozen values, or a typed error, as pure functions. `service.schemas` has the wire format."""

from __future__ import annotations

import email.utils
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from http import HTTPStatus
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ValidationError

from client.errors import ProblemError, ServiceUnreachable, UnexpectedResponse, problem_class
from service import schemas
from tesnet.geometry import PANDA, Gripper, Pose

STATUSES_OF_PROXIES = frozenset({401, 413, 429, 503, 504})
"""Statuses that mean the same from a proxy as from the service."""

STATUSES_OF_LOST_SERVICES = frozenset({500, 502})
"""What proxies answer, in their own words, when the service behind them ended before its answer was there."""

Document = TypeVar("Document", bound=BaseModel)
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Answer:
    """One HTTP answer.

    Args:
        status: the HTTP status.
        headers: names in lower case.
        body: decoded from any content encoding.
    """

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True, eq=False, slots=True)
class Grasp:
    """One grasp, in the frame of the points that were sent, metres.

    Args:
        score: probability of success, 0 to 1.
        pose: the grasp in the convention that was asked for; panda: origin at the TCP, +z the direction of travel,
            +y the closing direction.
        hand_pose: the pose of the hand's base link, open by `width`, in its own axes, whatever the convention.
        pregrasp: where to begin the straight approach.
        width: the opening to set before approaching.
        approach_point: (3,) the point that the grasp was made from; the hand may stand beside it along y.
        contact_point: (3,) the point that one fingertip closes onto.
    """

    score: float
    pose: Pose
    hand_pose: Pose
    pregrasp: Pose
    width: float
    approach_point: Array
    contact_point: Array

    def __post_init__(self) -> None:
        for name in ("approach_point", "contact_point"):
            object.__setattr__(self, name, _frozen(getattr(self, name), (3,)))

    @property
    def position(self) -> Array:
        """(3,) origin of the grasp."""
        return self.pose.translation

    @property
    def quaternion_xyzw(self) -> Array:
        """(4,) orientation of the grasp, order x, y, z, w."""
        return self.pose.quaternion_xyzw


@dataclass(frozen=True, slots=True)
class Counts:
    """How many points and candidates were left after each stage; `rejected` says what the others failed.

    `ignored_points` were sent, but hold NaN or an infinity.
    """

    points: int
    prepared_points: int
    candidates: int
    collision_free: int
    returned: int
    rejected: Mapping[str, int]
    ignored_points: int = 0


@dataclass(frozen=True, slots=True)
class ModelIdentity:
    """The network that scored the grasps."""

    name: str
    version: str
    weights_sha256: str | None


@dataclass(frozen=True, eq=False, slots=True)
class GraspReply:
    """The service's answer to a grasp request: grasps best first, in the frame of the points, metres.

    The stacked arrays are read-only and hold the same grasps in the same order.

    Args:
        grasps: best first; empty where nothing was found.
        scores: (M,) probabilities of success.
        poses: (M, 4, 4) of the grasps, in the convention that was asked for.
        hand_poses: (M, 4, 4) of the hand's base link.
        pregrasps: (M, 4, 4) where to begin the straight approach.
        widths: (M,) openings to set.
        approach_points, contact_points: (M, 3).
        counts: what was left after each stage.
        reason: why there are no grasps; None where there are.
        warnings: what the service had to assume.
        timings_ms: milliseconds by stage, as the service measured them.
        model: the network.
        request_id: names the request in the service's log.
        text: the JSON document as it came.
        gripper: the hand that they are for; None where the service does not say, as before version 0.5.
    """

    grasps: tuple[Grasp, ...]
    scores: Array
    poses: Array
    hand_poses: Array
    pregrasps: Array
    widths: Array
    approach_points: Array
    contact_points: Array
    counts: Counts
    reason: str | None
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]
    model: ModelIdentity
    request_id: str
    text: str
    gripper: Gripper | None

    def __len__(self) -> int:
        return len(self.grasps)

    def __reduce__(self) -> tuple[Any, ...]:
        return grasp_reply, (Answer(200, {}, self.text.encode()),)

    def to_dict(self) -> dict[str, Any]:
        """The JSON document as it came, as a fresh dictionary."""
        document: dict[str, Any] = json.loads(self.text)
        return document


@dataclass(frozen=True, slots=True)
class Limits:
    """What the service accepts: points and bytes of a request, and the largest values of three options."""

    max_points: int
    max_body_bytes: int
    max_grasps: int
    max_approach_points: int
    max_candidates: int
    max_candidates_of_large_hands: int
    queue_size: int
    max_timeout_s: float


@dataclass(frozen=True, slots=True)
class ModelReply:
    """What the service says about itself at `/model`.

    Args:
        models: the loaded networks; the first is the default.
        frame_conventions: valid values of `frame_convention`.
        limits: what the service accepts.
        device: where the networks run.
        text: the JSON document as it came: also the gripper, and each network's card and configuration.
    """

    models: tuple[ModelIdentity, ...]
    frame_conventions: tuple[str, ...]
    limits: Limits
    device: str
    text: str

    def __reduce__(self) -> tuple[Any, ...]:
        return model_reply, (Answer(200, {}, self.text.encode()),)

    def to_dict(self) -> dict[str, Any]:
        """The JSON document as it came, as a fresh dictionary."""
        document: dict[str, Any] = json.loads(self.text)
        return document


def grasp_reply(answer: Answer) -> GraspReply:
    """The grasps of a 200 answer.

    Raises:
        UnexpectedResponse: the body is not the service's grasp document.
    """
    document = _document(schemas.GraspResponse, answer)
    try:
        grasps = tuple(
            Grasp(
                score=item.score,
                pose=Pose.from_matrix(item.matrix),
                hand_pose=Pose.from_quaternion(item.hand_pose.quaternion_xyzw, item.hand_pose.position),
                pregrasp=Pose.from_quaternion(item.pregrasp.quaternion_xyzw, item.pregrasp.position),
                width=item.width,
                approach_point=np.array(item.approach_point),
                contact_point=np.array(item.contact_point),
            )
            for item in document.grasps
        )
    except ValueError as error:
        raise _unexpected(answer, f"a grasp is no rigid pose: {error}") from error
    try:
        gripper = None if document.gripper is None else _gripper(document.gripper)
    except ValueError as error:
        raise _unexpected(answer, f"its gripper is no hand: {error}") from error
    counts, size = document.counts, len(grasps)
    return GraspReply(
        grasps=grasps,
        scores=_frozen([grasp.score for grasp in grasps], (size,)),
        poses=_frozen([grasp.pose.matrix for grasp in grasps], (size, 4, 4)),
        hand_poses=_frozen([grasp.hand_pose.matrix for grasp in grasps], (size, 4, 4)),
        pregrasps=_frozen([grasp.pregrasp.matrix for grasp in grasps], (size, 4, 4)),
        widths=_frozen([grasp.width for grasp in grasps], (size,)),
        approach_points=_frozen([grasp.approach_point for grasp in grasps], (size, 3)),
        contact_points=_frozen([grasp.contact_point for grasp in grasps], (size, 3)),
        counts=Counts(
            points=counts.points,
            prepared_points=counts.prepared_points,
            candidates=counts.candidates,
            collision_free=counts.collision_free,
            returned=counts.returned,
            rejected=MappingProxyType(counts.rejected.model_dump()),
            ignored_points=counts.ignored_points,
        ),
        reason=document.reason,
        warnings=tuple(document.warnings),
        timings_ms=MappingProxyType(document.timings_ms.model_dump()),
        model=_identity(document.model),
        request_id=document.request_id,
        text=answer.body.decode(),
        gripper=gripper,
    )


def _gripper(told: schemas.GripperOut) -> Gripper:
    sizes = told.model_dump(exclude={"name", "parts"}, exclude_none=True)
    return replace(PANDA.with_sizes(sizes), name=told.name)


def model_reply(answer: Answer) -> ModelReply:
    """The service's description of itself from a 200 answer.

    Raises:
        UnexpectedResponse: the body is not the service's model document.
    """
    document = _document(schemas.ModelResponse, answer)
    return ModelReply(
        models=tuple(_identity(model) for model in document.models),
        frame_conventions=tuple(document.frame_conventions),
        limits=Limits(**document.limits.model_dump()),
        device=document.device,
        text=answer.body.decode(),
    )


def problem(answer: Answer) -> ProblemError | ServiceUnreachable | UnexpectedResponse:
    """The error that an answer other than 200 stands for.

    A proxy before the service answers in its own words; where its status is one that the service uses, it is the same
    kind of problem, and one that lost the service on its way leaves it unreachable. Any other answer that is no problem
    document is an `UnexpectedResponse`.
    """
    retry_after = _seconds(answer.headers.get("retry-after"))
    request_id = answer.headers.get("x-request-id")
    try:
        document = schemas.Problem.model_validate_json(answer.body)
    except ValidationError:
        if answer.status in STATUSES_OF_LOST_SERVICES:
            why = "without a problem document, as proxies answer when they have lost the service behind them"
            return ServiceUnreachable(f"status {answer.status} {why}")
        if answer.status not in STATUSES_OF_PROXIES:
            return _unexpected(answer, "it is no problem document")
        title = HTTPStatus(answer.status).phrase
        detail = "answered without a problem document, so probably by a proxy before the service; look at the proxy"
        return problem_class(answer.status)(answer.status, title, detail, request_id, None, retry_after)
    if document.status != answer.status:
        return _unexpected(answer, f"its problem document says status {document.status}")
    return problem_class(answer.status)(
        answer.status, document.title, document.detail, document.request_id, json.loads(answer.body), retry_after
    )


def _document(kind: type[Document], answer: Answer) -> Document:
    try:
        return kind.model_validate_json(answer.body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the body"
        raise _unexpected(answer, f"{where}: {first['msg']}") from error


def _unexpected(answer: Answer, why: str) -> UnexpectedResponse:
    kind = answer.headers.get("content-type", "no content type")
    return UnexpectedResponse(
        f"the answer (status {answer.status}, {kind}, {len(answer.body)} bytes) is not the grasp service's: {why}; "
        "check the URL, and that client and service have the same version",
        answer.status,
    )


def _identity(model: schemas.ModelIdentity) -> ModelIdentity:
    return ModelIdentity(name=model.name, version=model.version, weights_sha256=model.weights_sha256)


def _seconds(retry_after: str | None) -> float | None:
    """Seconds from a Retry-After header (RFC 9110, 10.2.3): a number of them or a date; None where it is neither."""
    if retry_after is None:
        return None
    if retry_after.strip().isdecimal():
        return float(retry_after)
    try:
        date = email.utils.parsedate_to_datetime(retry_after)
    except ValueError:
        return None
    aware = date if date.tzinfo else date.replace(tzinfo=timezone.utc)
    return max((aware - datetime.now(timezone.utc)).total_seconds(), 0.0)


def _frozen(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(values, dtype=np.float64).reshape(shape)
    array.setflags(write=False)
    return array
