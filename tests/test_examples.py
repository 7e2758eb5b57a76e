"""The clients in examples/ really run, against a real server, and all say the same."""

from __future__ import annotations

import json
import re
import subprocess
import threading
from collections.abc import Callable, Sequence
from functools import cache
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import httpx
import numpy as np
import pytest

from client import GraspClient
from tests.conftest import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
SOURCES = {"cpp": EXAMPLES / "cpp" / "grasps.cpp", "rust": EXAMPLES / "rust" / "grasps.rs"}
NEEDS = {"curl": ("curl", "jq"), "node": ("node",), "cpp": ("g++", "libcurl", "nlohmann-json"), "rust": ("rustc",)}


def run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """Builds an example by the command that it documents, once; the program."""

    @cache
    def built(language: str) -> str:
        (documented,) = re.findall(r"^//   ((?:g\+\+|rustc) .*)$", SOURCES[language].read_text("utf-8"), re.MULTILINE)
        program = str(tmp_path_factory.mktemp(language) / "grasps")
        ended = run([program if word == "grasps" else word for word in documented.split()])
        assert (ended.returncode, ended.stderr) == (0, "")
        return program

    return built


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.needs(*needs)) for name, needs in NEEDS.items()])
def example(request: pytest.FixtureRequest, build: Callable[[str], str]) -> list[str]:
    """The command that starts an example, without its arguments."""
    if request.param in SOURCES:
        return [build(request.param)]
    if request.param == "node":
        return ["node", str(EXAMPLES / "node.mjs")]
    return [str(EXAMPLES / "curl.sh")]


def test_an_example_prints_the_best_grasps(example: list[str], service_url: str) -> None:
    with GraspClient(service_url, timeout=PATIENCE_S) as client:
        reply = client.grasps(
            np.load(EXAMPLES / "clutter.npy"),
            viewpoint=(0.38, 0.55, 0.48),
            up=(0, 0, 1),
            support_height=0.05,
            max_grasps=5,
        )
    ended = run([*example, service_url])
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == [
        f"{grasp.score:.2f}  TCP at {' '.join(f'{metres:.3f}' for metres in grasp.position)}"
        f"  opening {grasp.width:.3f} m"
        for grasp in reply.grasps
    ]
    assert len(reply.grasps) == 5


def test_an_example_fails_with_the_detail_of_a_problem(example: list[str], service_url: str, tmp_path: Path) -> None:
    points = np.full((10, 3), np.nan, np.float32)
    detail = httpx.post(
        f"{service_url}/grasps",
        content=points.tobytes(),
        headers={"Content-Type": "application/octet-stream"},
        timeout=PATIENCE_S,
    ).json()["detail"]
    np.save(tmp_path / "bad.npy", points)
    ended = run([*example, service_url, str(tmp_path / "bad.npy")])
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", f"422: {detail}\n")


def test_an_example_says_where_nothing_was_found(example: list[str], service_url: str, tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.ones((1, 3), np.float32))
    ended = run([*example, service_url, str(tmp_path / "one.npy")])
    assert (ended.returncode, ended.stdout) == (0, "no grasps: too_few_points\n")


@pytest.mark.needs(*NEEDS["rust"])
def test_the_rust_example_reads_an_answer_in_chunks(build: Callable[[str], str]) -> None:
    reason = 'two "words", \\ and é \U0001f980'
    text = json.dumps({"warnings": [None, True, []], "grasps": [], "reason": reason}).encode()

    class InChunks(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            for piece in (text[:11], text[11:], b""):
                self.wfile.write(b"%x\r\n%s\r\n" % (len(piece), piece))

    with HTTPServer(("127.0.0.1", 0), InChunks) as server:
        answering = threading.Thread(target=server.handle_request)
        answering.start()
        ended = run([build("rust"), f"http://127.0.0.1:{server.server_port}"])
        answering.join()
    assert (ended.returncode, ended.stdout) == (0, f"no grasps: {reason}\n")
