"""What may come beside the points, one entry for each posted row or pixel: `view_index` and `normals`.

As JSON arrays in a JSON body, as a .npy file or a JSON array in a form.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import Invalid, shortened
from service.payloads.json_object import Span, broken_chunk, number_chunks
from service.payloads.json_points import points_of_json
from service.payloads.options import BESIDE_POINTS
from service.payloads.payload import BesidePoints, most_rows
from tesnet.errors import TooManyPoints
from tesnet.formats import NPY, npy_array

VIEW_INDEX, NORMALS = BESIDE_POINTS

_NUMBERS = msgspec.json.Decoder(list[int])


def per_point(spans: Mapping[str, Span], max_points: int) -> BesidePoints:
    """The arrays that are given among these parts.

    Raises:
        Undecodable, UnreadableFile: no JSON, no .npy.
        Invalid: of something else than such numbers.
        TooManyPoints: more of them than a body may have rows.
    """
    found: BesidePoints = {}
    if VIEW_INDEX in spans:
        found["view_index"] = _view_index(spans[VIEW_INDEX], most_rows(max_points))
    if NORMALS in spans:
        found["normals"] = _normals(spans[NORMALS], most_rows(max_points))
    return found


def whole_numbers(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """A view index (R,) from an array of any shape.

    Raises:
        Invalid: not whole numbers.
    """
    if array.dtype.kind not in "iu":
        raise Invalid(name, f"is an array of {shortened(str(array.dtype))}; save whole numbers, one a point")
    return array.reshape(-1)


def known_normals(array: NDArray[Any]) -> NDArray[Any]:
    """Normals (R, 3) from an array (R, 3) or (H, W, 3), with zeros for those that are not finite.

    Raises:
        Invalid: of something else.
    """
    if array.dtype.kind != "f" or array.ndim not in (2, 3) or array.shape[-1] != 3:
        what = shortened(f"{array.dtype} of shape {array.shape}")
        raise Invalid(NORMALS, f"are an array of {what}; save float32 or float64 of shape (N, 3), one a point")
    rows = array.reshape(-1, 3)
    finite = np.isfinite(rows).all(axis=1)
    return rows if finite.all() else np.where(finite[:, None], rows, 0)


def _view_index(span: Span, max_rows: int) -> NDArray[Any]:
    if NPY.recognises(span.view):
        return whole_numbers(VIEW_INDEX, npy_array(span.view))
    if span.count(b",") >= max_rows:
        raise TooManyPoints(f"more than {max_rows}", max_rows)
    parts: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    try:
        for chunk in number_chunks(span):
            parts.append(np.array(_NUMBERS.decode(chunk), np.int64))
    except (msgspec.DecodeError, OverflowError, UnicodeDecodeError, RecursionError) as error:
        raise broken_chunk(VIEW_INDEX, span, chunk, error) or Invalid(
            VIEW_INDEX, "is no array of whole numbers; give one a point, the number of its viewpoint from 0"
        ) from None
    return np.concatenate(parts)


def _normals(span: Span, max_rows: int) -> NDArray[Any]:
    if NPY.recognises(span.view):
        return known_normals(npy_array(span.view))
    return points_of_json(span, max_rows, NORMALS)
