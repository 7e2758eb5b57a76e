"""PLY and PCD against plyfile and pypcd4, and against files that lie."""

from __future__ import annotations

import io
import itertools
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from pypcd4.pypcd4 import Encoding, PointCloud

from tesnet.errors import TooManyPoints, UnreadableFile
from tesnet.formats import is_pcd, is_ply, read_pcd, read_ply, seen, text

Array = NDArray[Any]
Reader = Callable[..., Array]

clouds = npst.arrays(np.float32, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-100, 100, width=32))


def ply(points: Array, layout: str, before: bool = False) -> bytes:
    """The points among other properties, behind another element on request, before faces; written by plyfile."""
    vertices = np.zeros(len(points), [("red", "u1"), ("x", "f8"), ("nx", "f4"), ("y", "f4"), ("z", "f4"), ("i", "i2")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    faces = np.zeros(2, [("vertex_indices", "O")])
    faces["vertex_indices"] = [np.array([0, 0, 0], "i4")] * 2
    camera = np.zeros(2, [("view_px", "f4"), ("frame", "i4")])
    elements = [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    if before:
        elements.insert(0, plyfile.PlyElement.describe(camera, "camera"))
    file = io.BytesIO()
    plyfile.PlyData(elements, text=layout == "text", byte_order="=" if layout == "text" else layout).write(file)
    return file.getvalue()


def pcd(points: Array, encoding: Encoding) -> bytes:
    """The points among other fields; written by pypcd4."""
    columns = [points[:, 0], np.zeros(len(points), np.uint8), points[:, 1], points[:, 2].astype(np.float64)]
    types = (np.float32, np.uint8, np.float32, np.float64)
    file = io.BytesIO()
    PointCloud.from_points(columns, ("x", "ring", "y", "z"), types).save(file, encoding)
    return file.getvalue()


@settings(max_examples=40)
@given(clouds, st.sampled_from(["text", "<", ">"]), st.booleans())
def test_ply_of_every_layout(points: Array, layout: str, before: bool) -> None:
    content = ply(points, layout, before)
    assert is_ply(content)
    np.testing.assert_allclose(read_ply(content, len(points)), points, rtol=1e-6)


@settings(max_examples=40)
@given(clouds, st.sampled_from([Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED]))
def test_pcd_of_every_encoding(points: Array, encoding: Encoding) -> None:
    content = pcd(points, encoding)
    assert is_pcd(content)
    np.testing.assert_allclose(read_pcd(content, len(points)), points, rtol=1e-5, atol=1e-9)


@settings(max_examples=40)
@given(clouds, st.integers(30, 200))
def test_text_is_the_same_however_it_is_cut(points: Array, block: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "_BLOCK", 16 + block * 4)
        np.testing.assert_allclose(read_ply(ply(points, "text", before=True)), points, rtol=1e-6)


def test_windows_lines_empty_lines_comments_and_further_columns_are_read() -> None:
    content = (
        b"ply\r\nformat ascii 1.0\r\ncomment by hand\r\nobj_info none\r\nelement vertex 2\r\n"
        b"property float x\r\n"
        b"property float y\r\nproperty float z\r\nend_header\r\n1 2 3\r\n\r\n  4 5 6 7\r\n"
    )
    np.testing.assert_array_equal(read_ply(content), [[1, 2, 3], [4, 5, 6]])


def test_an_organised_pcd_has_rows_without_a_point() -> None:
    content = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nDATA ascii\n1 2 3\nnan nan nan\nnan 5 6\n"
    rows = read_pcd(content)
    assert seen(rows).tolist() == [True, False, True]
    assert read_pcd(b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA binary\n").shape == (0, 3)


_XYZ = b"property float x\nproperty float y\nproperty float z\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 1\n" + _XYZ + b"end_header\n1 2 3\n"
PCD = (
    b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
)
COMPRESSED = PCD.replace(b"ascii\n1 2 3\n", b"binary_compressed\n")


def sized(packed: int, size: int) -> bytes:
    return packed.to_bytes(4, "little") + size.to_bytes(4, "little")


LIES: dict[str, tuple[Reader, bytes, str]] = {
    "no PLY": (read_ply, b"solid cube", "does not begin"),
    "PLY without an end": (read_ply, PLY[:40], "end_header"),
    "PLY header without an end": (read_ply, b"ply\n" + b"comment x\n" * 100_000, "end_header"),
    "PLY header that is no text": (read_ply, b"ply\n\xff\n", "end_header"),
    "PLY of no format": (read_ply, PLY.replace(b"format ascii 1.0\n", b""), "format"),
    "PLY of another format": (read_ply, PLY.replace(b"ascii", b"binary_middle"), "binary_middle"),
    "PLY of a word for a count": (read_ply, PLY.replace(b"vertex 1", b"vertex one"), "whole number"),
    "PLY of a negative count": (read_ply, PLY.replace(b"vertex 1", b"vertex -1"), "whole number"),
    "PLY of a count with many digits": (read_ply, PLY.replace(b"vertex 1", b"vertex " + b"9" * 5000), "digits"),
    "PLY of a trillion text points": (read_ply, PLY.replace(b"vertex 1", b"vertex 999999999999"), "cut off"),
    "PLY of a trillion binary points": (
        read_ply,
        PLY.replace(b"vertex 1", b"vertex 999999999999").replace(b"ascii", b"binary_little_endian"),
        "cut off",
    ),
    "PLY behind a trillion other rows": (
        read_ply,
        PLY.replace(b"element vertex", b"element pad 999999999999\nproperty double a\nelement vertex").replace(
            b"ascii", b"binary_big_endian"
        ),
        "cut off",
    ),
    "PLY behind other rows that are not there": (
        read_ply,
        PLY.replace(b"element vertex", b"element pad 999999999999\nproperty double a\nelement vertex"),
        "0 rows",
    ),
    "PLY of an unknown type": (read_ply, PLY.replace(b"float x", b"half x"), "half x"),
    "PLY of a property of nothing": (read_ply, PLY.replace(b"element vertex 1\n", b""), "means nothing"),
    "PLY of lists": (read_ply, PLY.replace(b"float x", b"list uchar int x"), "list"),
    "PLY of lists in binary": (
        read_ply,
        PLY.replace(b"float z\n", b"float z\nproperty list uchar int l\n").replace(b"ascii", b"binary_little_endian"),
        "list",
    ),
    "PLY without vertices": (read_ply, PLY.replace(b"vertex", b"face"), "no element"),
    "PLY without z": (read_ply, PLY.replace(b"float z", b"float w"), "no property z"),
    "PLY of words": (read_ply, PLY.replace(b"1 2 3", b"1 2 c"), "numbers"),
    "PLY of bytes": (read_ply, PLY.replace(b"1 2 3", b"1 2 \xff"), "numbers"),
    "PLY of pairs": (read_ply, PLY.replace(b"1 2 3", b"1 2    "), "numbers"),
    "PLY of one endless line": (read_ply, PLY[:-1] + b" 1" * 200_000, "line of over"),
    "PLY of empty lines": (read_ply, PLY.replace(b"1 2 3", b"\n" * 1_000_000), "0 rows"),
    "PCD without DATA": (read_pcd, PCD[:60], "DATA"),
    "PCD of other data": (read_pcd, PCD.replace(b"ascii", b"binary_encrypted"), "binary_encrypted"),
    "PCD without fields": (read_pcd, PCD.replace(b"FIELDS x y z\n", b""), "FIELDS"),
    "PCD of fields without sizes": (read_pcd, PCD.replace(b"SIZE 4 4 4", b"SIZE 4 4"), "differ in length"),
    "PCD of an odd size": (read_pcd, PCD.replace(b"SIZE 4 4 4", b"SIZE 4 4 3"), "SIZE 3"),
    "PCD of an odd type": (read_pcd, PCD.replace(b"TYPE F F F", b"TYPE F F O"), "no number"),
    "PCD without z": (read_pcd, PCD.replace(b"x y z", b"x y w"), "no field z"),
    "PCD of several x": (read_pcd, PCD.replace(b"COUNT 1", b"COUNT 2"), "COUNT 2"),
    "PCD of a word for a count": (read_pcd, PCD.replace(b"POINTS 1", b"POINTS 1e9"), "whole number"),
    "PCD of no size at all": (read_pcd, PCD.replace(b"POINTS 1\n", b"").replace(b"WIDTH 1\n", b""), "WIDTH"),
    "PCD of a trillion text points": (read_pcd, PCD.replace(b"POINTS 1", b"POINTS 999999999999"), "cut off"),
    "PCD of a trillion binary points": (
        read_pcd,
        PCD.replace(b"POINTS 1", b"POINTS 999999999999").replace(b"ascii", b"binary"),
        "cut off",
    ),
    "PCD of points of a gigabyte": (
        read_pcd,
        PCD.replace(b"x y z", b"x y z w").replace(b"4 4 4", b"4 4 4 8").replace(b"F F F", b"F F F F")
        .replace(b"1 1 1", b"1 1 1 999999999"),
        "limit 1048576",
    ),
    "PCD compressed to nothing": (read_pcd, COMPRESSED, "cut off"),
    "PCD compressed to a part": (read_pcd, COMPRESSED + sized(100, 12), "cut off"),
    "PCD that expands to another size": (read_pcd, COMPRESSED + sized(4, 99) + bytes(4), "claim"),
    "PCD that expands too much": (
        read_pcd,
        COMPRESSED.replace(b"POINTS 1", b"POINTS 100000000") + sized(4, 1_200_000_000) + bytes(4),
        "claim",
    ),
    "PCD that expands to less": (read_pcd, COMPRESSED + sized(4, 12) + b"\x00a\x00b", "does not become"),
    "PCD of bad back references": (read_pcd, COMPRESSED + sized(4, 12) + b"\xff\xff\xff\xff", "PCD's compressed data"),
}  # fmt: skip


@pytest.mark.parametrize("case", LIES)
def test_a_file_that_lies_is_refused_before_anything_of_the_claimed_size_is_made(case: str) -> None:
    reader, content, words = LIES[case]
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableFile, match=words):
            reader(content)
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("layout", ["text", "<"])
def test_more_points_than_the_limit_are_refused(layout: str) -> None:
    content = ply(np.zeros((11, 3), np.float32), layout)
    with pytest.raises(TooManyPoints, match=r"11 points \(limit 10\)"):
        read_ply(content, 10)
    for encoding in (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED):
        with pytest.raises(TooManyPoints, match=r"11 points \(limit 10\)"):
            read_pcd(pcd(np.zeros((11, 3), np.float32), encoding), 10)


def test_a_compressed_pcd_expands_to_so_many_bytes_a_point_and_no_more() -> None:
    columns = np.zeros((1000, 3 + 40), np.float32)
    file = io.BytesIO()
    names = ("x", "y", "z", *(f"f{number}" for number in range(40)))
    PointCloud.from_points(columns, names, [np.float32] * 43).save(file, Encoding.BINARY_COMPRESSED)
    assert len(read_pcd(file.getvalue(), 10_000)) == 1000
    with pytest.raises(UnreadableFile, match=r"172000 bytes \(limit 64000\)"):
        read_pcd(file.getvalue(), 1000)


@settings(max_examples=40)
@given(st.data())
def test_a_damaged_file_raises_nothing_else(data: st.DataObject) -> None:
    encodings = (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED)
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    files = [(read_ply, ply(points, layout, True)) for layout in ("text", "<")]
    files += [(read_pcd, pcd(points, encoding)) for encoding in encodings]
    reader, good = data.draw(st.sampled_from(files))
    content = bytearray(good[: data.draw(st.integers(0, len(good)))])
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = reader(bytes(content), 1000)
    except (UnreadableFile, TooManyPoints):
        return
    assert found.shape[1:] == (3,)


def test_what_is_no_cloud_file_is_not_taken_for_one() -> None:
    for content, looks in itertools.product((b"", b"ply", b"plyx\n", b"\x89PNG", b"FIELD"), (is_ply, is_pcd)):
        assert not looks(content)
