"""A depth image and its camera -> points; a label image of the same size says what to grasp."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid
from service.payloads.image_file import read_image, size_of
from service.payloads.options import checked
from service.payloads.payload import Payload, Points, RawOptions, most_rows
from service.schemas import DepthCamera
from tesnet import plausibility
from tesnet.geometry import CameraIntrinsics, Pose
from tesnet.query import FAR, MAX_DIAGONAL, span

_BLOCK = 1 << 18
"""Pixels that become points in one go, so that images of any size take little more memory than their points."""

_FEW = 1000
"""Points; what fewer of them span says nothing about a scale."""


def decode_depth(
    depth: memoryview, mask: memoryview | None, camera: RawOptions, options: RawOptions, max_points: int, **others: Any
) -> Payload:
    """The points of the pixels that have a depth, in the cloud frame, row by row.

    Args:
        depth: PNG of 16 bits or .npy; whole numbers are counts, others are metres.
        mask: PNG of up to 16 bits or .npy of whole numbers.
        camera: the options of `DepthCamera`.
        options: the others.
        max_points: the limit.
        others: of the payload's fields.

    Raises:
        Undecodable, UnreadableFile: no image, or a damaged one.
        TooLarge: more pixels than the limits.
        Invalid: pixels of another kind, a mask of another size, a camera that is none.
    """
    if "intrinsics" not in camera:
        raise Invalid(
            "intrinsics", 'is missing; a depth image needs {"fx": ..., "fy": ..., "cx": ..., "cy": ...} in pixels'
        )
    given = checked(DepthCamera, camera)
    T_cloud_camera = _pose(given)
    max_pixels = most_rows(max_points)
    image = read_image(depth, "depth", (16,), "iuf", max_pixels)
    labels = None if mask is None else read_image(mask, "mask", (1, 2, 4, 8, 16), "biu", max_pixels)
    if labels is not None and labels.shape != image.shape:
        raise Invalid("mask", f"is of {size_of(labels)} pixels, the depth image of {size_of(image)}; send equal sizes")
    height, width = image.shape
    k = given.intrinsics
    intrinsics = CameraIntrinsics(width, height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    problem = plausibility.normalised_intrinsics(intrinsics)
    if problem is not None:
        raise Invalid("intrinsics", problem)
    is_point = _with_depth(image, given.stride)
    depths = image[is_point]
    scale = None if image.dtype.kind == "f" else given.depth_scale
    points = _points(image, is_point, intrinsics, 1.0 if scale is None else scale, T_cloud_camera)
    _check_metres(points, depths, scale)
    notes, is_likely = plausibility.depth_notes(intrinsics, depths, scale, given.stride)
    return Payload(
        points=points,
        options=options,
        is_point=is_point.ravel(),
        mask=None if labels is None else labels.ravel(),
        viewpoint=T_cloud_camera.translation,
        image_scale="likely" if is_likely else "unlikely",
        notes=(*notes, *_of_pose(T_cloud_camera)),
        **others,
    )


def _with_depth(image: NDArray[Any], stride: int) -> NDArray[np.bool_]:
    """Mask (height, width) of the pixels that become points: on the grid of the stride, with a depth."""
    mask = np.zeros(image.shape, dtype=bool)
    grid = image[::stride, ::stride]
    mask[::stride, ::stride] = (grid > 0) & np.isfinite(grid) if image.dtype.kind == "f" else grid > 0
    return mask


def _points(
    image: NDArray[Any], is_point: NDArray[np.bool_], intrinsics: CameraIntrinsics, scale: float, T_cloud_camera: Pose
) -> Points:
    """(N, 3) in the cloud frame, block by block of the image's rows."""
    far = np.abs(T_cloud_camera.translation).max() >= FAR
    points: Points = np.empty((np.count_nonzero(is_point), 3), np.float64 if far else np.float32)
    height, width = image.shape
    rows = max(1, _BLOCK // width)
    done = 0
    for top in range(0, height, rows):
        block = np.where(is_point[top : top + rows], image[top : top + rows], 0).astype(np.float64) * scale
        part = CameraIntrinsics(
            width, len(block), fx=intrinsics.fx, fy=intrinsics.fy, cx=intrinsics.cx, cy=intrinsics.cy - top
        )
        found = T_cloud_camera.apply(part.back_project(block))
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused as that
            points[done : done + len(found)] = found
        done += len(found)
    return points


def _check_metres(points: Points, depths: NDArray[Any], scale: float | None) -> None:
    """Refuse what spans too much, in words that fit an image: its points are nothing that the client has seen."""
    if len(points) >= _FEW and np.isfinite(points).all() and (diagonal := span(points)) > MAX_DIAGONAL:
        field, message = plausibility.depths_beyond(diagonal, float(np.median(depths)), scale)
        raise Invalid(field, message)


def _of_pose(T_cloud_camera: Pose) -> list[str]:
    note = plausibility.camera_distance(float(np.linalg.norm(T_cloud_camera.translation)))
    return [] if note is None else [note]


def _pose(camera: DepthCamera) -> Pose:
    if camera.T_cloud_camera is None:
        return Pose.identity()
    try:
        return Pose.nearest(camera.T_cloud_camera)
    except ValueError as error:
        raise Invalid("T_cloud_camera", str(error)) from None
