"""Request bodies that no honest client sends: valid ones of every content type, damaged in every way that we know."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

INFER = "/v2/models/tesnet/infer"
BOUNDARY = "fuzz"


@dataclass(frozen=True, slots=True)
class Hostile:
    """A request that the service must refuse, or answer, in good order."""

    path: str
    body: bytes
    headers: dict[str, str] = field(default_factory=dict)


def corpus(seed: int) -> Iterator[Hostile]:
    """Hostile requests without end; the same for the same seed."""
    rng = np.random.default_rng(seed)
    honest = _honest()
    damages = (_cut, _flip, _insert, _repeat, _swap_numbers, _replace, _lengthen)
    yield from _bombs()
    while True:
        request = honest[rng.integers(len(honest))]
        body = request.body
        for _ in range(int(rng.integers(1, 4))):
            body = damages[rng.integers(len(damages))](body, rng)
        headers = dict(request.headers)
        if rng.random() < 0.1:
            headers["Content-Type"] = honest[rng.integers(len(honest))].headers["Content-Type"]
        if rng.random() < 0.05:
            headers["X-Request-Timeout"] = str(rng.choice(["0.001", "0.05", "-1", "nan", "1e9"]))
        yield Hostile(request.path, body, headers)


def _honest() -> list[Hostile]:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.04, -0.04, 0.46], [0.04, 0.04, 0.54], (400, 3)).astype(np.float32)
    array = io.BytesIO()
    np.save(array, points, allow_pickle=False)
    options = {"up": [0, 0, 1], "max_grasps": 3, "max_candidates": 100, "workspace": {"min": [-1] * 3, "max": [1] * 3}}
    json_body = json.dumps({"points": points[:50].round(4).tolist(), **options}).encode()
    tensor = {"name": "points", "datatype": "FP32", "shape": [50, 3]}
    inline = {"parameters": {"up": "[0,0,1]"}, "inputs": [tensor | {"data": points[:50].ravel().tolist()}]}
    head = json.dumps({"inputs": [tensor | {"parameters": {"binary_data_size": 600}}]}).encode()
    depth = {"intrinsics": {"fx": 60, "fy": 60, "cx": 16, "cy": 12}, "max_candidates": 100}
    forms = [
        _form(("cloud", "a.npy", array.getvalue()), ("options", None, json.dumps(options).encode())),
        _form(("cloud", "a.ply", _ply(points)), ("options", None, b"{}")),
        _form(("cloud", "a.pcd", _pcd(points)), ("options", None, b'{"unseen": "occupied"}')),
        _form(("depth", "d.png", _png(32, 24)), ("options", None, json.dumps(depth).encode())),
    ]
    form_type = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
    return [
        Hostile("/grasps", json_body, {"Content-Type": "application/json"}),
        Hostile(
            "/grasps?up=[0,0,1]&max_candidates=100", points.tobytes(), {"Content-Type": "application/octet-stream"}
        ),
        Hostile("/grasps?unseen=occupied", array.getvalue(), {"Content-Type": "application/x-npy"}),
        *(Hostile("/grasps", form, form_type) for form in forms),
        Hostile(INFER, json.dumps(inline).encode(), {"Content-Type": "application/json"}),
        Hostile(
            INFER,
            head + points[:50].tobytes(),
            {"Content-Type": "application/octet-stream", "Inference-Header-Content-Length": str(len(head))},
        ),
    ]


def _bombs() -> Iterator[Hostile]:
    """Small bodies that claim, or would expand to, something huge."""
    as_json, as_npy = {"Content-Type": "application/json"}, {"Content-Type": "application/x-npy"}
    form_type = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
    yield Hostile("/grasps", b"[" * 500_000, as_json)
    yield Hostile("/grasps", b'{"points": ' + b"[" * 500_000 + b"]" * 500_000 + b"}", as_json)
    yield Hostile("/grasps", b'{"points": [[0,0,1e' + b"9" * 100_000 + b"]]}", as_json)
    yield Hostile("/grasps", b'{"points": [' + b"[0,0,1]," * 200_000 + b"[0,0]]}", as_json)
    yield Hostile("/grasps", b"{" + b'"seed":1,' * 100_000 + b'"seed":1}', as_json)
    yield Hostile(INFER, b'{"inputs": [' + b"{}," * 300_000 + b"{}]}", as_json)
    yield Hostile(INFER, b'{"parameters": {' + b'"a":1,' * 300_000 + b'"a":1}}', as_json)
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999, 3)}\n"
    yield Hostile("/grasps", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header, as_npy)
    pixels = _form(("depth", "d.png", _png(32, 24, claimed=(60_000, 60_000))), ("options", None, b"{}"))
    yield Hostile("/grasps", pixels, form_type)
    expanding = _form(("depth", "d.png", _png(4000, 4000)), ("options", None, b'{"intrinsics": {}}'))
    yield Hostile("/grasps", expanding, form_type)
    ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n"
    yield Hostile("/grasps", _form(("cloud", "a.ply", ply), ("options", None, b"{}")), form_type)
    yield Hostile("/grasps", (f"--{BOUNDARY}\r\n" * 100_000).encode(), form_type)


def _form(*parts: tuple[str, str | None, bytes]) -> bytes:
    lines = []
    for name, filename, content in parts:
        file = f'; filename="{filename}"' if filename else ""
        lines += [f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'.encode(), content]
        lines += [b"\r\n"]
    return b"".join([*lines, f"--{BOUNDARY}--\r\n".encode()])


def _ply(points: NDArray[np.float32]) -> bytes:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return head.encode() + points.tobytes()


def _pcd(points: NDArray[np.float32]) -> bytes:
    count = len(points)
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\n"
    return f"{head}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n".encode() + points.tobytes()


def _png(width: int, height: int, claimed: tuple[int, int] | None = None) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = b"\0" + b"\x01\xf4" * width
    size = struct.pack(">IIBBBBB", *(claimed or (width, height)), 16, 0, 0, 0, 0)
    content = chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(row * height)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + content


def _cut(body: bytes, rng: np.random.Generator) -> bytes:
    return body[: rng.integers(len(body) + 1)]


def _flip(body: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(body)
    for place in rng.integers(0, max(1, len(body)), int(rng.integers(1, 20))):
        if damaged:
            damaged[place] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def _insert(body: bytes, rng: np.random.Generator) -> bytes:
    place = rng.integers(len(body) + 1)
    return body[:place] + rng.bytes(int(rng.integers(1, 64))) + body[place:]


def _repeat(body: bytes, rng: np.random.Generator) -> bytes:
    start, end = sorted(rng.integers(0, len(body) + 1, 2))
    return body[:end] + body[start:end] * int(rng.integers(1, 5)) + body[end:]


def _swap_numbers(body: bytes, rng: np.random.Generator) -> bytes:
    worse = rng.choice(
        [b"1e308", b"-1", b"NaN", b"null", b'"1"', b"[]", b"99999999999999999999", b"0.0000001", b"true"]
    )
    digit = str(rng.integers(10)).encode()
    return body.replace(digit, bytes(worse), int(rng.integers(1, 4)))


def _replace(body: bytes, rng: np.random.Generator) -> bytes:
    words = (b"points", b"inputs", b"FP32", b"float", b"max", b"up", b"options", b"shape", b"x y z", b"vertex")
    return body.replace(words[rng.integers(len(words))], words[rng.integers(len(words))], 1)


def _lengthen(body: bytes, rng: np.random.Generator) -> bytes:
    return body + rng.bytes(int(rng.integers(1, 4096)))
