"""A caller's arguments -> one HTTP request, as pure functions. Knows the wire, but no HTTP library and no connection.

Points travel as little-endian float32 triples; the options stand in the query string, each value as URL-encoded JSON.
Depth images, and points with more options than fit into a URL, travel in a form.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict
from urllib.parse import quote, urlencode

import numpy as np
from numpy.typing import ArrayLike, NDArray

from client.errors import InvalidArgument
from client.form import File, encode_form
from client.images import depth_counts, mask_levels, png
from service.schemas import REQUEST_ID
from tesnet.formats import NPY
from tesnet.geometry import CameraIntrinsics, Pose
from tesnet.query import FAR

if TYPE_CHECKING:
    from tesnet.geometry import FrameConvention

DEFAULT_DEPTH_SCALE = 0.001
"""Metres per count of a depth image."""

LONGEST_QUERY = 4000
"""Characters of a query string; servers and proxies on the way refuse longer ones, some from 8,000 on."""

Vector: TypeAlias = Sequence[float] | NDArray[Any]
"""x, y, z in the frame of the points."""


class Box(TypedDict):
    """Axis-aligned box in the cloud frame, metres."""

    min: Vector
    max: Vector


class ApproachCone(TypedDict):
    """Directions of travel (+z of the grasp) that are wanted. Top-down is `-up`."""

    direction: Vector
    max_angle_deg: float


class TargetBox(TypedDict):
    """Grasp what lies in a box: approach and contact point are in it."""

    box: Box


class TargetPoints(TypedDict):
    """Grasp these points: their row numbers in the cloud, or pixel numbers in a depth image, row by row from 0."""

    indices: Sequence[int] | NDArray[Any]


class TargetLabel(TypedDict):
    """Grasp the pixels that the mask of a depth image labels with this number."""

    label: int


class GripperSize(TypedDict, total=False):
    """A two-finger hand, metres; what is left out is that of the hand that `name` names, or the Franka hand's.

    A part whose size is given is straight, unless its narrower end is given as well. See `service.schemas.GripperSize`.
    """

    name: str
    max_width: float
    finger_depth: float
    finger_thickness: float
    finger_tip_thickness: float
    finger_taper: float
    finger_breadth: float
    finger_tip_breadth: float
    palm_depth: float
    palm_length: float
    palm_breadth: float
    palm_front_breadth: float
    palm_taper: float
    tip_offset: float
    hand_to_tcp: float
    hand_yaw: float
    linkage_length: float | None
    linkage_offset: float


class Intrinsics(TypedDict):
    """A pinhole camera without distortion, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class Separation(TypedDict, total=False):
    """Grasps nearer than both to a better one are dropped."""

    translation: float
    rotation_deg: float


class GraspOptions(TypedDict, total=False):
    """Options of a grasp request, named as on the wire; what is left out or None gets the service's default.

    Positions and directions are in the frame of the points; lengths are in metres.

    Args:
        viewpoint: camera position, or a list of positions for a fused cloud; orients normals. Default: the origin, and
            a warning says so.
        up: direction against gravity, or `"auto"`: that of the plane that things stand on, found with its height; a
            warning then says where. Default: auto for a depth image; for points none, so that grasps from below are not
            filtered, and a warning says so.
        workspace: `{"min": ..., "max": ...}`; points outside count for collision alone.
        support_height: height of the support plane along `up` (needs `up`), or `"auto"` to find it: a warning then says
            where.
        target: `{"box": {"min": ..., "max": ...}}`, `{"indices": [...]}` or, with a mask, `{"label": N}`: candidates
            come from it alone, the other points still count for collision.
        approach: `{"direction": ..., "max_angle_deg": ...}`.
        max_grasps: how many to return (default 10).
        min_score: threshold (default 0).
        min_separation: `{"translation": 0.01, "rotation_deg": 15}`.
        num_approach_points: search effort (default 32).
        max_candidates: search effort (default 2000).
        gripper: a known hand's name, as `tesnet.hands` has them (default `"franka"`), or `{"max_width": 0.06, ...}`.
        width: whether the hand arrives `"full"` open (default) or `"fitted"` to what was seen between its fingers
            (default for hands whose tips swing forward as they close).
        unseen: whether the shadow behind observed points is `"free"` (default) or `"occupied"` for collisions.
        calibrate: whether depth scale and a small tilt are solved from the support that is seen (default False).
        pregrasp_distance: how far behind the grasp `pregrasp` lies (default 0.05).
        frame_convention: `"panda"` (default), `"graspnet"` or `"contact_graspnet"`.
        seed: makes sampling repeatable (default 0).
        model: one of the networks that the service has loaded (default: the first that `/model` lists).
    """

    viewpoint: Vector | Sequence[Vector]
    up: Vector | Literal["auto"]
    workspace: Box
    support_height: float | Literal["auto"]
    target: TargetBox | TargetPoints | TargetLabel
    approach: ApproachCone
    max_grasps: int
    min_score: float
    min_separation: Separation
    num_approach_points: int
    max_candidates: int
    gripper: str | GripperSize
    width: Literal["fitted", "full"]
    unseen: Literal["free", "occupied"]
    calibrate: bool
    pregrasp_distance: float
    frame_convention: FrameConvention
    seed: int
    model: str


