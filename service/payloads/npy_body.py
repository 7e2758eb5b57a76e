"""`application/x-npy`, and .npy files in a form: numpy parses the header, and nothing is ever unpickled."""

from __future__ import annotations

import io

import numpy as np
from numpy.lib import format as npy

from service.errors import Invalid, Undecodable, shortened
from service.payloads.payload import Payload, as_float32, check_count, refuse_empty

MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 65_536
"""numpy itself refuses headers over 10,000 bytes."""


def decode_npy(body: bytearray | memoryview, max_points: int) -> Payload:
    """A .npy array (N, 3) of float32 or float64."""
    refuse_empty(body)
    shape, fortran_order, dtype, start = _header(body)
    if dtype.hasobject:
        raise Undecodable(
            "The .npy holds pickled objects, which are never loaded; save an array of float32 or float64."
        )
    if dtype.kind != "f" or dtype.itemsize not in (4, 8):
        raise Invalid("points", f"are an array of {shortened(str(dtype))}; save float32 or float64")
    if len(shape) != 2 or shape[1] != 3:
        raise Invalid("points", f"have shape {shortened(str(shape))}; save an array of shape (N, 3)")
    check_count(shape[0], max_points)
    expected = shape[0] * 3 * dtype.itemsize
    if len(body) - start != expected:
        raise Undecodable(
            f"The .npy has {len(body) - start} bytes of data, its header says {expected}; it was cut off or damaged."
        )
    flat = np.frombuffer(body, dtype, offset=start) if expected else np.empty(0, dtype)
    return Payload(as_float32(flat.reshape(3, -1).T if fortran_order else flat.reshape(-1, 3)))


def _header(body: bytearray | memoryview) -> tuple[tuple[int, ...], bool, np.dtype[np.generic], int]:
    """Shape, Fortran order, dtype, and where the data starts."""
    file = io.BytesIO(memoryview(body)[:_MAX_HEADER_BYTES])
    try:
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, dtype = read_header(file)
    except Exception as error:  # noqa: BLE001 - numpy evaluates the header's text, and hostile text fails in many ways
        raise Undecodable(f"The .npy header cannot be read ({shortened(str(error))}); save the file again.") from None
    if any(size < 0 for size in shape):
        raise Undecodable(f"The .npy header has a negative size: {shortened(str(shape))}; save the file again.")
    return shape, fortran_order, dtype, file.tell()
