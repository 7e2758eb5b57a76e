"""Point-cloud files -> what they say, for service and client. numpy only; knows no cloud processing and no HTTP.

`FORMATS` is the one table of them: decoders, messages, documentation and the viewer follow it. A file may be hostile:
every size that its header claims is compared with the bytes that are there and with the caller's limit before anything
of that size is allocated or expanded.
"""

from __future__ import annotations

from tesnet.errors import UnreadableFile
from tesnet.formats.cloud_file import CloudFile, Format, Reader
from tesnet.formats.header import Content
from tesnet.formats.npy import is_npy, npy_array, read_npy
from tesnet.formats.pcd import is_pcd, read_pcd
from tesnet.formats.ply import is_ply, read_ply
from tesnet.formats.text import is_text, line_before_points, read_text

__all__ = [
    "FORMATS",
    "LISTED",
    "NPY",
    "PCD",
    "PLY",
    "SUFFIXES",
    "TEXT",
    "CloudFile",
    "Content",
    "Format",
    "Reader",
    "format_of",
    "npy_array",
    "read",
    "why_of_none",
]

NPY = Format("NPY", (".npy",), "an array (N, 3) or (H, W, 3) of float32 or float64", is_npy, read_npy)
PLY = Format("PLY", (".ply",), "text or binary: x, y, z, and nx, ny, nz where it has them", is_ply, read_ply)
PCD = Format(
    "PCD",
    (".pcd",),
    "ascii, binary or binary_compressed: x, y, z, VIEWPOINT, and normal_x, normal_y, normal_z where it has them",
    is_pcd,
    read_pcd,
)
TEXT = Format("text", (".xyz", ".txt"), "x, y, z of a point on each line", is_text, read_text)

FORMATS = (NPY, PLY, PCD, TEXT)
"""In the order in which content is asked whether it begins like one of them."""

SUFFIXES = tuple(suffix for entry in FORMATS for suffix in entry.suffixes)
LISTED = f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
"""The suffixes, for a sentence."""
_MOST_CHARACTERS = 60


def format_of(content: Content) -> Format | None:
    """The format that content begins like, whatever its file is called."""
    return next((entry for entry in FORMATS if entry.recognises(content)), None)


def why_of_none(content: Content, name: str) -> str:
    """What is wrong with content of no format that goes by this name, and the remedy."""
    line = line_before_points(content)
    if line is None:
        return f"The {name} begins like none of {LISTED}; send one of them."
    number, words = line
    return (
        f"The {name} has {words[:_MOST_CHARACTERS]!r} in line {number}, which is no point; delete it or begin it "
        "with #: x, y, z of a point are the first three numbers of every other line."
    )


def read(content: Content, max_points: int | None = None) -> CloudFile:
    """What a file of any of the formats says.

    Raises:
        UnreadableFile: of none of them, or damaged.
        InvalidQuery: an array of something else than points.
        TooManyPoints: more rows than `max_points`.
        ModuleNotFoundError: a compressed PCD, and `lzf` is not installed.
    """
    found = format_of(content)
    if found is None:
        raise UnreadableFile(why_of_none(content, "file"))
    return found.read(content, max_points)
