"""Every format against what plyfile, pypcd4, Open3D and numpy save, and against files that lie."""

from __future__ import annotations

import codecs
import importlib
import io
import itertools
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from pypcd4.pypcd4 import Encoding, PointCloud

from tesnet import formats
from tesnet.errors import InvalidQuery, TooManyPoints, UnreadableFile
from tesnet.formats import NPY, PCD, PLY, TEXT, CloudFile, text
from tesnet.formats import ply as ply_module
from tesnet.formats.cloud_file import given_viewpoint

Array = NDArray[Any]
Reader = Callable[..., CloudFile]
read_npy, read_ply, read_pcd, read_text = (entry.read for entry in (NPY, PLY, PCD, TEXT))

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
    assert formats.format_of(content) is PLY
    np.testing.assert_allclose(read_ply(content, len(points)).points, points, rtol=1e-6)


@settings(max_examples=40)
@given(clouds, st.sampled_from([Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED]))
def test_pcd_of_every_encoding(points: Array, encoding: Encoding) -> None:
    content = pcd(points, encoding)
    assert formats.format_of(content) is PCD
    np.testing.assert_allclose(read_pcd(content, len(points)).points, points, rtol=1e-5, atol=1e-9)


@settings(max_examples=40)
@given(clouds, st.integers(30, 200))
def test_text_is_the_same_however_it_is_cut(points: Array, block: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "_BLOCK", 16 + block * 4)
        np.testing.assert_allclose(read_ply(ply(points, "text", before=True)).points, points, rtol=1e-6)
        lines = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.astype(float).tolist())
        np.testing.assert_array_equal(read_text(lines.encode()).points, points)


def turned(content: bytes, elements: list[plyfile.PlyElement]) -> bytes:
    """A little-endian file as a big-endian one. plyfile writes numbers beside lists in the order of the machine."""
    pieces = [content.partition(b"end_header\n")[0].replace(b"little", b"big"), b"end_header\n"]
    for element in elements:
        for row, column in itertools.product(element.data, element.properties):
            numbers = np.atleast_1d(row[column.name])
            if isinstance(column, plyfile.PlyListProperty):
                pieces.append(np.array(len(numbers), f">{column.len_dtype}").tobytes())
            pieces.append(numbers.astype(f">{column.val_dtype}").tobytes())
    return b"".join(pieces)


