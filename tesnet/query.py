"""What one asks of the predictor: a point cloud and what is wanted of its grasps, checked once at this edge.

What the service sees to by itself, such as `frame_convention`, is no part of it. numpy only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tesnet.errors import InvalidQuery
from tesnet.geometry import PANDA, WIDEST, Box, Gripper

MAX_GRASPS = 1000
MAX_APPROACH_POINTS = 1024
MAX_CANDIDATES = 20_000
MAX_VIEWPOINTS = 64
MAX_SEED = 2**63 - 1
MAX_DIAGONAL = 20.0
"""Metres; a cloud whose central 90 % spans more was not given in metres."""
MAX_DISTANCE = 1e9
"""Metres from the origin at which viewpoints and support planes still count as given in metres."""


Target: TypeAlias = Box | NDArray[np.bool_]
"""Where to grasp: a box, or a mask (N,) of the query's points."""


@dataclass(frozen=True, eq=False, slots=True)
class GraspQuery:
    """A point cloud and what is wanted of its grasps; the defaults are those of the HTTP interface.

    Args:
        points: (N, 3) metres; stored as float32.
        viewpoints: (3,) or (V, 3) camera positions in the cloud frame; None is the origin.
        up: (3,) direction against gravity, made unit length.
        workspace: points outside are ignored; with `up`, scores allow for what may stand beyond its upright sides.
        support_height: height of the support plane along `up`, metres, or `auto` to find the dominant plane.
        target: candidates come from it alone; the other points still count for collision.
        approach: cone of directions of travel.
        max_grasps, min_score: how many to return, and the least score.
        separation_translation, separation_rotation_deg: grasps nearer than both to a better one are dropped.
        num_approach_points, max_candidates: search effort.
        gripper: the hand, which opens no wider than `WIDEST`.
        unseen: whether the shadow behind observed points counts as `free` or `occupied`.
        seed: makes sampling repeatable.
        model: the network that shall answer, where several are loaded; None for the first of them.

    Raises:
        InvalidQuery: names the field and gives the value, the limit and the remedy.
    """

    points: NDArray[np.float32]
    viewpoints: NDArray[np.float64] | None = None
    up: NDArray[np.float64] | None = None
    workspace: Box | None = None
    support_height: float | Literal["auto"] | None = None
    target: Target | None = None
    approach: ApproachCone | None = None
    max_grasps: int = 10
    min_score: float = 0.0
    separation_translation: float = 0.01
    separation_rotation_deg: float = 15.0
    num_approach_points: int = 32
    max_candidates: int = 2000
    gripper: Gripper = PANDA
    unseen: Literal["free", "occupied"] = "free"
    seed: int = 0
    model: str | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays that grow with the cloud."""
        return self.points.nbytes + (self.target.nbytes if isinstance(self.target, np.ndarray) else 0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _cloud(self.points))
        if self.viewpoints is not None:
            array = _numbers("viewpoint", self.viewpoints)
            viewpoints = _vector("viewpoint", array[None] if array.ndim == 1 else array, (-1, 3))
            object.__setattr__(self, "viewpoints", viewpoints)
            if not 1 <= len(viewpoints) <= MAX_VIEWPOINTS:
                raise InvalidQuery("viewpoint", f"has {len(viewpoints)} positions; give 1 to {MAX_VIEWPOINTS}")
            farthest = float(np.abs(viewpoints).max())
            _in_range("viewpoint", farthest, 0, MAX_DISTANCE, " m from the origin")
        if self.up is not None:
            object.__setattr__(self, "up", _direction("up", self.up))
        if self.support_height is not None:
            if self.up is None:
                raise InvalidQuery("support_height", "needs `up`: a height is measured along it; give `up` as well")
            if self.support_height != "auto":
                _in_range("support_height", self.support_height, -MAX_DISTANCE, MAX_DISTANCE, " m, or be auto")
                object.__setattr__(self, "support_height", float(self.support_height))
        if self.target is not None and not isinstance(self.target, Box):
            object.__setattr__(self, "target", _mask(self.target, len(self.points)))
        _check_gripper(self.gripper)
        for name, kind in (("workspace", Box), ("approach", ApproachCone)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InvalidQuery(name, f"is of type {type(value).__name__}; give a {kind.__name__} or None")
        _whole_in_range("max_grasps", self.max_grasps, 1, MAX_GRASPS)
        _in_range("min_score", self.min_score, 0, 1)
        _in_range("min_separation", self.separation_translation, 0, 1, " m")
        _in_range("min_separation", self.separation_rotation_deg, 0, 180, " degrees")
        _whole_in_range("num_approach_points", self.num_approach_points, 1, MAX_APPROACH_POINTS)
        _whole_in_range("max_candidates", self.max_candidates, 1, MAX_CANDIDATES)
        _whole_in_range("seed", self.seed, 0, MAX_SEED)
        if self.unseen not in ("free", "occupied"):
            raise InvalidQuery("unseen", f"is {self.unseen!r}; valid: free, occupied")


@dataclass(frozen=True, eq=False, slots=True)
class ApproachCone:
    """Directions of travel that are wanted: within `max_angle_deg` of `direction` (cloud frame, made unit length)."""

    direction: NDArray[np.float64]
    max_angle_deg: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _direction("approach", self.direction))
        _in_range("approach", self.max_angle_deg, 0, 180, " degrees")


def box_option(name: str, minimum: ArrayLike, maximum: ArrayLike) -> Box:
    """The box between two corners (3,) that the option `name` gives.

    Raises:
        InvalidQuery: these are no corners of a box; the field is the option.
    """
    try:
        return Box(np.asarray(minimum), np.asarray(maximum))
    except ValueError as error:
        raise InvalidQuery(name, str(error)) from None


def _check_gripper(gripper: Any) -> None:
    if not isinstance(gripper, Gripper):
        raise InvalidQuery("gripper", f"is of type {type(gripper).__name__}; give a Gripper")
    if gripper.max_width > WIDEST:
        raise InvalidQuery(
            "gripper",
            f"opens {gripper.max_width:g} m (limit {WIDEST:g} m); give a max_width up to it, and open no wider",
        )


def _cloud(points: ArrayLike) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is refused below
        array = np.array(_numbers("points", points), dtype=np.float32)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InvalidQuery("points", f"have shape {array.shape}; give an array of N x 3: x, y, z in metres")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array).all(axis=1)).sum())
        raise InvalidQuery(
            "points", f"{bad} of {len(array)} are NaN or infinite; remove them (a camera marks missing depth so)"
        )
    if len(array):
        low, high = np.percentile(array, [5, 95], axis=0, method="nearest").astype(np.float64)
        diagonal = float(np.linalg.norm(high - low))
        if diagonal > MAX_DIAGONAL:
            raise InvalidQuery(
                "points",
                f"span {diagonal:.0f} m (diagonal of the central 90 %; limit {MAX_DIAGONAL:g} m); "
                "coordinates must be in metres: divide millimetres by 1000",
            )
    array.setflags(write=False)
    return array


def _vector(field: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(_numbers(field, value), dtype=np.float64)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("N" if size == -1 else str(size) for size in shape)
        raise InvalidQuery(field, f"has shape {array.shape}; give an array of {wanted}")
    if not np.isfinite(array).all():
        raise InvalidQuery(field, "holds NaN or an infinity; every coordinate must be finite, remove such values")
    array.setflags(write=False)
    return array


def _direction(field: str, value: ArrayLike) -> NDArray[np.float64]:
    array = _vector(field, value, (3,))
    length = math.hypot(*array)  # of what overflows, too
    if not 1e-6 < length < 1e6:
        raise InvalidQuery(field, f"has length {length:g}; give a direction whose length is between 1e-6 and 1e6")
    direction = array / length
    direction.setflags(write=False)
    return direction


def _numbers(field: str, value: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "biuf":
        raise InvalidQuery(field, "is no array of real numbers; give x, y, z in metres")
    return array


def _mask(target: ArrayLike, count: int) -> NDArray[np.bool_]:
    mask = np.array(target)
    if mask.dtype != np.bool_ or mask.shape != (count,):
        raise InvalidQuery(
            "target", f"is an array of {mask.dtype} of shape {mask.shape}; give a Box, or a mask of the {count} points"
        )
    mask.setflags(write=False)
    return mask


def _in_range(field: str, value: Any, low: float, high: float, unit: str = "") -> None:
    if not isinstance(value, (int, float, np.number)):
        raise InvalidQuery(
            field, f"is of type {type(value).__name__}; give a number between {low:g} and {high:g}{unit}"
        )
    if not low <= value <= high:
        raise InvalidQuery(field, f"is {value:g}; it must lie between {low:g} and {high:g}{unit}")


def _whole_in_range(field: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, (int, np.integer)) or not low <= value <= high:
        shown = value if isinstance(value, (int, float, np.number)) else f"of type {type(value).__name__}"
        raise InvalidQuery(field, f"is {shown}; it must be a whole number between {low} and {high}")
