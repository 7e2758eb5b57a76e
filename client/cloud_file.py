"""A cloud file -> points (N, 3), for the command line. Knows no service.

.npy and text need numpy only; .ply and .pcd need the extra `files`, loaded when such a file is read.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[Any]


class CloudFileError(Exception):
    """A cloud file cannot be read.

    Args:
        name: the file.
        why: what is wrong and what to do.
    """

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"{name}: {why}")
        self.name = name
        self.why = why


def read_cloud(path: Path) -> Points:
    """Points (N, 3) of a .npy, .ply, .pcd, .xyz or .txt file, as numbers of the file's own precision.

    Raises:
        CloudFileError: missing, another format, damaged, or its reader is not installed.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise CloudFileError(str(path), f"ends in {path.suffix or 'nothing'!r}; valid: {', '.join(READERS)}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CloudFileError(str(path), f"cannot be read: {error.strerror or error}") from error
    return decode_cloud(content, reader, str(path))


def decode_cloud(content: bytes, reader: Callable[[bytes], Points], name: str) -> Points:
    """Points (N, 3) of a file's content.

    Raises:
        CloudFileError: empty, damaged, or its reader is not installed.
    """
    if not content:
        raise CloudFileError(name, "is empty; give a file that holds at least one point")
    try:
        return reader(content)
    except ModuleNotFoundError as error:
        if error.name not in PACKAGES:
            raise
        raise CloudFileError(
            name, f"needs the package {error.name}, which is not installed; pip install {error.name}"
        ) from error
    except _DAMAGED as error:
        raise CloudFileError(
            name, f"cannot be decoded: {' '.join(str(error).split()) or type(error).__name__}"
        ) from error


def read_npy(content: bytes) -> Points:
    """Points of a .npy array (N, 3); pickled objects are refused."""
    return np.asarray(np.lib.format.read_array(io.BytesIO(content), allow_pickle=False))


def read_text(content: bytes) -> Points:
    """Points of text, one a line, as the first three columns; `#` and `//` begin comments.

    Columns are separated by spaces, tabs, commas or semicolons.
    """
    text = content.decode().replace(",", " ").replace(";", " ")
    return np.loadtxt(io.StringIO(text), dtype=np.float64, comments=("#", "//"), usecols=(0, 1, 2), ndmin=2)


def read_ply(content: bytes) -> Points:
    """Points of the element `vertex` of a PLY file, ascii or binary of either byte order."""
    plyfile = importlib.import_module("plyfile")
    try:
        vertex = plyfile.PlyData.read(io.BytesIO(content))["vertex"]
    except plyfile.PlyParseError as error:
        raise ValueError(str(error)) from error
    except KeyError:
        raise ValueError("has no element `vertex`") from None
    missing = [name for name in "xyz" if name not in vertex]
    if missing:
        raise ValueError(f"its element `vertex` has no property {', '.join(missing)}")
    return np.stack([np.asarray(vertex[name]) for name in "xyz"], axis=1)


def read_pcd(content: bytes) -> Points:
    """Points of a PCD file (ascii, binary or binary_compressed), without those that the camera did not see.

    An organised cloud marks a pixel without depth by NaN in all three coordinates; those rows are no points.
    """
    pypcd4 = importlib.import_module("pypcd4")
    cloud = pypcd4.PointCloud.from_fileobj(io.BytesIO(content))
    missing = [name for name in "xyz" if name not in cloud.fields]
    if missing:
        raise ValueError(f"has no field {', '.join(missing)}")
    points = np.asarray(cloud.numpy(("x", "y", "z")))
    return np.asarray(points[~np.isnan(points).all(axis=1)])


PACKAGES = frozenset({"plyfile", "pypcd4"})
"""The extra `files`."""

READERS: Mapping[str, Callable[[bytes], Points]] = MappingProxyType(
    {".npy": read_npy, ".ply": read_ply, ".pcd": read_pcd, ".xyz": read_text, ".txt": read_text}
)

_DAMAGED = (ValueError, KeyError, IndexError, EOFError, RuntimeError, TypeError, MemoryError)
"""What the readers raise on a damaged file; they have no error class in common."""
