from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from client.__main__ import main
from client.request import Request, depth_request
from service import schemas
from tesnet.geometry import Pose
from tests.client.conftest import Answering, Reset, ScriptedServer, answering
from tests.client.test_cloud_file import ply
from tests.client.test_request import as_sent

Points = np.ndarray[Any, np.dtype[np.float32]]
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def cloud(tmp_path: Path, points: Points) -> str:
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply(points, text=False, byte_order="<"))
    return str(path)


def run(
    *arguments: str, stdin: bytes = b"", environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[bytes]:
    command: Sequence[str] = [sys.executable, "-m", "client", *arguments]
    return subprocess.run(
        command, input=stdin, capture_output=True, cwd=ROOT, env={**os.environ, **(environment or {})}, check=False
    )


def test_a_ply_file_becomes_an_aligned_table(
    server: ScriptedServer, cloud: str, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    done = run(cloud, "--url", server.url, "--top-k", "3", "--up", "0", "0", "1")
    assert done.returncode == 0, done.stderr
    header, *rows = done.stdout.decode().splitlines()
    assert header.split() == ["rank", "score", "x", "y", "z", "qx", "qy", "qz", "qw", "width"]
    assert len({len(line) for line in [header, *rows]}) == 1
    assert [row.split()[0] for row in rows] == ["1", "2", "3"]
    values = np.array([row.split()[1:] for row in rows], dtype=float)
    for row, wire in zip(values, found["grasps"], strict=True):
        expected = [wire["score"], *wire["position"], *wire["quaternion_xyzw"], wire["width"]]
        np.testing.assert_allclose(row, expected, atol=1e-3)
    assert done.stderr.decode() == "warning: `up` is missing.\n"
    np.testing.assert_array_equal(np.frombuffer(server.received[0].body, "<f4").reshape(-1, 3), points)


def test_a_reader_that_has_had_enough_leaves_no_traceback(
    server: ScriptedServer, cloud: str, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    command = [sys.executable, "-m", "client", cloud, "--url", server.url]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as asking:
        assert asking.stdout is not None
        assert asking.stderr is not None
        asking.stdout.close()
        assert b"Traceback" not in asking.stderr.read()
    assert asking.returncode == 128 + signal.SIGPIPE


def test_json_is_the_service_s_document_and_the_url_may_come_from_the_environment(
    server: ScriptedServer, points: Points, found: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    buffer = io.BytesIO()
    np.save(buffer, points)
    done = run("-", "--json", stdin=buffer.getvalue(), environment={"GRASP_URL": server.url})
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == found


def test_nothing_found_prints_the_reason_and_exits_1(
    server: ScriptedServer, cloud: str, nothing_found: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    server.script = [answering(nothing_found)]
    assert main([cloud, "--url", server.url]) == 1
    assert capsys.readouterr().out == "no grasps: all_in_collision\n"
    assert main([cloud, "--url", server.url, "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == nothing_found


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ("rg2", "rg2"),
        ("rg2 max_width=0.05", {"name": "rg2", "max_width": 0.05}),
        ("max_width=0.05", {"max_width": 0.05}),
    ],
)
def test_a_hand_is_named_or_described(
    server: ScriptedServer, cloud: str, found: dict[str, Any], words: str, asked: Any
) -> None:
    server.script = [answering(found)]
    assert main([cloud, "--url", server.url, "--gripper", *words.split()]) == 0
    query = parse_qs(urlsplit(server.received[0].target).query)
    assert json.loads(query["gripper"][0]) == asked


def test_up_may_be_found(server: ScriptedServer, cloud: str, found: dict[str, Any]) -> None:
    server.script = [answering(found)]
    assert main([cloud, "--url", server.url, "--up", "auto", "--support-height", "auto"]) == 0
    query = parse_qs(urlsplit(server.received[0].target).query)
    assert (json.loads(query["up"][0]), json.loads(query["support_height"][0])) == ("auto", "auto")


def test_every_option_has_a_flag(server: ScriptedServer, cloud: str, found: dict[str, Any]) -> None:
    server.script = [answering(found)]
    flags = (
        "--top-k 7 --viewpoint 0.3 0 -0.6 --viewpoint 0 0 1 --up 0 0 1 --support-height -0.05 "
        "--target-box 0 0 0 1 1 1 --gripper max_width=0.06 finger_depth=0.04 "
        "--workspace -1 -1 -1 1 1 1 --approach 0 0 -1 30 --min-score 0.5 --min-separation 0.02 20 "
        "--num-approach-points 16 --max-candidates 100 --unseen occupied --width fitted --calibrate "
        "--pregrasp-distance 0.1 "
        "--frame-convention graspnet --seed 4 --model tesnet --request-id r-9"
    )
    assert main([cloud, "--url", server.url, *flags.split()]) == 0
    query = parse_qs(urlsplit(server.received[0].target).query)
    options = {name: json.loads(values[0]) for name, values in query.items()}
    assert set(options) == set(schemas.GraspOptions.model_fields)
    assert schemas.GraspOptions.model_validate_json(json.dumps(options)) == schemas.GraspOptions(
        max_grasps=7,
        viewpoint=[(0.3, 0, -0.6), (0, 0, 1)],
        up=(0, 0, 1),
        support_height=-0.05,
        target=schemas.Target(box=schemas.Box(min=(0, 0, 0), max=(1, 1, 1))),
        gripper=schemas.GripperSize(max_width=0.06, finger_depth=0.04),
        workspace=schemas.Box(min=(-1, -1, -1), max=(1, 1, 1)),
        approach=schemas.Approach(direction=(0, 0, -1), max_angle_deg=30),
        min_score=0.5,
        min_separation=schemas.Separation(translation=0.02, rotation_deg=20),
        num_approach_points=16,
        max_candidates=100,
        unseen="occupied",
        width="fitted",
        calibrate=True,
        pregrasp_distance=0.1,
        frame_convention="graspnet",
        seed=4,
        model="tesnet",
    )
    assert server.received[0].headers["x-request-id"] == "r-9"


@pytest.mark.parametrize(
    ("flags", "asked"),
    [
        ("--support-height 0 --up 0 0 1", {"support_height": 0.0, "up": [0.0, 0.0, 1.0]}),
        ("--pregrasp-distance 0", {"pregrasp_distance": 0.0}),
        ("--min-score 0", {"min_score": 0.0}),
        ("--seed 0", {"seed": 0}),
        ("--max-grasps 0", {"max_grasps": 0}),
        ("--num-approach-points 0", {"num_approach_points": 0}),
        ("--max-candidates 0", {"max_candidates": 0}),
        ("--min-separation 0 0", {"min_separation": {"translation": 0.0, "rotation_deg": 0.0}}),
        ("--viewpoint 0 0 0", {"viewpoint": [0.0, 0.0, 0.0]}),
        ("--approach 0 0 -1 0", {"approach": {"direction": [0.0, 0.0, -1.0], "max_angle_deg": 0.0}}),
        ("--gripper tip_offset=0", {"gripper": {"tip_offset": 0.0}}),
        ("--width full --unseen free --frame-convention panda", {}),
    ],
)
def test_a_zero_and_a_default_that_are_given_are_sent(
    server: ScriptedServer, cloud: str, found: dict[str, Any], flags: str, asked: dict[str, Any]
) -> None:
    server.script = [answering(found)]
    assert main([cloud, "--url", server.url, *flags.split()]) == 0
    query = parse_qs(urlsplit(server.received[0].target).query)
    options = {name: json.loads(values[0]) for name, values in query.items()}
    assert options == (asked or {"width": "full", "unseen": "free", "frame_convention": "panda"})


def test_a_stride_of_nothing_is_left_to_the_service_to_refuse(
    server: ScriptedServer, tmp_path: Path, found: dict[str, Any]
) -> None:
    np.save(tmp_path / "depth.npy", np.ones((9, 7), dtype=np.uint16))
    server.script = [answering(found)]
    words = "--intrinsics 50 60 3.5 4.5 --stride 0"
    assert main([str(tmp_path / "depth.npy"), "--url", server.url, *words.split()]) == 0
    (received,) = server.received
    assert b'"stride":0' in received.body.replace(b" ", b"")


@pytest.mark.parametrize("scale", ["0.001", "0.0005"])
@pytest.mark.parametrize("stride", ["1", "2", "3"])
def test_the_flags_of_a_depth_image_are_the_arguments_of_the_client(
    server: ScriptedServer, tmp_path: Path, found: dict[str, Any], scale: str, stride: str
) -> None:
    rng = np.random.default_rng(int(stride))
    depth, mask = rng.integers(1, 2000, (2, 9, 7)).astype(np.uint16)
    np.save(tmp_path / "depth.npy", depth)
    np.save(tmp_path / "mask.npy", mask)
    pose = Pose.random(rng, reach=0.5).matrix.round(4)
    server.script = [answering(found)]
    words = f"--intrinsics 50 60 3.5 4.5 --mask {tmp_path / 'mask.npy'} --target-label 0 --depth-scale {scale}"
    words += f" --stride {stride} --camera-pose {' '.join(map(str, pose.ravel()))}"
    assert main([str(tmp_path / "depth.npy"), "--url", server.url, "--request-id", "r-9", *words.split()]) == 0
    (received,) = server.received
    assert received.headers["x-request-id"] == "r-9"
    expected = depth_request(
        (tmp_path / "depth.npy").read_bytes(),
        {"fx": 50.0, "fy": 60.0, "cx": 3.5, "cy": 4.5},
        {"target": {"label": 0}},
        mask=(tmp_path / "mask.npy").read_bytes(),
        T_cloud_camera=pose,
        depth_scale=float(scale),
        stride=int(stride),
    )
    sent, options = as_sent(
        Request("POST", received.target, received.body, {"Content-Type": received.headers["content-type"]})
    )
    meant, meant_options = as_sent(expected)
    assert options == meant_options == {"target": {"label": 0}}
    np.testing.assert_array_equal(sent.points, meant.points)
    np.testing.assert_array_equal(sent.mask, meant.mask)


def test_the_time_the_key_and_the_id_are_those_that_were_given(
    server: ScriptedServer, cloud: str, found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    server.script = [answering(found)]
    monkeypatch.delenv("GRASP_API_KEY", raising=False)
    assert main([cloud, "--url", server.url]) == 0
    monkeypatch.setenv("GRASP_API_KEY", "s3cret")
    assert main([cloud, "--url", server.url, "--timeout", "500", "--request-id", "r-9"]) == 0
    plain, told = (received.headers for received in server.received)
    assert 20 < float(plain["x-request-timeout"]) < 30
    assert 400 < float(told["x-request-timeout"]) < 500
    assert "x-api-key" not in plain
    assert (told["x-api-key"], told["x-request-id"]) == ("s3cret", "r-9")


NORMALS = np.eye(3)[np.arange(200) % 3]


@pytest.mark.parametrize("of_file", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_normals_are_those_that_are_given_or_else_those_of_the_file(
    server: ScriptedServer, tmp_path: Path, points: Points, found: dict[str, Any], of_file: bool, given: bool
) -> None:
    server.script = [answering(found)]
    columns = np.column_stack([points, NORMALS]) if of_file else points
    names = ("x", "y", "z", "nx", "ny", "nz")[: columns.shape[1]]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {name}" for name in names)]
    rows = [" ".join(map(repr, row)) for row in columns.astype(float).tolist()]
    (tmp_path / "cloud.ply").write_text("\n".join([*lines, "end_header", *rows, ""]))
    np.save(tmp_path / "normals.npy", -NORMALS)
    np.save(tmp_path / "views.npy", np.arange(200) % 2)
    flags = ["--normals", str(tmp_path / "normals.npy")] if given else []
    flags += ["--view-index", str(tmp_path / "views.npy"), "--viewpoint", "0", "0", "1", "--viewpoint", "1", "0", "1"]
    assert main([str(tmp_path / "cloud.ply"), "--url", server.url, *flags]) == 0
    (received,) = server.received
    sent, options = as_sent(
        Request("POST", received.target, received.body, {"Content-Type": received.headers["content-type"]})
    )
    assert options == {"viewpoint": [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]}
    assert sent.view_index is not None
    assert sent.view_index.tolist() == [0, 1] * 100
    if given or of_file:
        assert sent.normals is not None
        np.testing.assert_array_equal(sent.normals, -NORMALS if given else NORMALS)
    else:
        assert sent.normals is None


@pytest.mark.parametrize("asked", [False, True])
def test_the_viewpoint_of_a_file_is_taken_and_told_unless_another_is_asked_for(
    server: ScriptedServer, tmp_path: Path, found: dict[str, Any], capsys: pytest.CaptureFixture[str], asked: bool
) -> None:
    server.script = [answering(found)]
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0.5 -0.25 2 1 0 0 0\nDATA ascii\n"
    (tmp_path / "cloud.pcd").write_text(head + "1 2 3\n4 5 6\n")
    flags = ["--viewpoint", "0", "0", "1"] if asked else []
    assert main([str(tmp_path / "cloud.pcd"), "--url", server.url, *flags]) == 0
    options = parse_qs(urlsplit(server.received[0].target).query)
    assert json.loads(options["viewpoint"][0]) == ([0.0, 0.0, 1.0] if asked else [0.5, -0.25, 2.0])
    said = "0.5 -0.25 2 of the file is ignored" if asked else "viewpoint is that of the file: 0.5 -0.25 2"
    assert said in capsys.readouterr().err


def test_flags_left_out_stay_the_service_s_defaults(server: ScriptedServer, cloud: str, found: dict[str, Any]) -> None:
    server.script = [answering(found)]
    assert main([cloud, "--url", server.url, "--viewpoint", "0", "0", "1"]) == 0
    assert server.received[0].target == "/grasps?viewpoint=%5B0.0%2C0.0%2C1.0%5D"


@pytest.mark.parametrize(
    "arguments",
    [
        ["absent.ply"],
        ["cloud.step"],
        [],
        ["c.ply", "--up", "0", "0"],
        ["c.ply", "--up", "auto", "0", "1"],
        ["c.ply", "--up", "0", "0", "nan"],
        ["c.ply", "--support-height", "0"],
        ["c.ply", "--unseen", "maybe"],
        ["c.ply", "--support-height", "low", "--up", "0", "0", "1"],
        ["c.ply", "--gripper", "0.06"],
        ["c.ply", "--gripper", "max_width=wide"],
        ["--gripper", "rg2", "c.ply"],
        ["c.ply", "--mask", "mask.png"],
        ["c.ply", "--depth-scale", "0.001"],
        ["absent.png", "--intrinsics", "1", "1", "0", "0"],
    ],
)
def test_wrong_usage_and_unreadable_files_exit_2_with_one_reason(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:  # argparse ends so
        sys.exit(main(arguments))
    assert end.value.code == 2
    assert "python -m client: " in capsys.readouterr().err


@pytest.mark.parametrize("twice", ["rg2 hand_e", "rg2 max_width=0.05 max_width=0.06"])
def test_a_hand_or_a_size_given_twice_is_refused(cloud: str, twice: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([cloud, "--gripper", *twice.split()]) == 2
    said = capsys.readouterr().err
    assert all(word.rpartition("=")[2] in said for word in twice.split()[-2:])
    assert "give it once" in said


@pytest.mark.parametrize(("status", "code"), [(400, 2), (413, 2), (422, 2), (429, 3), (500, 3), (503, 3), (504, 3)])
def test_a_refusal_exits_2_for_bad_input_and_3_for_a_failing_service(
    server: ScriptedServer,
    cloud: str,
    refusing: Callable[..., Answering],
    capsys: pytest.CaptureFixture[str],
    status: int,
    code: int,
) -> None:
    server.script = [refusing(status, "100")]
    assert main([cloud, "--url", server.url]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"python -m client: {status} A title: A detail. (request r-1)\n"


def test_an_unreachable_or_foreign_service_exits_3(
    server: ScriptedServer, closed_url: str, cloud: str, capsys: pytest.CaptureFixture[str]
) -> None:
    done = run(cloud, "--url", closed_url)
    assert done.returncode == 3
    assert b"cannot reach" in done.stderr
    assert b"Traceback" not in done.stderr
    server.script = [Answering(200, b"<html>")]
    assert main([cloud, "--url", server.url]) == 3
    server.script = [Reset()]
    assert main([cloud, "--url", server.url]) == 3
    assert capsys.readouterr().out == ""


def test_a_cloud_of_nan_is_refused_here(tmp_path: Path, closed_url: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cloud.xyz"
    path.write_text("0 0 nan\n1 nan 1\n")
    assert main([str(path), "--url", closed_url]) == 2
    assert "points: have 2 rows, none of them finite" in capsys.readouterr().err
