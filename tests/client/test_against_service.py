"""Both clients and the command against the real service with the shipped weights."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import client
from client.images import png
from tests import depth_scene
from tests.client.conftest import Call
from tests.client.test_cloud_file import ply
from tests.conftest import PATIENCE_S

Points = np.ndarray[Any, np.dtype[np.float32]]
ROOT = Path(__file__).resolve().parents[2]
CAMERA = (0.35, 0.0, 0.45)
QUERY: dict[str, Any] = {"viewpoint": CAMERA, "up": (0, 0, 1), "support_height": 0.0, "max_grasps": 5}


@pytest.fixture(scope="module")
def box_on_table() -> Points:
    """A 5 x 7 x 8 cm box on a table, (N, 3) in metres: the faces that a camera at `CAMERA` sees."""
    rng = np.random.default_rng(1)
    size = np.array([0.05, 0.07, 0.08])
    faces = []
    for axis, side in ((0, 1), (1, 1), (1, -1), (2, 1)):
        face = rng.uniform(-0.5, 0.5, (2500, 3)) * size
        face[:, axis] = 0.5 * side * size[axis]
        face[:, 2] += 0.5 * size[2]
        faces.append(face)
    table = np.column_stack([rng.uniform(-0.15, 0.15, (4000, 2)), np.zeros(4000)])
    return np.concatenate([*faces, table]).astype(np.float32)


def test_the_service_answers_what_the_client_reads(call: Call, service_url: str, box_on_table: Points) -> None:
    reply = call(service_url, "grasps", box_on_table, request_id="from-the-client", **QUERY)
    assert reply.request_id == "from-the-client"
    assert reply.counts.points == len(box_on_table)
    assert 1 <= len(reply) == reply.counts.returned <= 5
    assert reply.reason is None
    assert (np.diff(reply.scores) <= 0).all()
    assert ((reply.scores >= 0) & (reply.scores <= 1)).all()
    for grasp in reply.grasps:
        np.testing.assert_allclose(grasp.pose.inverse().apply(grasp.hand_pose.translation), [0, 0, -0.1034], atol=1e-5)
        np.testing.assert_allclose(grasp.pose.inverse().apply(grasp.pregrasp.translation), [0, 0, -0.05], atol=1e-5)
    assert reply.timings_ms["total"] > 0


def test_both_clients_get_the_same_answer(service_url: str, box_on_table: Points) -> None:
    async def ask() -> client.GraspReply:
        async with client.AsyncGraspClient(service_url, timeout=PATIENCE_S) as opened:
            return await opened.grasps(box_on_table, **QUERY)

    with client.GraspClient(service_url, timeout=PATIENCE_S) as opened:
        reply = opened.grasps(box_on_table, **QUERY)
    np.testing.assert_array_equal(asyncio.run(ask()).poses, reply.poses)


def test_health_and_model(call: Call, service_url: str) -> None:
    call(service_url, "wait_until_ready", PATIENCE_S)
    assert call(service_url, "live") is True
    assert call(service_url, "ready") is True
    model = call(service_url, "model")
    assert model.models[0].name == "tesnet"
    assert len(model.models[0].weights_sha256) == 64
    assert model.limits.max_points == 1_000_000


def test_one_point_is_too_few_and_no_error(call: Call, service_url: str) -> None:
    reply = call(service_url, "grasps", [[0.0, 0.0, 0.5]])
    assert (reply.grasps, reply.reason) == ((), "too_few_points")
    assert len(reply.warnings) >= 1


def test_refusals_are_typed_and_say_value_limit_and_remedy(call: Call, service_url: str, points: Points) -> None:
    with pytest.raises(client.InvalidRequest, match=r"max_grasps.*1000") as caught:
        call(service_url, "grasps", points, max_grasps=1001, request_id="too-many")
    assert caught.value.request_id == "too-many"
    assert caught.value.problem["field"] == "max_grasps"
    with pytest.raises(client.InvalidRequest, match="metres"):
        call(service_url, "grasps", points * 1000)
    with pytest.raises(client.InvalidRequest, match="model"):
        call(service_url, "grasps", points, model="absent")
    with pytest.raises(client.PayloadTooLarge, match=r"1,?000,?000"):
        call(service_url, "grasps", np.zeros((1_000_001, 3), np.float32))


def test_the_command_prints_the_same_grasps(tmp_path: Path, service_url: str, box_on_table: Points) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply(box_on_table, text=False, byte_order="<"))
    camera = [str(coordinate) for coordinate in CAMERA]
    flags = ["--viewpoint", *camera, "--up", "0", "0", "1", "--support-height", "0", "--top-k", "5", "--json"]
    command = [sys.executable, "-m", "client", str(path), "--url", service_url, "--timeout", f"{PATIENCE_S:g}", *flags]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    with client.GraspClient(service_url, timeout=PATIENCE_S) as opened:
        expected = opened.grasps(box_on_table, **QUERY).to_dict()
    assert json.loads(done.stdout)["grasps"] == expected["grasps"]


def test_a_depth_image_with_a_mask_gives_grasps_on_the_object(call: Call, service_url: str) -> None:
    view = depth_scene.box_on_table()
    reply = call(
        service_url,
        "grasps_from_depth",
        view.depth,
        intrinsics=view.intrinsics,
        mask=view.mask,
        T_cloud_camera=view.T_cloud_camera,
        depth_scale=0.0005,
        up=(0, 0, 1),
        support_height="auto",
        gripper={"max_width": 0.075},
        max_candidates=300,
    )
    assert len(reply) >= 1
    assert set(reply.widths) == {0.075}
    for points in (reply.approach_points, reply.contact_points):
        assert (np.abs(points - [0, 0, depth_scene.SIZE[2] / 2]) <= depth_scene.SIZE / 2 + 0.003).all()
    assert any("support_height auto" in note for note in reply.warnings)


def test_many_indices_are_a_target_like_their_box(call: Call, service_url: str, box_on_table: Points) -> None:
    on_box = np.flatnonzero(box_on_table[:, 2] > 0)
    reply = call(service_url, "grasps", box_on_table, target={"indices": on_box}, **QUERY)
    assert len(reply) >= 1
    assert reply.counts.points == len(box_on_table)
    assert (reply.contact_points[:, 2] > 0.002).all()


def test_the_command_reads_a_depth_image(tmp_path: Path, service_url: str) -> None:
    view = depth_scene.box_on_table()
    depth, mask = tmp_path / "depth.png", tmp_path / "mask.png"
    depth.write_bytes(png(view.counts))
    mask.write_bytes(png(view.mask.astype(np.uint8)))
    k = view.intrinsics
    flags = [
        "--intrinsics",
        k.fx,
        k.fy,
        k.cx,
        k.cy,
        "--mask",
        mask,
        "--camera-pose",
        *view.T_cloud_camera.matrix.ravel(),
    ]
    flags += [
        "--up",
        0,
        0,
        1,
        "--support-height",
        "auto",
        "--max-candidates",
        300,
        "--gripper",
        "max_width=0.07",
        "--json",
    ]
    command = [
        sys.executable,
        "-m",
        "client",
        str(depth),
        "--url",
        service_url,
        "--timeout",
        f"{PATIENCE_S:g}",
        *map(str, flags),
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert {grasp["width"] for grasp in json.loads(done.stdout)["grasps"]} == {0.07}