@dataclass(frozen=True, slots=True)
class Request:
    """One HTTP request, ready to be sent any number of times.

    Args:
        method: GET or POST.
        target: path and query string, beginning with a slash.
        content: the body.
        headers: all but those of the connection itself.
    """

    method: str
    target: str
    content: bytes = b""
    headers: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


def points_request(
    points: ArrayLike,
    options: Mapping[str, Any],
    request_id: str | None = None,
    *,
    view_index: ArrayLike | None = None,
    normals: ArrayLike | None = None,
) -> Request:
    """The request for grasps of points (N, 3) or (H, W, 3), metres; see `GraspClient.grasps`.

    Raises:
        InvalidArgument: points that cannot be sent (`checked_points`), other numbers of what belongs to each of them,
            or an option that JSON cannot express.
        TypeError: an option of another name than those of `GraspOptions`.
    """
    cloud = checked_points(points)
    values = _options(options)
    beside = {"view_index": view_index, "normals": normals}
    files = [
        File(name, f"{name}.npy", _npy(_beside(name, array, len(cloud))))
        for name, array in beside.items()
        if array is not None
    ]
    texts = {name: _json(value) for name, value in values.items()}
    query = urlencode(texts, quote_via=quote)
    if files or len(query) > LONGEST_QUERY:
        return _form_request([File("cloud", "cloud.npy", _npy(cloud)), *files], values, request_id)
    is_far = cloud.dtype == np.float64
    content_type = "application/x-npy" if is_far else "application/octet-stream"
    content = _npy(cloud) if is_far else cloud.astype("<f4", copy=False).tobytes()
    headers = {"Content-Type": content_type, **_headers(request_id)}
    return Request("POST", f"/grasps?{query}" if query else "/grasps", content, headers)


def depth_request(
    depth: ArrayLike | bytes,
    intrinsics: Intrinsics | CameraIntrinsics,
    options: Mapping[str, Any],
    *,
    mask: ArrayLike | bytes | None = None,
    T_cloud_camera: Pose | ArrayLike | None = None,
    depth_scale: float = DEFAULT_DEPTH_SCALE,
    stride: int = 1,
    request_id: str | None = None,
) -> Request:
    """The request for grasps of a depth image; see `GraspClient.grasps_from_depth`.

    Raises:
        InvalidArgument: an image or a camera that cannot be sent, or an option that JSON cannot express.
        TypeError: an option of another name than those of `GraspOptions`.
    """
    camera: dict[str, Any] = {"intrinsics": _intrinsics(intrinsics), "depth_scale": depth_scale}
    if stride != 1:
        camera["stride"] = stride
    if T_cloud_camera is not None:
        camera["T_cloud_camera"] = _plain("T_cloud_camera", _matrix(T_cloud_camera))
    if isinstance(depth, bytes):
        files = [File("depth", _image_name("depth", depth), depth)]
        shape = None
    else:
        counts = depth_counts(depth, depth_scale)
        files = [File("depth", "depth.png", png(counts))]
        shape = counts.shape
    if isinstance(mask, bytes):
        files.append(File("mask", _image_name("mask", mask), mask))
    elif mask is not None:
        files.append(File("mask", "mask.png", png(mask_levels(mask, shape))))
    return _form_request(files, {**_options(options), **camera}, request_id)


def _form_request(files: Sequence[File], options: Mapping[str, Any], request_id: str | None) -> Request:
    content_type, content = encode_form([*files, File("options", None, _json(options).encode(), "application/json")])
    return Request("POST", "/grasps", content, {"Content-Type": content_type, **_headers(request_id)})


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _image_name(name: str, content: bytes) -> str:
    return f"{name}.npy" if NPY.recognises(content) else f"{name}.png"


