"""Predictions -> response bodies, as `service.schemas` describes them but without building its models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.schemas import GraspOptions
from tesnet.geometry import quaternions_xyzw
from tesnet.result import GraspResult

if TYPE_CHECKING:
    from tesnet.predictor import ModelInfo


def encode_answer(
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
    counts = result.counts
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
        "frame": "cloud",
        "model": {"name": model.name, "version": model.version, "weights_sha256": model.weights_sha256},
        "counts": {
            "points": counts.points,
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
    }
    return msgspec.json.encode(document)


def _pose_fields(poses: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Position and quaternion of each of (M, 4, 4) poses."""
    positions = poses[:, :3, 3].tolist()
    quaternions = quaternions_xyzw(poses[:, :3, :3]).tolist()
    return [{"position": p, "quaternion_xyzw": q} for p, q in zip(positions, quaternions, strict=True)]
