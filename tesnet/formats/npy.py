"""NPY (numpy's arrays): numpy parses the header, the data stays where it lies, and nothing is ever unpickled."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from tesnet.errors import InvalidQuery, UnreadableFile
from tesnet.formats.cloud_file import CloudFile
from tesnet.formats.header import Content, check_count

MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 65_536
"""numpy itself refuses headers over 10,000 bytes."""


def is_npy(content: Content) -> bool:
    """Whether this begins like a .npy file."""
    return bytes(content[: len(MAGIC)]) == MAGIC


def read_npy(content: Content, max_points: int | None = None) -> CloudFile:
    """Points of an array (N, 3), or (H, W, 3) row by row, of float32 or float64.

    Raises:
        UnreadableFile: damaged, or pickled objects.
        InvalidQuery: an array of something else.
        TooManyPoints: more than `max_points`.
    """
    header = _header(content)
    shape, dtype = header.shape, header.dtype
    if dtype.kind != "f" or dtype.itemsize not in (4, 8):
        raise InvalidQuery("points", f"are an array of {_shown(dtype)}; save float32 or float64")
    if len(shape) not in (2, 3) or shape[-1] != 3:
        raise InvalidQuery(
            "points", f"have shape {_shown(shape)}; save an array of shape (N, 3), or (H, W, 3) of an image"
        )
    check_count(math.prod(shape[:-1]), max_points)
    return CloudFile(_data(content, header).reshape(-1, 3))


def npy_array(content: Content) -> NDArray[Any]:
    """The array of a .npy file, a read-only view where the bytes lie.

    Raises:
        UnreadableFile: damaged, or pickled objects.
    """
    return _data(content, _header(content))


@dataclass(frozen=True, slots=True)
class _Header:
    """What the data is, and where it starts."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    start: int


def _data(content: Content, header: _Header) -> NDArray[Any]:
    expected = header.dtype.itemsize * math.prod(header.shape)
    there = len(content) - header.start
    if there != expected:
        raise UnreadableFile(
            f"The .npy has {there} bytes of data, its header says {expected}; it was cut off or damaged."
        )
    if not expected:
        return np.empty(header.shape, header.dtype)
    flat = np.frombuffer(content, header.dtype, offset=header.start)
    flat.setflags(write=False)
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")


def _header(content: Content) -> _Header:
    file = io.BytesIO(memoryview(content)[:_MAX_HEADER_BYTES])
    try:
        version = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran_order, dtype = read_header(file)
    except Exception as error:  # noqa: BLE001 - numpy evaluates the header's text, and hostile text fails in many ways
        raise UnreadableFile(f"The .npy header cannot be read ({_shown(error)}); save the file again.") from None
    if any(size < 0 for size in shape):
        raise UnreadableFile(f"The .npy header has a negative size: {_shown(shape)}; save the file again.")
    if dtype.hasobject:
        raise UnreadableFile("The .npy holds pickled objects, which are never loaded; save an array of numbers.")
    return _Header(shape, fortran_order, dtype, file.tell())


def _shown(value: object) -> str:
    """A value of a header, fit for a message: printable and short."""
    text = "".join(character if character.isprintable() else "?" for character in str(value)[:81])
    return text if len(text) <= 80 else f"{text[:77]}..."
