"""What one asks of the predictor: a point cloud and what is wanted of its grasps, checked once at this edge.

What the service sees to by itself, such as `frame_convention`, is no part of it. numpy only.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tesnet.errors import InvalidQuery
from tesnet.geometry import PANDA, WIDEST, Box, Gripper

MAX_GRASPS = 1000
MAX_APPROACH_POINTS = 1024
MAX_CANDIDATES = 20_000
LARGE_HAND = 0.25
MAX_CANDIDATES_OF_LARGE_HANDS = 1_000
"""Of a hand with a part longer than `LARGE_HAND`, metres, and so than any known hand: what it may meet takes long."""
MAX_VIEWPOINTS = 64
MAX_SEED = 2**63 - 1
MAX_DIAGONAL = 20.0
"""Metres; a cloud whose central 90 % spans more was not given in metres."""
MAX_DISTANCE = 1e9
"""Metres from the origin at which viewpoints, support planes and most of a cloud still count as given in metres."""
FAR = 64.0
"""Metres from the origin from which on float32 rounds coordinates by 4 micrometres or more."""
NO_VIEWPOINT = "viewpoint not given: the camera is taken to be at the origin of the cloud frame"
_SPAN_SAMPLE = 1_000_000
"""Of larger clouds the span is that of every n-th point, about so many."""


Target: TypeAlias = Box | NDArray[np.bool_]
"""Where to grasp: a box, or a mask (N,) of the query's points."""


