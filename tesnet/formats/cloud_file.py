"""What a cloud file says, and what a format is: the values that the readers and their table share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tesnet.formats.header import Content


@dataclass(frozen=True, eq=False, slots=True)
class CloudFile:
    """The content of a cloud file, row by row as it was saved.

    Args:
        points: (R, 3) in numbers of the file's own type. A row with NaN or an infinity is no point: organised clouds
            have one for every pixel, depth or not.
        normals: (R, 3) where the file has them; a row of zeros gives none.
        viewpoint: (3,) where the camera stood, where the file says so. Writers that do not know it put the origin,
            which therefore counts as not given.
    """

    points: NDArray[Any]
    normals: NDArray[Any] | None = None
    viewpoint: NDArray[np.float64] | None = None


class Reader(Protocol):
    """Content, most rows -> what it says. Raises `UnreadableFile`, `TooManyPoints` and, for .npy, `InvalidQuery`."""

    def __call__(self, content: Content, max_points: int | None = None) -> CloudFile:
        """What the content says, if it has at most so many rows."""


@dataclass(frozen=True, slots=True)
class Format:
    """One format of cloud files.

    Args:
        name: as people call it.
        suffixes: of its files, in lower case, with the dot.
        what: of it is read, in a few words.
        recognises: whether content begins like it.
        read: its reader.
    """

    name: str
    suffixes: tuple[str, ...]
    what: str
    recognises: Callable[[Content], bool]
    read: Reader


def given_viewpoint(position: NDArray[Any]) -> NDArray[np.float64] | None:
    """A viewpoint (3,) of a file; None for the origin, which stands for none, and for what is not finite."""
    place = np.asarray(position, dtype=np.float64)
    return place if np.isfinite(place).all() and place.any() else None


def given_normals(normals: NDArray[Any]) -> NDArray[Any] | None:
    """Normals (R, 3) of a file, those that are not finite as zeros; None where no row has one."""
    known = np.isfinite(normals).all(axis=1)
    kept = normals if known.all() else np.where(known[:, None], normals, 0)
    return kept if kept.any() else None