def _beside(name: str, given: ArrayLike, count: int) -> NDArray[Any]:
    """What belongs to each of the points, row by row."""
    array = np.asarray(given)
    rows = array.reshape(-1, 3) if name == "normals" and array.ndim == 3 and array.shape[2] == 3 else array
    rows = rows.reshape(-1) if name == "view_index" else rows
    wanted = (count, 3) if name == "normals" else (count,)
    if array.dtype.kind not in ("iu" if name == "view_index" else "fiu") or rows.shape != wanted:
        kind = "x, y, z" if name == "normals" else "a whole number"
        what = f"has shape {array.shape} and dtype {array.dtype}"
        raise InvalidArgument(name, f"{what}; give {kind} for each of the {count} points")
    return rows.astype(np.float32) if name == "normals" else rows


def _intrinsics(given: Intrinsics | CameraIntrinsics) -> dict[str, float]:
    names = tuple(Intrinsics.__annotations__)
    if isinstance(given, CameraIntrinsics):
        return {name: float(getattr(given, name)) for name in names}
    if set(given) != set(names):
        raise InvalidArgument("intrinsics", f"must have exactly {', '.join(names)}, in pixels")
    plain: dict[str, float] = _plain("intrinsics", given)
    return plain


def _matrix(pose: Pose | ArrayLike) -> NDArray[np.float64]:
    if isinstance(pose, Pose):
        return pose.matrix
    try:
        return Pose.nearest(pose).matrix
    except ValueError as error:
        raise InvalidArgument("T_cloud_camera", str(error)) from None


def checked_points(points: ArrayLike) -> NDArray[np.float32] | NDArray[np.float64]:
    """Points (N, 3), metres, as they are sent, NaN and infinities included, which the service leaves out and counts.

    Those of an image (H, W, 3) come row by row. They are float32, or float64 where float32 would blur them.

    Raises:
        InvalidArgument: not an array of real numbers, another shape, no finite point at all, or a coordinate beyond
            float32.
    """
    try:
        array = np.asarray(points)
    except ValueError:
        raise InvalidArgument(
            "points", "have rows of different lengths; give an array of N x 3: x, y, z in metres"
        ) from None
    if array.dtype.kind not in "fiu":
        raise InvalidArgument("points", f"have dtype {array.dtype}; give real numbers: float32 or float64 metres")
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise InvalidArgument("points", f"have shape {array.shape}; give an array of N x 3: x, y, z in metres")
    rows = array.reshape(-1, 3)
    finite = np.isfinite(rows)
    if not finite.all(axis=1).any():
        raise InvalidArgument(
            "points",
            f"have {len(rows)} rows, none of them finite; give at least 1 point (was all cropped away?)",
        )
    largest = float(np.abs(rows, where=finite, out=np.zeros(rows.shape)).max())
    if largest > float(np.finfo(np.float32).max):
        raise InvalidArgument("points", f"reach {largest:g} m, beyond float32; remove such values")
    is_far = array.dtype.itemsize > 4 and largest >= FAR
    return np.ascontiguousarray(rows, dtype=np.float64) if is_far else np.ascontiguousarray(rows, dtype=np.float32)


def _options(options: Mapping[str, Any]) -> dict[str, Any]:
    known = GraspOptions.__annotations__
    for name in options:
        if name not in known:
            raise TypeError(f"unknown option {name!r}; valid: {', '.join(sorted(known))}")
    return {name: _plain(name, value) for name, value in options.items() if value is not None}


def _plain(name: str, value: Any) -> Any:
    """`value` with arrays as lists and numpy scalars as numbers: what JSON can express."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(name, value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(name, item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(name, item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        raise InvalidArgument(name, f"holds {value}; give finite numbers")
    if value is None or isinstance(value, str | int | float):
        return value
    raise InvalidArgument(name, f"holds a {type(value).__name__}; give numbers, strings, lists, mappings or arrays")


def _headers(request_id: str | None) -> dict[str, str]:
    headers = {"Accept": "application/json"}
    if request_id is not None:
        if not re.fullmatch(REQUEST_ID, request_id):
            raise InvalidArgument(
                "request_id", f"is {request_id[:140]!r}; give 1 to 128 letters, digits and . _ : / + = -"
            )
        headers["X-Request-ID"] = request_id
    return headers


def header_value(argument: str, value: str) -> str:
    """`value`, if it can stand in an HTTP header.

    Raises:
        InvalidArgument: empty, longer than 4000 characters, holding anything but printable ASCII, or spaces at an end.
    """
    if not 1 <= len(value) <= 4000 or value != value.strip() or not all(" " <= character <= "~" for character in value):
        raise InvalidArgument(argument, "cannot stand in an HTTP header; give 1 to 4000 printable ASCII characters")
    return value
