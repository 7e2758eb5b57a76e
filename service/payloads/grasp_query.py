"""Points and checked options -> the predictor's query."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service import schemas
from service.errors import Invalid
from service.hands import gripper_of
from service.payloads.payload import Payload
from service.schemas import GraspOptions
from tesnet.errors import TooManyPoints
from tesnet.query import ApproachCone, GraspQuery, Target, box_option


def build_query(payload: Payload, options: GraspOptions, max_points: int | None = None) -> GraspQuery:
    """The predictor's query.

    Args:
        payload: the points.
        options: what is asked.
        max_points: how many of the points may matter: lie in the workspace and, where there is a mask, on it.

    Raises:
        TooManyPoints: more of them.
        InvalidQuery: what only the library can judge: NaN, not metres, empty boxes.
        Invalid: a target or a gripper that does not fit.
    """
    target, note = _target(payload, options)
    if max_points is not None and len(payload.points) > max_points:
        _check_count(payload, options, target, max_points)
    workspace = options.workspace
    approach = options.approach
    viewpoints, seen = _viewpoints(payload, options)
    return GraspQuery(
        points=payload.points,
        viewpoints=viewpoints,
        up=_up(payload, options),
        workspace=None if workspace is None else box_option("workspace", workspace.min, workspace.max),
        support_height=options.support_height,
        target=target,
        approach=None if approach is None else ApproachCone(np.array(approach.direction), approach.max_angle_deg),
        max_grasps=options.max_grasps,
        min_score=options.min_score,
        separation_translation=options.min_separation.translation,
        separation_rotation_deg=options.min_separation.rotation_deg,
        num_approach_points=options.num_approach_points,
        max_candidates=options.max_candidates,
        gripper=gripper_of(options.gripper),
        unseen=options.unseen,
        width=options.width,
        calibrate=options.calibrate,
        seed=options.seed,
        model=options.model,
        view_index=_entries("view_index", payload.view_index, payload),
        normals=_entries("normals", payload.normals, payload),
        image_scale=payload.image_scale,
        ignored_points=payload.ignored_points,
        notes=(*payload.notes, *seen, *note),
    )


def _up(payload: Payload, options: GraspOptions) -> NDArray[np.float64] | Literal["auto"] | None:
    """What is given; where nothing is, `up` is found in a camera's image."""
    if options.up is None:
        return None if payload.viewpoint is None else "auto"
    return "auto" if options.up == "auto" else np.array(options.up)


def _viewpoints(payload: Payload, options: GraspOptions) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Where the cameras stood (V, 3), and what is to be said about a viewpoint of the file."""
    of_file = payload.file_viewpoint
    place = None if of_file is None else ", ".join(f"{number:g}" for number in of_file)
    if options.viewpoint is not None:
        given = np.array(options.viewpoint, dtype=np.float64).reshape(-1, 3)
        if of_file is None or (given == of_file).all():
            return given, ()
        return given, (f"the viewpoint [{place}] of the file is ignored, since viewpoint is given",)
    if of_file is not None:
        return of_file[None], (f"viewpoint is that of the file: [{place}]",)
    return (None if payload.viewpoint is None else payload.viewpoint[None]), ()


def _check_count(payload: Payload, options: GraspOptions, target: Target | None, max_points: int) -> None:
    """Raise `TooManyPoints` where more of the points matter than may."""
    matter = np.ones(len(payload.points), dtype=bool)
    if options.workspace is not None:
        low, high = options.workspace.min, options.workspace.max
        for axis in range(3):
            matter &= (payload.points[:, axis] >= low[axis]) & (payload.points[:, axis] <= high[axis])
    if payload.mask is not None and isinstance(target, np.ndarray):
        matter &= target
    count = int(np.count_nonzero(matter))
    if count <= max_points:
        return
    if payload.viewpoint is None:
        raise TooManyPoints(count, max_points)
    coarser = math.ceil(math.sqrt(count / max_points))
    remedy = f"use {coarser} times its `stride`, or give a `workspace` or the `mask` of what to grasp"
    raise TooManyPoints(count, max_points, remedy, "depth")


def _target(payload: Payload, options: GraspOptions) -> tuple[Target | None, tuple[str, ...]]:
    """Where to grasp, and what is to be said about a label that nothing has."""
    target = options.target
    if payload.mask is not None:
        if target is not None and target.label is None:
            raise Invalid("target", "is given beside the file `mask`, which is a target too; give one of them")
        wanted = payload.mask != 0 if target is None else payload.mask == target.label
        return _of_points(wanted, payload), _label_note(target, wanted, payload.mask)
    if target is None:
        return None, ()
    if target.label is not None:
        raise Invalid("target", "has a label, but no file `mask` with labels was posted; send one beside `depth`")
    if target.box is not None:
        return box_option("target", target.box.min, target.box.max), ()
    rows = _rows(payload)
    indices = np.asarray(target.indices, dtype=np.int64)
    largest = int(indices.max(initial=-1))
    if largest >= rows:
        raise Invalid("target", f"has the index {largest}, but {rows} points or pixels were posted; count from 0")
    mask = np.zeros(rows, dtype=bool)
    mask[indices] = True
    return _of_points(mask, payload), ()


def _label_note(target: schemas.Target | None, wanted: NDArray[np.bool_], labels: NDArray[Any]) -> tuple[str, ...]:
    if target is None or wanted.any():
        return ()
    known = np.unique(labels)
    listed = ", ".join(map(str, known[:10].tolist())) + (", ..." if len(known) > 10 else "")
    return (f"target has the label {target.label}, which no pixel of the mask has; labels there: {listed}",)


def _entries(name: str, array: NDArray[Any] | None, payload: Payload) -> NDArray[Any] | None:
    """The entries of the points among those of the posted rows or pixels."""
    if array is None:
        return None
    if len(array) != _rows(payload):
        raise Invalid(name, f"has {len(array)} entries for {_rows(payload)} posted points or pixels; give one for each")
    return array if payload.is_point is None else array[payload.is_point]


def _rows(payload: Payload) -> int:
    """How many points or pixels were posted."""
    return len(payload.points) if payload.is_point is None else len(payload.is_point)


def _of_points(mask: NDArray[np.bool_], payload: Payload) -> NDArray[np.bool_]:
    """The mask (N,) of points for a mask (R,) of what was posted."""
    return mask if payload.is_point is None else mask[payload.is_point]
