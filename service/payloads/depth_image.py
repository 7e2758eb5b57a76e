"""A depth image (16-bit PNG) and its camera -> points; an 8-bit PNG of the same size says what to grasp."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from service.errors import Invalid, TooLarge, Undecodable, shortened
from service.payloads.options import checked
from service.payloads.payload import Payload, RawOptions, as_float32, check_count, refuse_empty
from service.schemas import DepthCamera
from tesnet.geometry import CameraIntrinsics, Pose

PIXELS_PER_POINT = 4
"""An image may have so many times the pixels of the largest cloud: many of them have no depth."""

_GRAYSCALE = 0
_HEAD = struct.Struct(">8sI4sIIBBBBB")
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def decode_depth(
    depth: memoryview, mask: memoryview | None, camera: RawOptions, options: RawOptions, max_points: int
) -> Payload:
    """The points of the pixels that have a depth, in the cloud frame, row by row.

    Raises:
        Undecodable: no PNG, or a damaged one.
        TooLarge, TooManyPoints: more pixels or points than the limits.
        Invalid: pixels of another kind, a mask of another size, a camera that is none.
    """
    if "intrinsics" not in camera:
        raise Invalid(
            "intrinsics", 'is missing; a depth image needs {"fx": ..., "fy": ..., "cx": ..., "cy": ...} in pixels'
        )
    given = checked(DepthCamera, camera)
    T_cloud_camera = _pose(given)
    max_pixels = PIXELS_PER_POINT * max_points
    counts = _pixels(depth, "depth", (16,), max_pixels)
    targets = None if mask is None else _pixels(mask, "mask", (1, 2, 4, 8), max_pixels) != 0
    if targets is not None and targets.shape != counts.shape:
        raise Invalid("mask", f"is of {_size(targets)} pixels, the depth image of {_size(counts)}; send equal sizes")
    is_point = counts.ravel() != 0
    check_count(int(is_point.sum()), max_points)
    height, width = counts.shape
    k = given.intrinsics
    intrinsics = CameraIntrinsics(width, height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    points_camera = intrinsics.back_project(counts * given.depth_scale)
    return Payload(
        points=as_float32(T_cloud_camera.apply(points_camera)),
        options=options,
        is_point=is_point,
        mask=None if targets is None else targets.ravel(),
        viewpoint=T_cloud_camera.translation,
    )


def _pose(camera: DepthCamera) -> Pose:
    if camera.T_cloud_camera is None:
        return Pose.identity()
    if list(camera.T_cloud_camera[3]) != [0, 0, 0, 1]:
        raise Invalid("T_cloud_camera", f"has the last row {list(camera.T_cloud_camera[3])}; it must be [0, 0, 0, 1]")
    try:
        return Pose.from_matrix(camera.T_cloud_camera)
    except ValueError as error:
        raise Invalid("T_cloud_camera", str(error)) from None


# ----------------------------------------------------------------------------------------------------------------- PNG


@dataclass(frozen=True, slots=True)
class _Head:
    width: int
    height: int
    bits: int
    colours: int


def _pixels(file: memoryview, name: str, bits: tuple[int, ...], max_pixels: int) -> NDArray[Any]:
    """The grey values (height, width) of a PNG; its size is known and checked before it is expanded."""
    refuse_empty(file, f"file `{name}`")
    head = _head(file, name)
    if head.width * head.height > max_pixels:
        raise TooLarge(
            f"The file `{name}` has {head.width} x {head.height} pixels (limit {max_pixels} in all); crop or shrink it."
        )
    if head.colours != _GRAYSCALE or head.bits not in bits:
        kind = "grey" if head.colours == _GRAYSCALE else "coloured"
        raise Invalid(name, f"has {kind} pixels of {head.bits} bits; save a grey PNG of {bits[-1]} bits a pixel")
    try:
        with Image.open(io.BytesIO(file), formats=("PNG",)) as image:
            if image.size == (head.width, head.height):  # a second header would be expanded as it says
                return np.array(image)
    except UnidentifiedImageError:  # its words would name our buffer
        raise Undecodable(
            f"The file `{name}` is a damaged PNG (no pixels behind its head; it was cut off); save it again."
        ) from None
    except Exception as error:  # noqa: BLE001 - a damaged image fails in many ways
        raise Undecodable(f"The file `{name}` is a damaged PNG ({shortened(str(error))}); save it again.") from None
    raise Undecodable(f"The file `{name}` is a PNG with two headers that differ; save it again.")


def _head(file: memoryview, name: str) -> _Head:
    """What the PNG's first chunk says (PNG specification, 11.2.2)."""
    if len(file) >= _HEAD.size:
        signature, _, chunk, width, height, bits, colours, *methods, interlaced = _HEAD.unpack_from(file)
        if signature == _SIGNATURE and chunk == b"IHDR" and width > 0 and height > 0:
            if methods != [0, 0] or interlaced > 1:  # compression and filter: there are no others
                what = f"{methods[0]}, {methods[1]} and {interlaced}"
                raise Undecodable(f"The PNG `{name}` says it is compressed, filtered and interlaced by methods {what}.")
            return _Head(width, height, bits, colours)
    raise Undecodable(f"The file `{name}` does not begin like a PNG; send one.")


def _size(image: NDArray[Any]) -> str:
    height, width = image.shape
    return f"{width} x {height}"
