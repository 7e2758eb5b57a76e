"""Images of a form -> arrays (height, width): grey PNG files of up to 16 bits, and .npy arrays."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from service.errors import Invalid, TooLarge, Undecodable, shortened
from service.payloads.payload import refuse_empty
from tesnet.formats import NPY, npy_array

_GRAYSCALE = 0
_HEAD = struct.Struct(">8sI4sIIBBBBB")
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_image(file: memoryview, name: str, bits: tuple[int, ...], kinds: str, max_pixels: int) -> NDArray[Any]:
    """The values (height, width) of an image; its size is known and checked before it is expanded.

    Args:
        file: PNG or .npy, told apart by its first bytes.
        name: of its part in the form.
        bits: of a PNG's pixel that may be.
        kinds: of a .npy's numbers that may be, as numpy calls them.
        max_pixels: the limit.

    Raises:
        Undecodable, UnreadableFile: neither, or a damaged one.
        TooLarge: more pixels than the limit.
        Invalid: pixels of another kind.
    """
    refuse_empty(file, f"file `{name}`")
    if NPY.recognises(file):
        return _array(npy_array(file), name, kinds, max_pixels)
    return _pixels(file, name, bits, max_pixels)


def size_of(image: NDArray[Any]) -> str:
    """Width and height, for a message."""
    height, width = image.shape
    return f"{width} x {height}"


def _array(array: NDArray[Any], name: str, kinds: str, max_pixels: int) -> NDArray[Any]:
    image = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if image.ndim != 2 or not image.size or image.dtype.kind not in kinds:
        what = shortened(f"{array.dtype} of shape {array.shape}")
        numbers = "numbers" if "f" in kinds else "whole numbers, or true and false,"
        raise Invalid(name, f"is an array of {what}; save {numbers} in an array (height, width)")
    _check_size(image.shape[1], image.shape[0], name, max_pixels)
    return image


def _check_size(width: int, height: int, name: str, max_pixels: int) -> None:
    if width * height > max_pixels:
        raise TooLarge(
            f"The file `{name}` has {width} x {height} pixels (limit {max_pixels} in all); crop or shrink it."
        )


@dataclass(frozen=True, slots=True)
class _Head:
    width: int
    height: int
    bits: int
    colours: int


def _pixels(file: memoryview, name: str, bits: tuple[int, ...], max_pixels: int) -> NDArray[Any]:
    """The grey values (height, width) of a PNG."""
    head = _head(file, name)
    _check_size(head.width, head.height, name, max_pixels)
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
    raise Undecodable(f"The file `{name}` does not begin like a PNG or a .npy; send one of them.")
