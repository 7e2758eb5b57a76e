"""Clients that are not Python really run: curl and Node's fetch."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import PATIENCE_S

QUERY = "viewpoint=[0.35,0,0.5]&up=[0,0,1]&max_candidates=200&max_grasps=3&frame_convention=panda"

NODE = """
const [url, path] = process.argv.slice(1);
const points = new Float32Array(require("fs").readFileSync(path).buffer.slice(0));
const triples = [];
for (let i = 0; i < points.length; i += 3) triples.push([points[i], points[i + 1], points[i + 2]]);
const options = {viewpoint: [0.35, 0, 0.5], up: [0, 0, 1], max_candidates: 200, max_grasps: 3};
const query = new URLSearchParams(Object.entries(options).map(([name, value]) => [name, JSON.stringify(value)]));
async function post(address, type, body) {
  const answer = await fetch(address, {method: "POST", headers: {"Content-Type": type}, body});
  return {status: answer.status, type: answer.headers.get("content-type"), body: await answer.json()};
}
(async () => {
  const octets = await post(`${url}/grasps?${query}`, "application/octet-stream", Buffer.from(points.buffer));
  const json = await post(`${url}/grasps`, "application/json", JSON.stringify({points: triples, ...options}));
  const bad = await post(`${url}/grasps`, "application/json", JSON.stringify({points: triples, max_grasps: 0}));
  console.log(JSON.stringify({octets, json, bad}));
})();
"""


@pytest.fixture
def cloud_file(cloud: NDArray[np.float32], tmp_path: Path) -> Path:
    path = tmp_path / "cloud.f32"
    path.write_bytes(cloud.tobytes())
    return path


def curl(*arguments: str) -> str:
    command = ["curl", "--silent", "--show-error", "--max-time", f"{PATIENCE_S:g}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.needs("curl")
def test_curl_posts_a_file(service_url: str, cloud_file: Path) -> None:
    answer: dict[str, Any] = json.loads(
        curl(
            "--globoff",
            "--header",
            "Content-Type: application/octet-stream",
            "--data-binary",
            f"@{cloud_file}",
            f"{service_url}/grasps?{QUERY}",
        )
    )
    assert len(answer["grasps"]) == answer["counts"]["returned"] > 0


@pytest.mark.needs("curl")
def test_curl_posts_json_from_a_shell(service_url: str) -> None:
    body = '{"points": [[0, 0, 0.5], [0.01, 0, 0.5]], "up": [0, 0, 1]}'
    answer = json.loads(curl("--json", body, f"{service_url}/grasps"))
    assert answer["reason"] == "too_few_points"


@pytest.mark.needs("curl")
def test_curl_reads_the_413_of_a_stream_that_is_too_large(service_url: str, tmp_path: Path) -> None:
    large = tmp_path / "large.f32"
    with large.open("wb") as file:
        file.truncate(70 * 2**20)
    headers = ["--header", "Content-Type: application/octet-stream", "--header", "Transfer-Encoding: chunked"]
    answer = json.loads(curl(*headers, "--data-binary", f"@{large}", f"{service_url}/grasps"))
    assert answer["status"] == 413


@pytest.mark.needs("node")
def test_node_posts_both_kinds_of_body_and_reads_a_problem(service_url: str, cloud_file: Path) -> None:
    ended = subprocess.run(
        ["node", "--eval", NODE, service_url, str(cloud_file)],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    )
    answers = json.loads(ended.stdout)
    assert answers["octets"]["status"] == answers["json"]["status"] == 200
    assert answers["octets"]["body"]["grasps"] == answers["json"]["body"]["grasps"] != []
    assert answers["bad"]["status"] == 422
    assert answers["bad"]["type"] == "application/problem+json"
    assert answers["bad"]["body"]["field"] == "max_grasps"