@dataclass(frozen=True, eq=False, slots=True)
class GraspQuery:
    """A point cloud and what is wanted of its grasps; the defaults are those of the HTTP interface.

    A cloud of float64 over 64 m from the origin would lose its detail in float32. Where `origin` is left out, the
    middle of such a cloud becomes the origin, and everything that is given here is moved along with it. So a query
    lies in one frame near the cloud, and its answers are moved back to that of the caller.

    Args:
        points: (N, 3) metres; stored as float32.
        viewpoints: (3,) or (V, 3) camera positions in the cloud frame; None is the origin.
        up: (3,) direction against gravity, made unit length, or `auto`: that of the plane that things stand on, whose
            height is found as well.
        workspace: points outside count for collision alone; with `up`, scores allow for what may stand beyond its
            upright sides.
        support_height: height of the support plane along `up`, metres, or `auto` to find that which things stand on.
        target: candidates come from it alone; the other points still count for collision.
        approach: cone of directions of travel.
        max_grasps, min_score: how many to return, and the least score.
        separation_translation, separation_rotation_deg: grasps nearer than both to a better one are dropped.
        num_approach_points, max_candidates: search effort.
        gripper: the hand, which opens no wider than `WIDEST`.
        unseen: whether the shadow behind observed points counts as `free` or `occupied`.
        width: whether the hand arrives open by what lies between its fingers and a margin, or all it can; None is
            `opening_policy`'s choice.
        seed: makes sampling repeatable.
        model: the network that shall answer, where several are loaded; None for the first of them.
        view_index: (N,) which of the viewpoints saw each point, from 0; turns normals.
        normals: (N, 3) outward, of any length, a row of zeros where there is none; turn ours.
        calibrate: whether each view's depth scale and a small tilt are solved from the support that it sees.
        origin: (3,) of this query's frame in that of the caller, whose axes are the same; None where they are one.
        image_scale: whether that of the depth image whose points these are is likely to be right; None for points of
            others, whose unit is still to be judged.
        ignored_points: how many were posted that are not finite and not among `points`.
        notes: what the caller is to be told about how these points came to be.

    Raises:
        InvalidQuery: names the field and gives the value, the limit and the remedy.
    """

    points: NDArray[np.float32]
    viewpoints: NDArray[np.float64] | None = None
    up: NDArray[np.float64] | Literal["auto"] | None = None
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
    width: Literal["fitted", "full"] | None = None
    seed: int = 0
    model: str | None = None
    view_index: NDArray[np.uint8] | None = None
    normals: NDArray[np.float32] | None = None
    calibrate: bool = False
    origin: NDArray[np.float64] | None = None
    image_scale: Literal["likely", "unlikely"] | None = None
    ignored_points: int = 0
    notes: tuple[str, ...] = ()

    @property
    def known_up(self) -> NDArray[np.float64] | None:
        """`up` (3,), or None where it is not given or still to be found."""
        return None if isinstance(self.up, str) else self.up

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays that grow with the cloud."""
        arrays = (self.points, self.target, self.view_index, self.normals)
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def __post_init__(self) -> None:
        self._check_options()
        self._take_points()
        self._take_what_belongs_to_points()

    def but(self, **options: Any) -> GraspQuery:
        """This query with other options, which are checked; its points, which have been, are shared."""
        other = copy(self)
        for name, value in options.items():
            object.__setattr__(other, name, value)
        other._check_options()  # noqa: SLF001
        return other

    def _check_options(self) -> None:
        if self.viewpoints is not None:
            object.__setattr__(self, "viewpoints", _viewpoints(self.viewpoints))
        if isinstance(self.up, str):
            if self.up != "auto":
                raise InvalidQuery("up", f"is {self.up!r}; give a direction x, y, z, or auto")
        elif self.up is not None:
            object.__setattr__(self, "up", _direction("up", self.up))
        if self.support_height is not None:
            if self.up is None:
                raise InvalidQuery("support_height", "needs `up`: a height is measured along it; give `up` as well")
            if self.support_height != "auto" and isinstance(self.up, str):
                raise InvalidQuery("support_height", "is measured along `up`, which is auto; give both, or neither")
            if self.support_height != "auto":
                _in_range("support_height", self.support_height, -MAX_DISTANCE, MAX_DISTANCE, " m, or be auto")
                object.__setattr__(self, "support_height", float(self.support_height))
        for name, kind in (("workspace", Box), ("approach", ApproachCone)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InvalidQuery(name, f"is of type {type(value).__name__}; give a {kind.__name__} or None")
        _check_gripper(self.gripper)
        _whole_in_range("max_grasps", self.max_grasps, 1, MAX_GRASPS)
        _in_range("min_score", self.min_score, 0, 1)
        _in_range("min_separation", self.separation_translation, 0, 1, " m")
        _in_range("min_separation", self.separation_rotation_deg, 0, 180, " degrees")
        _whole_in_range("num_approach_points", self.num_approach_points, 1, MAX_APPROACH_POINTS)
        _whole_in_range("max_candidates", self.max_candidates, 1, MAX_CANDIDATES)
        _whole_in_range("seed", self.seed, 0, MAX_SEED)
        _one_of("unseen", self.unseen, "free", "occupied")
        _one_of("width", self.opening_policy, "fitted", "full")
        _one_of("calibrate", self.calibrate, True, False)

    @property
    def opening_policy(self) -> Literal["fitted", "full"]:
        """How far the hand opens: `full` unless asked, but `fitted` where closing swings the tips along the travel.

        The RG2's tips advance by 44 mm from wide open to closed, and push away what they shall hold.
        """
        if self.width is not None:
            return self.width
        return "full" if self.gripper.linkage_length is None else "fitted"

    @property
    def candidate_limit(self) -> int:
        """How many candidates this hand may have, and so `max_candidates` mean at most."""
        lengths = (size for name, size in self.gripper.sizes().items() if name != "hand_yaw" and size is not None)
        return MAX_CANDIDATES_OF_LARGE_HANDS if max(lengths) > LARGE_HAND else MAX_CANDIDATES

    @property
    def most_candidates(self) -> int:
        """How many candidates are looked for."""
        return min(self.max_candidates, self.candidate_limit)

    @property
    def offset(self) -> NDArray[np.float64]:
        """(3,) what moves positions of this query to the frame of the caller: `origin`, or zero."""
        return np.zeros(3) if self.origin is None else self.origin

    def _take_what_belongs_to_points(self) -> None:
        count = len(self.points)
        if self.target is not None and not isinstance(self.target, Box):
            object.__setattr__(self, "target", _mask(self.target, count))
        if self.view_index is not None:
            viewpoints = 1 if self.viewpoints is None else len(self.viewpoints)
            object.__setattr__(self, "view_index", _view_index(self.view_index, count, viewpoints))
        if self.normals is not None:
            object.__setattr__(self, "normals", _normals(self.normals, count))

    def _take_points(self) -> None:
        """Keep the points as float32, near the origin; where that is chosen here, move what else has a place."""
        if self.origin is not None:
            object.__setattr__(self, "origin", _vector("origin", self.origin, (3,)))
            object.__setattr__(self, "points", _cloud(self.points, np.zeros(3)))
            return
        origin = _middle(self.points)
        object.__setattr__(self, "points", _cloud(self.points, origin))
        if origin.any():
            origin.setflags(write=False)
            object.__setattr__(self, "origin", origin)
            self._move(origin)

    def _move(self, origin: NDArray[np.float64]) -> None:
        """Tell positions from a new origin."""
        if self.viewpoints is None:
            object.__setattr__(self, "notes", (*self.notes, NO_VIEWPOINT))
        for name in ("workspace", "target"):
            box = getattr(self, name)
            if isinstance(box, Box):
                object.__setattr__(self, name, Box(box.minimum - origin, box.maximum - origin))
        object.__setattr__(
            self, "viewpoints", (np.zeros((1, 3)) if self.viewpoints is None else self.viewpoints) - origin
        )
        if isinstance(self.support_height, float) and self.known_up is not None:
            object.__setattr__(self, "support_height", self.support_height - float(self.known_up @ origin))


def _viewpoints(given: ArrayLike) -> NDArray[np.float64]:
    array = _numbers("viewpoint", given)
    viewpoints = _vector("viewpoint", array[None] if array.ndim == 1 else array, (-1, 3))
    if not 1 <= len(viewpoints) <= MAX_VIEWPOINTS:
        raise InvalidQuery("viewpoint", f"has {len(viewpoints)} positions; give 1 to {MAX_VIEWPOINTS}")
    _in_range("viewpoint", float(np.abs(viewpoints).max()), 0, MAX_DISTANCE, " m from the origin")
    return viewpoints


def _view_index(given: ArrayLike, count: int, viewpoints: int) -> NDArray[np.uint8]:
    index = np.asarray(given)
    if index.dtype.kind not in "iu" or index.shape != (count,):
        raise InvalidQuery(
            "view_index",
            f"is an array of {index.dtype} of shape {index.shape}; give a whole number for each of the {count} points",
        )
    if count and not 0 <= index.min() <= index.max() < viewpoints:
        raise InvalidQuery(
            "view_index",
            f"reaches from {index.min()} to {index.max()}, but there are {viewpoints} viewpoints; count them from 0",
        )
    array = index.astype(np.uint8)
    array.setflags(write=False)
    return array


def _normals(given: ArrayLike, count: int) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is refused below
        array = np.array(_numbers("normals", given), dtype=np.float32)
    if array.shape != (count, 3):
        raise InvalidQuery("normals", f"have shape {array.shape}; give x, y, z for each of the {count} points")
    if not np.isfinite(array).all():
        raise InvalidQuery("normals", "hold NaN or an infinity; give zeros where there is no normal")
    array.setflags(write=False)
    return array


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


def _middle(points: ArrayLike) -> NDArray[np.float64]:
    """(3,) origin of the frame in which points are kept: zero, unless float32 would blur what is more precise."""
    array = _numbers("points", points)
    if array.dtype == np.float32 or array.ndim != 2 or array.shape[1:] != (3,) or not len(array):
        return np.zeros(3)
    middle = np.median(array[:: 1 + len(array) // _SPAN_SAMPLE], axis=0).astype(np.float64).round()
    return middle if FAR <= np.abs(middle).max() <= MAX_DISTANCE else np.zeros(3)


def _cloud(points: ArrayLike, origin: NDArray[np.float64]) -> NDArray[np.float32]:
    given = _numbers("points", points)
    if given.ndim != 2 or given.shape[1] != 3:
        raise InvalidQuery("points", f"have shape {given.shape}; give an array of N x 3: x, y, z in metres")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is infinite, and refused below
        array = np.array(given - origin if origin.any() else given, dtype=np.float32)
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        raise InvalidQuery(
            "points",
            f"{np.count_nonzero(~finite)} of {len(array)} are NaN or infinite; remove them (a camera marks missing "
            "depth so)",
        )
    if len(array):
        diagonal = span(array)
        if diagonal > MAX_DIAGONAL:
            raise InvalidQuery(
                "points",
                f"span {diagonal:.0f} m (diagonal of the central 90 %; limit {MAX_DIAGONAL:g} m); "
                "coordinates must be in metres: divide millimetres by 1000, centimetres by 100, inches by 39.37",
            )
        if np.abs(array).max() > MAX_DISTANCE and (far := _farthest_middle(array)) > MAX_DISTANCE:
            raise InvalidQuery(
                "points",
                f"lie {far:.3g} m from the origin (limit {MAX_DISTANCE:g} m); send metres, in a frame near them",
            )
    array.setflags(write=False)
    return array


def _farthest_middle(points: NDArray[np.float32]) -> float:
    """The largest coordinate, either way, of the median of points (N, 3)."""
    return float(np.abs(np.median(points.astype(np.float64), axis=0)).max())


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


def _one_of(field: str, value: Any, *valid: Any) -> None:
    if value not in valid:
        raise InvalidQuery(field, f"is {value!r}; valid: {', '.join(map(str, valid))}")


def _whole_in_range(field: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, (int, np.integer)) or not low <= value <= high:
        shown = value if isinstance(value, (int, float, np.number)) else f"of type {type(value).__name__}"
        raise InvalidQuery(field, f"is {shown}; it must be a whole number between {low} and {high}")


def span(points: NDArray[Any]) -> float:
    """Metres: the diagonal of the box that holds the central 90 % of points (N, 3) on each axis."""
    sample = points[:: 1 + len(points) // _SPAN_SAMPLE]
    low, high = np.percentile(sample, [5, 95], axis=0, method="nearest").astype(np.float64)
    return float(np.linalg.norm(high - low))
