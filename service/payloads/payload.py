"""What every decoder gives, and the checks that they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, TypedDict

import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid, Undecodable
from tesnet.errors import TooManyPoints
from tesnet.formats import CloudFile, Content, Reader
from tesnet.query import FAR

Points: TypeAlias = NDArray[Any]
"""(N, 3) of float32 or float64."""
RawOptions = Mapping[str, bytes]
"""Option name -> its value as JSON text."""


class BesidePoints(TypedDict, total=False):
    """What may come with the points, one entry for each posted row or pixel: see `Payload`."""

    view_index: NDArray[Any]
    normals: NDArray[Any]


@dataclass(frozen=True, eq=False, slots=True)
class Payload:
    """A decoded body.

    Args:
        points: (N, 3) in the cloud frame, not yet checked; float64 where float32 would blur them.
        options: that came with them.
        is_point: (R,) mask of the posted rows or pixels that have become points; None is all of them.
        mask: (R,) labels of the rows or pixels, 0 where there is no target; None where no mask was posted.
        viewpoint: (3,) position of the camera in the cloud frame, where the body is its image.
        file_viewpoint: (3,) the same, where the file of a cloud names it.
        view_index: (R,) which viewpoint saw each row.
        normals: (R, 3) that came with the rows; zeros where there is none.
        image_scale: as `GraspQuery.image_scale`.
        ignored_points: rows with NaN or an infinity.
        notes: what the client is to be told.
    """

    points: Points
    options: RawOptions = field(default_factory=dict)
    is_point: NDArray[np.bool_] | None = None
    mask: NDArray[Any] | None = None
    viewpoint: NDArray[np.float64] | None = None
    file_viewpoint: NDArray[np.float64] | None = None
    view_index: NDArray[Any] | None = None
    normals: NDArray[Any] | None = None
    image_scale: Literal["likely", "unlikely"] | None = None
    ignored_points: int = 0
    notes: tuple[str, ...] = ()


def cloud_payload(
    rows: NDArray[Any],
    options: RawOptions | None = None,
    beside: BesidePoints | None = None,
    file_viewpoint: NDArray[np.float64] | None = None,
) -> Payload:
    """The payload of rows (R, 3), of which those with NaN or an infinity are no points.

    Args:
        rows: as they were posted.
        options: that came with them.
        beside: the rows' view index and normals.
        file_viewpoint: see `Payload`.

    Raises:
        Invalid: not one point is left.
    """
    finite = np.isfinite(rows).all(axis=1)
    ignored = len(rows) - int(np.count_nonzero(finite))
    if ignored and ignored == len(rows):
        raise Invalid("points", f"are {ignored}, all of them NaN or infinite; send at least one finite point")
    return Payload(
        points=kept(rows[finite] if ignored else rows),
        options=options or {},
        is_point=finite if ignored else None,
        file_viewpoint=file_viewpoint,
        ignored_points=ignored,
        **(beside or {}),
    )


def most_rows(max_points: int) -> int:
    """How many rows or pixels a body may have, of which many may be no point, or not matter.

    At the limit of a million points that matter an image may have 3840 x 2160 pixels.
    """
    return 17 * max_points // 2


def file_of(content: Content, reader: Reader, max_points: int) -> CloudFile:
    """What a reader makes of a body or of a part of it.

    Raises:
        TooManyPoints: more rows than there may be, told by the limit of those that matter.
    """
    try:
        return reader(content, most_rows(max_points))
    except TooManyPoints as error:
        raise TooManyPoints(error.count, max_points) from None


def refuse_empty(body: bytes | bytearray | memoryview, what: str = "body") -> None:
    """Raise `Undecodable` for no bytes at all."""
    if not len(body):
        raise Undecodable(f"The {what} is empty; send the points of a cloud.")


def check_count(count: int, max_points: int) -> None:
    """Raise `TooManyPoints` above the limit."""
    if count > max_points:
        raise TooManyPoints(count, max_points)


def kept(array: NDArray[Any]) -> Points:
    """Coordinates as contiguous float32, or as float64 where they are far from the origin and more precise than that.

    What overflows float32 becomes infinite, and is refused as that.
    """
    if array.dtype.itemsize > 4 and array.size and max(float(array.max()), -float(array.min())) >= FAR:
        return np.ascontiguousarray(array, dtype=np.float64)
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=np.float32)
