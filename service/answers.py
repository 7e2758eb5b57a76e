"""Predictions -> response bodies in the formats that a client may ask for; `service.schemas` describes them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import NotAcceptable, shortened
from service.hands import described
from service.schemas import GraspOptions
from tesnet.geometry import quaternions_xyzw
from tesnet.result import GraspResult

if TYPE_CHECKING:
    from tesnet.predictor import ModelInfo

JSON = "application/json"
NPZ = "application/x-npz"

Encode = Callable[[GraspResult, GraspOptions, "ModelInfo", Mapping[str, float], str], bytes]
"""result, options, network, milliseconds by stage, request id -> body"""


@dataclass(frozen=True, slots=True)
class Encoder:
    """How an answer is written."""

    content_type: str
    encode: Encode


def encode_json(
    result: GraspResult, options: GraspOptions, model: ModelInfo, timings_ms: Mapping[str, float], request_id: str
) -> bytes:
    """The JSON of a `service.schemas.GraspResponse`."""
    grasps = result.grasps
    poses = grasps.in_convention(options.frame_convention)
    columns = zip(
        grasps.scores.tolist(),
        _pose_fields(poses),
        poses.tolist(),
        _pose_fields(grasps.hand_poses),
        _pose_fields(grasps.pregrasps(options.pregrasp_distance)),
        grasps.widths.tolist(),
        grasps.approach_points.tolist(),
        grasps.contact_points.tolist(),
        strict=True,
    )
    document = {
        "grasps": [
            {
                "score": score,
                **pose,
                "matrix": matrix,
                "hand_pose": hand_pose,
                "pregrasp": pregrasp,
                "width": width,
                "approach_point": approach_point,
                "contact_point": contact_point,
            }
            for score, pose, matrix, hand_pose, pregrasp, width, approach_point, contact_point in columns
        ],
        **_meta(result, model, timings_ms, request_id),
    }
    return msgspec.json.encode(document)


def encode_npz(
    result: GraspResult, options: GraspOptions, model: ModelInfo, timings_ms: Mapping[str, float], request_id: str
) -> bytes:
    """A .npz of one array a field, rows being grasps; `meta` is the rest of the JSON document, as text."""
    file = io.BytesIO()
    meta = answer_meta(result, model, timings_ms, request_id)
    np.savez(file, allow_pickle=False, meta=np.array(meta.decode()), **answer_arrays(result, options))
    return file.getvalue()


def answer_arrays(result: GraspResult, options: GraspOptions) -> dict[str, NDArray[np.float64]]:
    """The grasps as arrays by name, rows being grasps."""
    grasps = result.grasps
    return {
        "scores": grasps.scores,
        "poses": grasps.in_convention(options.frame_convention),
        "hand_poses": grasps.hand_poses,
        "pregrasps": grasps.pregrasps(options.pregrasp_distance),
        "widths": grasps.widths,
        "approach_points": grasps.approach_points,
        "contact_points": grasps.contact_points,
    }


def answer_meta(result: GraspResult, model: ModelInfo, timings_ms: Mapping[str, float], request_id: str) -> bytes:
    """Everything but the grasps, as JSON."""
    return msgspec.json.encode(_meta(result, model, timings_ms, request_id))


ENCODERS = (Encoder(JSON, encode_json), Encoder(NPZ, encode_npz))
"""What clients may ask for; the first is the default."""


def encoder_for(accept: Iterable[str]) -> Encoder:
    """The encoder that the Accept headers rank highest (RFC 9110, 12.5.1); no header accepts everything.

    Of equal ranks the one that is named more precisely wins, then JSON.

    Raises:
        NotAcceptable: none of them.
    """
    text = ", ".join(accept).strip()
    if not text:
        return ENCODERS[0]
    ranges = [_media_range(part) for part in text.split(",") if part.strip()]
    ranked = [(*_rank(encoder.content_type, ranges), -order) for order, encoder in enumerate(ENCODERS)]
    best = max(ranked)
    if best[0] <= 0:
        raise NotAcceptable(
            f"Accept {shortened(text)} takes none of the formats there are: "
            f"{', '.join(encoder.content_type for encoder in ENCODERS)}; name one of them, or */*."
        )
    return ENCODERS[-best[2]]


def _media_range(part: str) -> tuple[str, float]:
    """A media range in lower case, and its weight, which is 1 where none can be read."""
    name, *parameters = (piece.strip().lower() for piece in part.split(";"))
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return name, min(max(float(parameter[2:]), 0.0), 1.0)
            except ValueError:
                break
    return name, 1.0


def _rank(content_type: str, ranges: list[tuple[str, float]]) -> tuple[float, int]:
    """Weight of a content type, which its most precise range gives, and that range's precision."""
    patterns = ("*/*", f"{content_type.partition('/')[0]}/*", content_type)
    matches = [(patterns.index(name), weight) for name, weight in ranges if name in patterns]
    precision, weight = max(matches, default=(-1, 0.0))
    return weight, precision


def _meta(result: GraspResult, model: ModelInfo, timings_ms: Mapping[str, float], request_id: str) -> dict[str, Any]:
    """Everything but the grasps."""
    counts = result.counts
    return {
        "frame": "cloud",
        "model": {"name": model.name, "version": model.version, "weights_sha256": model.weights_sha256},
        "counts": {
            "points": counts.points,
            "ignored_points": counts.ignored_points,
            "prepared_points": counts.prepared_points,
            "candidates": counts.candidates,
            "collision_free": counts.collision_free,
            "returned": counts.returned,
            "rejected": dict(counts.rejected),
        },
        "reason": result.reason,
        "warnings": list(result.warnings),
        "timings_ms": {stage: round(milliseconds, 3) for stage, milliseconds in timings_ms.items()},
        "request_id": request_id,
        "gripper": described(result.grasps.gripper),
    }


def _pose_fields(poses: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Position and quaternion of each of (M, 4, 4) poses."""
    positions = poses[:, :3, 3].tolist()
    quaternions = quaternions_xyzw(poses[:, :3, :3]).tolist()
    return [{"position": p, "quaternion_xyzw": q} for p, q in zip(positions, quaternions, strict=True)]
