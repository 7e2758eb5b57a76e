"""Depth images and masks -> what a form carries: grey PNG files. numpy and the standard library only."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from client.errors import InvalidArgument

MOST_COUNTS = 65_535


def depth_counts(depth: ArrayLike, depth_scale: float) -> NDArray[np.uint16]:
    """The 16-bit image (height, width) of a depth image: whole numbers are counts already, others are metres.

    Metres that are NaN, infinite or not positive become 0, which is no depth.

    Raises:
        InvalidArgument: another shape or type, or a depth beyond 65,535 counts.
    """
    image = _image("depth", depth, "iuf")
    if not 0 < depth_scale <= 1:
        raise InvalidArgument("depth_scale", f"is {depth_scale}; give metres per count, more than 0 and at most 1")
    if image.dtype.kind == "f":
        metres = np.where(np.isfinite(image) & (image > 0), image, 0.0)
        image = np.rint(metres / depth_scale)
    if image.min() < 0 or image.max() > MOST_COUNTS:
        raise InvalidArgument(
            "depth",
            f"reaches from {image.min():g} to {image.max():g} counts; give 0 to {MOST_COUNTS}, or a larger depth_scale",
        )
    return np.asarray(image.astype(np.uint16))


def mask_levels(mask: ArrayLike, shape: tuple[int, ...] | None) -> NDArray[Any]:
    """The image (height, width) of a mask: labels as they are, in 8 or 16 bits; 255 where anything else is not zero.

    Raises:
        InvalidArgument: another shape than the depth image's, no numbers, or labels out of 16 bits.
    """
    image = _image("mask", mask, "biuf")
    if shape is not None and image.shape != shape:
        raise InvalidArgument("mask", f"has shape {image.shape}, the depth image {shape}; give equal shapes")
    if image.dtype.kind not in "iu":
        return np.where(image != 0, 255, 0).astype(np.uint8)
    if image.min() < 0 or image.max() > MOST_COUNTS:
        raise InvalidArgument("mask", f"has labels from {image.min()} to {image.max()}; give 0 to {MOST_COUNTS}")
    return np.asarray(image.astype(np.uint8 if image.max() <= 255 else np.uint16))


def png(pixels: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """A grey PNG of 8 or 16 bits a pixel, without filters (PNG specification, third edition, chapters 5, 9 and 11)."""
    height, width = pixels.shape
    head = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, 0, 0, 0, 0)
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    lines = np.hstack([np.zeros((height, 1), np.uint8), rows])
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def _image(name: str, image: ArrayLike, kinds: str) -> NDArray[Any]:
    array = np.asarray(image)
    if array.ndim != 2 or 0 in array.shape or array.dtype.kind not in kinds:
        raise InvalidArgument(
            name, f"has shape {array.shape} and dtype {array.dtype}; give numbers in an array of height x width"
        )
    return array