@settings(max_examples=60)
@given(clouds, st.sampled_from(["text", "<", ">"]), st.data())
def test_ply_rows_are_told_apart_by_elements_in_any_order_with_lists_of_any_length(
    points: Array, layout: str, data: st.DataObject
) -> None:
    lengths = st.lists(st.integers(0, 4), min_size=1, max_size=8)
    vertices = np.zeros(len(points), [("seen_by", "O"), ("x", "f8"), ("y", "f4"), ("z", "f8"), ("label", "u2")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    vertices["seen_by"] = [np.zeros(data.draw(st.integers(0, 2)), "u1") for _ in points]
    elements = [plyfile.PlyElement.describe(vertices, "vertex", len_types={"seen_by": "u2"})]
    for name in ("face", "edge"):
        table = np.zeros(len(rows := data.draw(lengths)), [("first", "O"), ("weight", "f4"), ("second", "O")])
        table["first"] = [np.arange(length, dtype="i4") for length in rows]
        table["second"] = [np.arange(length, dtype="f8") for length in reversed(rows)]
        elements.append(plyfile.PlyElement.describe(table, name))
    file = io.BytesIO()
    ordered = data.draw(st.permutations(elements))
    plyfile.PlyData(ordered, text=layout == "text", byte_order="=" if layout == "text" else "<").write(file)
    content = file.getvalue()
    if layout == ">":
        content = turned(content, ordered)
    if layout == "text":
        head, rows_of_text = content.split(b"end_header\n")
        gaps = st.sampled_from([b" ", b"\n", b"  ", b"\r\n", b"\n\n"])
        words = [word + data.draw(gaps) for word in rows_of_text.split()]
        content = head + b"end_header\n" + b"".join(words)
    np.testing.assert_allclose(read_ply(content).points, points, rtol=1e-6)


@settings(max_examples=60)
@given(clouds, st.binary(max_size=40), st.sampled_from(["", "utf-8", "utf-16-le", "utf-16-be"]), st.data())
def test_headers_hold_comments_of_any_encoding_and_begin_with_any_mark(
    points: Array, comment: bytes, encoding: str, data: st.DataObject
) -> None:
    comment = comment.replace(b"\n", b" ").replace(b"\r", b" ")
    end = data.draw(st.sampled_from([b"\n", b"\r\n", b"\r"]))
    rows = end.join(" ".join(map(repr, row)).encode() for row in points.astype(float).tolist())
    count = str(len(points)).encode()
    ply_lines = [b"ply", b"comment " + comment, b"format ascii 1.0", b"element vertex " + count, *_XYZ.splitlines()]
    pcd_lines = [b"# " + comment, b"#", b"VERSION 0.7", b"FIELDS x y z", b"SIZE 4 4 4", b"TYPE F F F"]
    pcd_lines += [b"WIDTH " + count, b"HEIGHT 1", b"DATA ascii"]
    for lines, entry in (([*ply_lines, b"end_header"], PLY), (pcd_lines, PCD), ([b"# " + comment], TEXT)):
        content = end.join([*lines, rows])
        if encoding == "utf-8":
            content = codecs.BOM_UTF8 + content
        elif encoding:
            content = ("\ufeff" + content.decode("latin-1")).encode(encoding)
        assert formats.format_of(content) is entry
        np.testing.assert_allclose(formats.read(content).points, points, rtol=1e-6)


def test_a_vertex_may_stand_on_two_lines_and_a_line_may_hold_further_numbers() -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 3\n" + _XYZ + b"property uchar red\nend_header\n"
    two_lines = header + b"1 2 3\n9\n4 5 6\n9\n7 8 9\n9\n"
    further = header + b"1 2 3 9 0 0 0\n\n4 5 6 9 0 0 0\n7 8 9 9 0 0 0\n"
    one_line = header + b"1 2 3 9 4 5 6 9 7 8 9 9"
    for content in (two_lines, further, one_line):
        np.testing.assert_array_equal(read_ply(content).points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_windows_lines_empty_lines_comments_and_further_columns_are_read() -> None:
    content = (
        b"ply\r\nformat ascii 1.0\r\ncomment by hand\r\nobj_info none\r\nelement vertex 2\r\n"
        b"property float x\r\n"
        b"property float y\r\nproperty float z\r\nend_header\r\n1 2 3\r\n\r\n  4 5 6 7\r\n"
    )
    np.testing.assert_array_equal(read_ply(content).points, [[1, 2, 3], [4, 5, 6]])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_pcd_s_fields_are_found_wherever_they_stand_and_however_many_numbers_others_have(data: st.DataObject) -> None:
    """Written here number by number: descriptors of several numbers, any order, any type, all three encodings."""
    kinds = st.sampled_from(["F4", "F8", "U1", "U2", "U4", "I1", "I2", "I4"])
    has_normals = data.draw(st.booleans())
    wanted = ["x", "y", "z", *(("normal_x", "normal_y", "normal_z") if has_normals else ())]
    others = [f"f{number}" for number in range(data.draw(st.integers(0, 4)))]
    names = data.draw(st.permutations([*wanted, *others]))
    fields = [
        (name, data.draw(st.sampled_from(["F4", "F8"]) if name in wanted else kinds),
         1 if name in wanted else data.draw(st.integers(1, 5)))
        for name in names
    ]  # fmt: skip
    count = data.draw(st.integers(1, 6))
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    values = {
        name: rng.integers(1, 100, (count, numbers)).astype(f"<{kind[0].lower()}{kind[1]}")
        for name, kind, numbers in fields
    }
    tells_counts = data.draw(st.booleans()) or any(numbers != 1 for _, _, numbers in fields)
    encoding = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    if encoding == "ascii":
        rows = ("\n".join(" ".join(str(v) for n in names for v in values[n][row]) for row in range(count))).encode()
    elif encoding == "binary":
        rows = b"".join(values[name][row].tobytes() for row in range(count) for name in names)
    else:
        whole = b"".join(values[name].tobytes() for name in names)
        packed = importlib.import_module("lzf").compress(whole)
        packed = b"".join(b"\x00" + whole[n : n + 1] for n in range(len(whole))) if packed is None else packed
        rows = sized(len(packed), len(whole)) + packed
    size = [f"WIDTH {count}", "HEIGHT 1", f"POINTS {count}"]
    if data.draw(st.booleans()):
        size = [f"WIDTH {count}", "HEIGHT 1"]
    lines = [
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(kind[1] for _, kind, _ in fields)}",
        f"TYPE {' '.join(kind[0] for _, kind, _ in fields)}",
        *([f"COUNT {' '.join(str(numbers) for _, _, numbers in fields)}"] if tells_counts else []),
        *size,
        f"DATA {encoding}",
    ]
    found = read_pcd("\n".join([*lines, ""]).encode() + rows, count if encoding != "binary_compressed" else None)
    np.testing.assert_array_equal(found.points, np.column_stack([values[name] for name in "xyz"]))
    if has_normals:
        assert found.normals is not None
        np.testing.assert_array_equal(found.normals, np.column_stack([values[f"normal_{name}"] for name in "xyz"]))
    else:
        assert found.normals is None
    with pytest.raises(TooManyPoints):
        read_pcd("\n".join([*lines, ""]).encode() + rows, count - 1)


def test_an_organised_pcd_has_rows_without_a_point() -> None:
    content = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nDATA ascii\n1 2 3\nnan nan nan\nnan 5 6\n"
    np.testing.assert_array_equal(read_pcd(content).points, [[1, 2, 3], [np.nan] * 3, [np.nan, 5, 6]])
    assert read_pcd(b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA binary\n").points.shape == (0, 3)


@pytest.mark.parametrize("comment", ["", " # a note", "\t// another"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("between", [" ", "   ", "\t", ",", ";", " , ", "; ", ";\t"])
def test_text_is_the_same_whatever_separates_its_columns_and_lines(between: str, end: str, comment: str) -> None:
    rows = [[0.5, -1.25, 2e-3, 255.0], [1.0, 2.0, 3.0, 0.0]]
    lines = "".join(between.join(map(str, row)) + comment + end for row in rows).encode()
    assert formats.format_of(lines) is TEXT
    np.testing.assert_array_equal(read_text(lines).points, np.array(rows)[:, :3])


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("as_text", [True, False])
def test_normals_are_those_that_open3d_saves(tmp_path: Path, suffix: str, as_text: bool) -> None:
    open3d = importlib.import_module("open3d")  # not at the top: it needs system libraries
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(2, 50, 3))
    normals[7] = 0
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    path = tmp_path / f"cloud{suffix}"
    open3d.io.write_point_cloud(str(path), cloud, write_ascii=as_text)
    found = formats.read(path.read_bytes())
    np.testing.assert_allclose(found.points, points, atol=1e-5)
    assert found.normals is not None
    np.testing.assert_allclose(found.normals, normals, atol=1e-5)


def test_normals_that_are_not_finite_are_none_and_all_zeros_are_no_normals() -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 2\n" + _XYZ + _XYZ.replace(b"float ", b"float n") + b"end_header\n"
    found = read_ply(header + b"1 2 3 nan 0 1\n4 5 6 0 1 0\n")
    assert found.normals is not None
    np.testing.assert_array_equal(found.normals, [[0, 0, 0], [0, 1, 0]])
    assert read_ply(header + b"1 2 3 0 0 0\n4 5 6 0 0 0\n").normals is None


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED])
def test_the_viewpoint_of_a_pcd_is_where_its_camera_stood(encoding: Encoding) -> None:
    cloud = PointCloud.from_xyz_points(np.ones((9, 3), np.float32))
    found = []
    for position in ((0.5, -0.25, 2.0), (0.0, 0.0, 0.0)):
        cloud.metadata.viewpoint = (*position, 1.0, 0.0, 0.0, 0.0)
        file = io.BytesIO()
        cloud.save(file, encoding)
        found.append(read_pcd(file.getvalue()).viewpoint)
    np.testing.assert_array_equal(found[0], [0.5, -0.25, 2.0])
    assert found[1] is None


@pytest.mark.parametrize("layout", ["text", "<"])
def test_the_viewpoint_of_a_ply_is_that_of_its_camera(layout: str) -> None:
    vertices = np.zeros(3, [(name, "f4") for name in "xyz"])
    camera = np.array([(1.0, 2.0, 3.0, 4)], [("view_px", "f4"), ("view_py", "f4"), ("view_pz", "f4"), ("width", "i4")])
    elements = [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(camera, "camera")]
    file = io.BytesIO()
    plyfile.PlyData(elements, text=layout == "text", byte_order="=" if layout == "text" else layout).write(file)
    np.testing.assert_array_equal(read_ply(file.getvalue()).viewpoint, [1, 2, 3])


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8"])
@pytest.mark.parametrize("shape", [(6, 3), (2, 3, 3)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_of_rows_and_of_images_in_either_order(dtype: str, shape: tuple[int, ...], order: Any) -> None:
    array = np.asarray(np.arange(18).reshape(shape), dtype, order=order)
    file = io.BytesIO()
    np.save(file, array)
    found = formats.read(file.getvalue())
    np.testing.assert_array_equal(found.points, array.reshape(-1, 3))
    with pytest.raises(TooManyPoints, match=r"6 points \(limit 5\)"):
        read_npy(file.getvalue(), 5)


@pytest.mark.parametrize("array", [np.zeros((3, 3), np.int32), np.zeros(9), np.zeros((2, 4)), np.zeros((1, 2, 3, 3))])
def test_an_npy_of_something_else_names_what_to_save(array: Array) -> None:
    file = io.BytesIO()
    np.save(file, array)
    with pytest.raises(InvalidQuery, match="save"):
        read_npy(file.getvalue())


def test_the_table_names_each_suffix_once() -> None:
    assert formats.SUFFIXES == (".npy", ".ply", ".pcd", ".xyz", ".txt")
    assert formats.LISTED == ".npy, .ply, .pcd, .xyz or .txt"


_XYZ = b"property float x\nproperty float y\nproperty float z\n"
PLY_FILE = b"ply\nformat ascii 1.0\nelement vertex 1\n" + _XYZ + b"end_header\n1 2 3\n"
PCD_FILE = (
    b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
)


PLY_NUMBERS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""The format's names of types, as its authors and as later writers have them."""


def ends_of(kind: str) -> Array:
    """One point with the least and the largest number of a type, and with one between."""
    dtype = np.dtype(kind)
    ends = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
    return np.array([[ends.min, 1, ends.max]], dtype)


@pytest.mark.parametrize("name", PLY_NUMBERS)
@pytest.mark.parametrize(("layout", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_a_ply_holds_numbers_of_every_type_to_the_ends_of_its_range(name: str, layout: str, order: str) -> None:
    point = ends_of(order + PLY_NUMBERS[name])
    head = f"ply\nformat {layout} 1.0\nelement vertex 1\n" + _XYZ.decode().replace("float", name) + "end_header\n"
    np.testing.assert_array_equal(read_ply(head.encode() + point.tobytes()).points, point)


@pytest.mark.parametrize("name", ["char", "uchar", "short", "ushort", "int", "uint"])
def test_a_list_of_a_ply_is_as_long_as_the_type_of_its_length_allows(name: str) -> None:
    length = np.array(min(np.iinfo(PLY_NUMBERS[name]).max, 70_000), "<" + PLY_NUMBERS[name])
    head = f"element before 1\nproperty list {name} uchar l\nelement vertex 1\n".encode() + _XYZ
    point = np.array([[1, 2, 3]], "<f4")
    data = length.tobytes() + bytes(int(length)) + point.tobytes()
    content = b"ply\nformat binary_little_endian 1.0\n" + head + b"end_header\n" + data
    np.testing.assert_array_equal(read_ply(content).points, point)


@pytest.mark.parametrize("kind", ["F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"])
@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_a_pcd_holds_numbers_of_every_type_to_the_ends_of_its_range(kind: str, encoding: str) -> None:
    point = ends_of("<" + kind.lower())
    head = PCD_FILE.replace(b"SIZE 4 4 4", f"SIZE {' '.join(3 * kind[1])}".encode())
    head = head.replace(b"TYPE F F F", f"TYPE {' '.join(3 * kind[0])}".encode())
    data = point.tobytes()
    if encoding == "binary_compressed":
        packed = bytes([len(data) - 1]) + data  # as LZF has bytes that do not repeat
        data = len(packed).to_bytes(4, "little") + len(data).to_bytes(4, "little") + packed
    content = head.replace(b"DATA ascii\n1 2 3\n", f"DATA {encoding}\n".encode() + data)
    np.testing.assert_array_equal(read_pcd(content).points, point)


COMPRESSED = PCD_FILE.replace(b"ascii\n1 2 3\n", b"binary_compressed\n")


def sized(packed: int, size: int) -> bytes:
    return packed.to_bytes(4, "little") + size.to_bytes(4, "little")


def test_of_a_long_header_the_message_gives_eighty_characters() -> None:
    with pytest.raises(UnreadableFile) as refused:
        read_npy(npy_header((-1,) * 60))
    shown = str(refused.value).partition("negative size: ")[2].partition("; save")[0]
    assert len(shown) == 80
    assert shown.endswith("...")
    with pytest.raises(UnreadableFile, match=r"negative size: \(-1, 3\); save"):
        read_npy(npy_header((-1, 3)))


def npy_header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    text_of_header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text_of_header).to_bytes(2, "little") + text_of_header


LIES: dict[str, tuple[Reader, bytes, str]] = {
    "no PLY": (read_ply, b"solid cube", "does not begin"),
    "PLY without an end": (read_ply, PLY_FILE[:40], "end_header"),
    "PLY header without an end": (read_ply, b"ply\n" + b"comment x\n" * 100_000, "end_header"),
    "PLY header that is no text": (read_ply, b"ply\n\xff\n", "end_header"),
    "PLY of no format": (read_ply, PLY_FILE.replace(b"format ascii 1.0\n", b""), "format"),
    "PLY of another format": (read_ply, PLY_FILE.replace(b"ascii", b"binary_middle"), "binary_middle"),
    "PLY of a word for a count": (read_ply, PLY_FILE.replace(b"vertex 1", b"vertex one"), "whole number"),
    "PLY of a negative count": (read_ply, PLY_FILE.replace(b"vertex 1", b"vertex -1"), "whole number"),
    "PLY of a count with many digits": (read_ply, PLY_FILE.replace(b"vertex 1", b"vertex " + b"9" * 5000), "digits"),
    "PLY of a trillion text points": (read_ply, PLY_FILE.replace(b"vertex 1", b"vertex 999999999999"), "cut off"),
    "PLY of a trillion binary points": (
        read_ply,
        PLY_FILE.replace(b"vertex 1", b"vertex 999999999999").replace(b"ascii", b"binary_little_endian"),
        "cut off",
    ),
    "PLY behind a trillion other rows": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 999999999999\nproperty double a\nelement vertex").replace(
            b"ascii", b"binary_big_endian"
        ),
        "cut off",
    ),
    "PLY behind other rows that are not there": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 999999999999\nproperty double a\nelement vertex"),
        "cut off",
    ),
    "PLY behind a trillion lists": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 999999999999\nproperty list uchar int a\nelement vertex"),
        "cut off",
    ),
    "PLY of a list of a trillion numbers": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 1\nproperty list uchar int a\nelement vertex").replace(
            b"1 2 3", b"999999999999 2 3"
        ),
        "cut off",
    ),
    "PLY of a list of half a number": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 1\nproperty list uchar int a\nelement vertex").replace(
            b"1 2 3", b"0.5 2 3 4 5"
        ),
        "list of 0.5",
    ),
    "PLY of a list of less than nothing": (
        read_ply,
        PLY_FILE.replace(b"element vertex", b"element pad 1\nproperty list char int a\nelement vertex").replace(
            b"ascii", b"binary_little_endian"
        ).replace(b"1 2 3", b"\xff" * 20),
        "list of -1",
    ),
    "PLY of an unknown type": (read_ply, PLY_FILE.replace(b"float x", b"half x"), "half x"),
    "PLY of a property of nothing": (read_ply, PLY_FILE.replace(b"element vertex 1\n", b""), "means nothing"),
    "PLY of lists": (read_ply, PLY_FILE.replace(b"float x", b"list uchar int x"), "list"),
    "PLY of lists in binary": (
        read_ply,
        PLY_FILE.replace(b"ascii", b"binary_little_endian").replace(
            b"float z\n", b"float z\nproperty list uchar int l\n"
        ),
        "cut off",
    ),
    "PLY without vertices": (read_ply, PLY_FILE.replace(b"vertex", b"face"), "no element"),
    "PLY without z": (read_ply, PLY_FILE.replace(b"float z", b"float w"), "no property z"),
    "PLY of words": (read_ply, PLY_FILE.replace(b"1 2 3", b"1 2 c"), "numbers"),
    "PLY of bytes": (read_ply, PLY_FILE.replace(b"1 2 3", b"1 2 \xff"), "numbers"),
    "PLY of pairs": (read_ply, PLY_FILE.replace(b"1 2 3", b"1 2    "), "cut off"),
    "PLY of one endless line": (read_ply, PLY_FILE[:-1] + b" 1" * 200_000, "line of over"),
    "PLY of empty lines": (read_ply, PLY_FILE.replace(b"1 2 3", b"\n" * 1_000_000), "cut off"),
    "text of words": (read_text, b"1 2 3\n4 five 6\n", "numbers"),
    "text of pairs": (read_text, b"1 2\n", "numbers"),
    "text of nothing": (read_text, b"# x y z\n\n", "no line of numbers"),
    "npy of a trillion points": (read_npy, npy_header((10**12, 3)), "cut off"),
    "npy of less than nothing": (read_npy, npy_header((-1, 3)), "negative size"),
    "npy of objects": (read_npy, npy_header((1, 3), "|O"), "pickled"),
    "npy without a header": (read_npy, b"\x93NUMPY\x01\x00", "header cannot be read"),
    "PCD of a viewpoint of words": (read_pcd, PCD_FILE.replace(b"DATA", b"VIEWPOINT here\nDATA"), "VIEWPOINT"),
    "PCD without DATA": (read_pcd, PCD_FILE[:60], "DATA"),
    "PCD of other data": (read_pcd, PCD_FILE.replace(b"ascii", b"binary_encrypted"), "binary_encrypted"),
    "PCD without fields": (read_pcd, PCD_FILE.replace(b"FIELDS x y z\n", b""), "FIELDS"),
    "PCD of fields without sizes": (read_pcd, PCD_FILE.replace(b"SIZE 4 4 4", b"SIZE 4 4"), "differ in length"),
    "PCD of an odd size": (read_pcd, PCD_FILE.replace(b"SIZE 4 4 4", b"SIZE 4 4 3"), "SIZE 3"),
    "PCD of an odd type": (read_pcd, PCD_FILE.replace(b"TYPE F F F", b"TYPE F F O"), "no number"),
    "PCD without z": (read_pcd, PCD_FILE.replace(b"x y z", b"x y w"), "no field z"),
    "PCD of several x": (read_pcd, PCD_FILE.replace(b"COUNT 1", b"COUNT 2"), "COUNT 2"),
    "PCD of a word for a count": (read_pcd, PCD_FILE.replace(b"POINTS 1", b"POINTS 1e9"), "whole number"),
    "PCD of no size at all": (read_pcd, PCD_FILE.replace(b"POINTS 1\n", b"").replace(b"WIDTH 1\n", b""), "WIDTH"),
    "PCD of a trillion text points": (read_pcd, PCD_FILE.replace(b"POINTS 1", b"POINTS 999999999999"), "cut off"),
    "PCD of a trillion binary points": (
        read_pcd,
        PCD_FILE.replace(b"POINTS 1", b"POINTS 999999999999").replace(b"ascii", b"binary"),
        "cut off",
    ),
    "PCD of points of a gigabyte": (
        read_pcd,
        PCD_FILE.replace(b"x y z", b"x y z w").replace(b"4 4 4", b"4 4 4 8").replace(b"F F F", b"F F F F")
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
    assert len(read_pcd(file.getvalue(), 10_000).points) == 1000
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
    assert found.points.shape[1:] == (3,)


@pytest.mark.parametrize(
    "content", [b"", b"ply", b"plyx\n", b"\x89PNG", b"FIELD", b"{}", b"1 2", b"1 2 c", b"\xff\xfe"]
)
def test_what_is_no_cloud_file_is_not_taken_for_one(content: bytes) -> None:
    assert formats.format_of(content) is None
    with pytest.raises(UnreadableFile, match=r"none of \.npy, \.ply, \.pcd, \.xyz or \.txt"):
        formats.read(content)


@pytest.mark.parametrize("names", ["x,y,z", "X;Y;Z;R;G;B", '"x" "y" "z"', "index,x,y,z", "250", "lengths in metres"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("before", [(), ("# made by hand", ""), ("// x", "#", "")])
def test_a_line_of_names_above_points_is_named_with_the_remedy(before: tuple[str, ...], end: str, names: str) -> None:
    rows = [f"{row / 10},{row / 20},{row / 30}" for row in range(20)]
    with pytest.raises(UnreadableFile) as refused:
        formats.read(end.join([*before, names, *rows, ""]).encode())
    assert f"in line {len(before) + 1}, which is no point; delete it or begin it with #" in str(refused.value)
    assert re.split("[,; ]", names)[0] in str(refused.value)
    assert len(formats.read(end.join([*before, f"# {names}", *rows, ""]).encode()).points) == 20


def test_of_a_long_line_above_points_little_is_repeated_and_of_bytes_nothing() -> None:
    with pytest.raises(UnreadableFile) as refused:
        formats.read(b"word " * 5000 + b"\n1 2 3\n")
    assert len(str(refused.value)) < 250
    with pytest.raises(UnreadableFile, match="none of"):
        formats.read(bytes(range(128, 256)) + b"\n1 2 3\n")


def test_lists_that_change_their_length_too_often_are_refused_before_they_cost_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ply_module, "MAX_LENGTH_CHANGES", 10)
    head = b"ply\nformat ascii 1.0\nelement face 40\nproperty list uchar int i\nelement vertex 1\n" + _XYZ
    with pytest.raises(UnreadableFile, match="changes over 10 times"):
        read_ply(head + b"end_header\n" + b"0 1 7 " * 20 + b"1 2 3")
    np.testing.assert_array_equal(
        read_ply(head + b"end_header\n" + b"0 " * 20 + b"1 7 " * 20 + b"1 2 3").points, [[1, 2, 3]]
    )


@pytest.mark.parametrize(
    ("place", "given"),
    [((0, 0, 0), False), ((0, 0, 1), True), ((1, 0, 0), True), ((0.1, 0.2, 0.3), True), ((np.nan, 1, 1), False)],
)
def test_a_viewpoint_at_the_origin_or_nowhere_is_none(place: tuple[float, float, float], given: bool) -> None:
    found = given_viewpoint(np.array(place))
    assert (found is not None) == given
    if found is not None:
        assert found.tolist() == list(place)
