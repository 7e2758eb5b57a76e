"""A payload and checked options -> the predictor's `GraspQuery`. Query strings are `options`' business."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid
from service.hands import gripper_of
from service.payloads.payload import Payload
from service.schemas import GraspOptions
from tesnet.query import ApproachCone, GraspQuery, Target, box_option


def build_query(payload: Payload, options: GraspOptions) -> GraspQuery:
    """The predictor's query.

    Raises:
        InvalidQuery: what only the library can judge: NaN, not metres, empty boxes.
        Invalid: a target or a gripper that does not fit.
    """
    workspace = options.workspace
    approach = options.approach
    viewpoints = payload.viewpoint if options.viewpoint is None else np.array(options.viewpoint, dtype=np.float64)
    return GraspQuery(
        points=payload.points,
        viewpoints=None if viewpoints is None else viewpoints.reshape(-1, 3),
        up=None if options.up is None else np.array(options.up),
        workspace=None if workspace is None else box_option("workspace", workspace.min, workspace.max),
        support_height=options.support_height,
        target=_target(payload, options),
        approach=None if approach is None else ApproachCone(np.array(approach.direction), approach.max_angle_deg),
        max_grasps=options.max_grasps,
        min_score=options.min_score,
        separation_translation=options.min_separation.translation,
        separation_rotation_deg=options.min_separation.rotation_deg,
        num_approach_points=options.num_approach_points,
        max_candidates=options.max_candidates,
        gripper=gripper_of(options.gripper),
        unseen=options.unseen,
        seed=options.seed,
        model=options.model,
    )


def _target(payload: Payload, options: GraspOptions) -> Target | None:
    target = options.target
    if payload.mask is not None:
        if target is not None:
            raise Invalid("target", "is given beside the file `mask`, which is a target too; give one of them")
        return _of_points(payload.mask, payload)
    if target is None:
        return None
    if target.box is not None:
        return box_option("target", target.box.min, target.box.max)
    rows = len(payload.points) if payload.is_point is None else len(payload.is_point)
    indices = np.asarray(target.indices, dtype=np.int64)
    largest = int(indices.max(initial=-1))
    if largest >= rows:
        raise Invalid("target", f"has the index {largest}, but {rows} points or pixels were posted; count from 0")
    mask = np.zeros(rows, dtype=bool)
    mask[indices] = True
    return _of_points(mask, payload)


def _of_points(mask: NDArray[np.bool_], payload: Payload) -> NDArray[np.bool_]:
    """The mask (N,) of points for a mask (R,) of what was posted."""
    return mask if payload.is_point is None else mask[payload.is_point]
