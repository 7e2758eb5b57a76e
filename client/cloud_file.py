"""Cloud files for the command line, in the formats of `tesnet.formats`. Knows no service.

A compressed .pcd needs the extra `files`; everything else numpy only.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tesnet import formats
from tesnet.errors import TesnetError
from tesnet.formats import CloudFile

Content = TypeVar("Content")


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


def read_cloud(path: Path) -> CloudFile:
    """What a cloud file says, in numbers of the file's own precision; its suffix tells the format.

    Raises:
        CloudFileError: missing, another format, damaged, or its reader is not installed.
    """
    found = next((entry for entry in formats.FORMATS if path.suffix.lower() in entry.suffixes), None)
    if found is None:
        raise CloudFileError(str(path), f"ends in {path.suffix or 'nothing'!r}; valid: {', '.join(formats.SUFFIXES)}")
    return decode(read_bytes(path), found.read, str(path))


def read_bytes(path: Path) -> bytes:
    """A file's content.

    Raises:
        CloudFileError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise CloudFileError(str(path), f"cannot be read: {error.strerror or error}") from error


def decode(content: bytes, reader: Callable[[bytes], Content], name: str) -> Content:
    """What a reader makes of a file's content.

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


PACKAGES = {"lzf": "python-neo-lzf"}
"""The extra `files`: what is imported, and what is installed."""

_DAMAGED = (TesnetError, ValueError, TypeError, EOFError, MemoryError)
"""What the readers, numpy among them, raise on a damaged file."""
