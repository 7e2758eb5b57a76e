from __future__ import annotations

import io
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
from pypcd4.pypcd4 import Encoding, PointCloud

from client.cloud_file import CloudFileError, read_cloud

Points = np.ndarray[Any, np.dtype[np.float32]]


def npy(array: Any, *, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


def ply(points: Points, *, text: bool, byte_order: str) -> bytes:
    vertices = np.zeros(len(points), dtype=[("red", "u1"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f8")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    buffer = io.BytesIO()
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], text=text, byte_order=byte_order).write(buffer)
    return buffer.getvalue()


def pcd(points: Points, encoding: str) -> bytes:
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    rows = np.column_stack([points, np.zeros(len(points), np.float32)]).astype("<f4")
    if encoding == "ascii":
        return header + "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows).encode() + b"\n"
    return header + rows.tobytes()


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, "<"), (False, ">")])
def test_ply_of_every_encoding(tmp_path: Path, points: Points, text: bool, byte_order: str) -> None:
    path = tmp_path / "cloud.PLY"
    path.write_bytes(ply(points, text=text, byte_order=byte_order))
    np.testing.assert_allclose(read_cloud(path).points, points, rtol=1e-6)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_pcd_with_the_pixels_that_have_no_depth(tmp_path: Path, points: Points, encoding: str) -> None:
    with_gaps = points.copy()
    with_gaps[::10] = np.nan
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(with_gaps, encoding))
    np.testing.assert_allclose(read_cloud(path).points, with_gaps, rtol=1e-6)


@pytest.mark.parametrize("dtype", ["<f4", ">f8"])
def test_npy(tmp_path: Path, points: Points, dtype: str) -> None:
    path = tmp_path / "cloud.npy"
    path.write_bytes(npy(points.astype(dtype)))
    np.testing.assert_array_equal(read_cloud(path).points.astype(np.float32), points)


@pytest.mark.parametrize(
    "text",
    [
        "# x y z\n1 2 3\n4 5 6\n",
        "// X Y Z R G B\n1\t2 3 255 0 0\n4 5\t6 0 0 0",
        "1,2,3\n\n4, 5, 6\n",
        "1;2;3\r\n4;5;6\r\n",
        "1e0 2.0 +3\n4 5 6 # last",
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".txt"])
def test_text(tmp_path: Path, text: str, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    path.write_text(text)
    np.testing.assert_array_equal(read_cloud(path).points, [[1, 2, 3], [4, 5, 6]])


DAMAGED = {
    "truncated.npy": npy(np.zeros((50, 3)))[:-7],
    "pickled.npy": npy(np.array([{}], dtype=object), allow_pickle=True),
    "bare-pickle.npy": pickle.dumps([1]),
    "words.xyz": b"a b c\n",
    "two-columns.txt": b"1 2\n3 4\n",
    "binary.txt": b"\xff\x00\xfe",
    "header.ply": b"ply\nformat ascii 1.0\nelement vertex",
    "short.ply": ply(np.zeros((9, 3), np.float32), text=False, byte_order="<")[:-8],
    "short-text.ply": ply(np.zeros((9, 3), np.float32), text=True, byte_order="=")[:-20],
    "no-z.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
    "faces-only.ply": b"ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int i\nend_header\n",
    "image.ply": b"\x89PNG\r\n",
    "image.pcd": b"\x89PNG\r\n",
    "header.pcd": b"VERSION 0.7\nFIELDS x y z\n",
    "short.pcd": pcd(np.zeros((9, 3), np.float32), "binary")[:-8],
    "empty.ply": b"",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_one_kind_of_error_that_names_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(DAMAGED[name])
    with pytest.raises(CloudFileError, match=rf"{name}: (cannot be decoded|is empty)"):
        read_cloud(path)


def test_a_missing_file_and_an_unknown_suffix(tmp_path: Path) -> None:
    with pytest.raises(CloudFileError, match=r"absent\.npy: cannot be read: No such file"):
        read_cloud(tmp_path / "absent.npy")
    with pytest.raises(CloudFileError, match=r"'\.npz'; valid: \.npy, \.ply, \.pcd, \.xyz, \.txt"):
        read_cloud(tmp_path / "cloud.npz")


def test_a_compressed_pcd_names_the_package_that_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cloud.pcd"
    points = np.ones((100, 3), np.float32)  # random ones do not compress, and pypcd4 saves them as they are
    PointCloud.from_xyz_points(points).save(path, Encoding.BINARY_COMPRESSED)
    np.testing.assert_array_equal(read_cloud(path).points, points)
    monkeypatch.setitem(sys.modules, "lzf", None)
    with pytest.raises(CloudFileError, match="pip install python-neo-lzf"):
        read_cloud(path)
