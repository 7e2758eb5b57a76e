"""A cloud file -> points (N, 3), for the command line. Knows no service.

A compressed .pcd needs the extra `files`; everything else numpy only.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.errors import TesnetError
from tesnet.formats import read_pcd, read_ply, seen

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
    return decode_cloud(read_bytes(path), reader, str(path))


def read_bytes(path: Path) -> bytes:
    """A file's content.

    Raises:
        CloudFileError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise CloudFileError(str(path), f"cannot be read: {error.strerror or error}") from error


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
            name, f"is compressed and needs a package that is not installed; pip install {PACKAGES[error.name]}"
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


def read_seen_pcd(content: bytes) -> Points:
    """Points of a PCD file, without the rows of pixels that have no depth."""
    points = read_pcd(content)
    return np.asarray(points[seen(points)])


PACKAGES = {"lzf": "python-neo-lzf"}
"""The extra `files`: what is imported, and what is installed."""

READERS: Mapping[str, Callable[[bytes], Points]] = MappingProxyType(
    {".npy": read_npy, ".ply": read_ply, ".pcd": read_seen_pcd, ".xyz": read_text, ".txt": read_text}
)

_DAMAGED = (TesnetError, ValueError, TypeError, EOFError, MemoryError)
"""What the readers, numpy among them, raise on a damaged file."""
