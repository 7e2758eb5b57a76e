"""The viewer's page: its parts, the points that it draws, and the page itself in a real browser."""

from __future__ import annotations

import html
import json
import re
import subprocess
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from service.viewer import ADDRESS, PAGE_PATHS
from tests.conftest import PATIENCE_S
from tests.depth_scene import box_on_table

FOLDER = Path(__file__).resolve().parents[2] / "service" / "viewer"


def browse(url: str, *arguments: str) -> str:
    """What a browser without a window says of a page once its script has nothing left to do."""
    drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=1400,850"]
    command = ["chromium", "--headless=new", "--no-sandbox", *drawing, "--virtual-time-budget=60000", *arguments, url]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True).stdout


def test_the_page_is_made_of_what_the_service_itself_sends(http: httpx.Client) -> None:
    for address in PAGE_PATHS:
        answer = http.get(address)
        assert answer.status_code == 200
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        if not address.endswith(".npy"):
            references = re.findall(r"""(?:href|src|from|fetch\()\s*=?\s*["'](?!data:)([^"']+)""", answer.text)
            assert all(name in PAGE_PATHS or name == "/docs" for name in references), references
            assert "//" not in "".join(references)


@pytest.mark.parametrize("kind", ["octets", "npy", "form"])
def test_points_are_those_of_the_body(http: httpx.Client, cloud: NDArray[np.float32], kind: str) -> None:
    file = BytesIO()
    np.save(file, cloud)
    bodies: dict[str, dict[str, Any]] = {
        "octets": {"content": cloud.tobytes(), "headers": {"Content-Type": "application/octet-stream"}},
        "npy": {"content": file.getvalue(), "headers": {"Content-Type": "application/x-npy"}},
        "form": {"files": {"cloud": ("cloud.npy", file.getvalue())}},
    }
    answer = http.post(f"{ADDRESS}/points", **bodies[kind])
    assert answer.status_code == 200
    np.testing.assert_array_equal(np.frombuffer(answer.content, "<f4").reshape(-1, 3), cloud)


def test_points_of_a_far_cloud_lie_where_the_caller_has_them(http: httpx.Client, cloud: NDArray[np.float32]) -> None:
    far = cloud + np.array([5_400_000.0, -300.0, 70.0])
    file = BytesIO()
    np.save(file, far)
    answer = http.post(f"{ADDRESS}/points", content=file.getvalue(), headers={"Content-Type": "application/x-npy"})
    points = np.frombuffer(answer.content, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, far, atol=0.5)  # as float32 has such numbers
    np.testing.assert_allclose(points[:, 2], far[:, 2], atol=1e-5)


def test_points_of_a_depth_image_are_back_projected(http: httpx.Client) -> None:
    view = box_on_table()
    file = BytesIO()
    Image.fromarray(view.counts).save(file, "PNG")
    form = {"depth": ("depth.png", file.getvalue())}
    answer = http.post(f"{ADDRESS}/points", files=form, data={"options": json.dumps(view.camera)})
    assert answer.status_code == 200
    assert len(answer.content) == 12 * np.count_nonzero(view.counts)


def test_points_are_refused_like_those_for_grasps(http: httpx.Client, serve: Callable[..., Any]) -> None:
    octets = {"Content-Type": "application/octet-stream"}
    for body, status in ((b"", 400), (b"12345", 400), (np.full((9, 3), np.nan, np.float32).tobytes(), 422)):
        refused = http.post(f"{ADDRESS}/points", content=body, headers=octets)
        assert (refused.status_code, refused.headers["Content-Type"]) == (status, "application/problem+json")
    server = serve(max_points=10)
    refused = httpx.post(f"{server.url}{ADDRESS}/points", content=bytes(12 * 11), headers=octets)
    assert refused.status_code == 413
    assert server.endpoint.active == 0


@pytest.mark.needs("chromium")
def test_a_browser_lists_and_draws_the_grasps_of_the_example(service_url: str, tmp_path: Path) -> None:
    query = "viewpoint=[0.38,0.55,0.48]&up=[0,0,1]&support_height=0.05&max_grasps=10"
    body = (FOLDER / "example.npy").read_bytes()
    answer = httpx.post(
        f"{service_url}/grasps?{query}", content=body, headers={"Content-Type": "application/x-npy"}, timeout=PATIENCE_S
    ).json()
    picture = tmp_path / "page.png"
    page = browse(f"{service_url}{ADDRESS}?example", "--dump-dom", f"--screenshot={picture}")
    rows = re.findall(r"<tr[^>]*>((?:<td>[^<]*</td>)+)</tr>", page)
    shown = [re.findall(r"<td>([^<]*)</td>", row)[:2] for row in rows]
    assert shown == [[str(rank), f"{grasp['score']:.3f}"] for rank, grasp in enumerate(answer["grasps"], 1)]
    assert f"10 grasps · {answer['counts']['points']} points" in html.unescape(page)
    with Image.open(picture) as image:
        red, green, blue = np.moveaxis(np.asarray(image.convert("RGB"), dtype=int)[:, :1000], 2, 0)
    chosen_hand = (red > 120) & (red > green + 50) & (green > blue + 50)
    points = (green > red + 30) & (blue > red + 30)
    assert chosen_hand.sum() > 1000
    assert points.sum() > 1000
