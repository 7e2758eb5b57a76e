"""`python -m client cloud.ply`: grasps of a cloud file, as a table or as the service's JSON.

Exit codes: 0 grasps found; 1 none found, and the reason is printed; 2 wrong usage, an unreadable file, or input that
the service refuses (4xx); 3 the service cannot be reached, is overloaded or fails.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from client.cloud_file import CloudFileError, decode, read_bytes, read_cloud
from client.errors import GraspClientError, InvalidArgument, Overloaded, ProblemError
from client.reply import GraspReply
from client.request import DEFAULT_DEPTH_SCALE, GraspOptions, GripperSize
from client.session import DEFAULT_TIMEOUT, GraspClient
from tesnet import formats
from tesnet.geometry import FRAME_CONVENTIONS
from tesnet.hands import HANDS

DEFAULT_URL = "http://127.0.0.1:8000"
API_KEY_VARIABLE = "GRASP_API_KEY"
"""Not an argument: other users of a machine can read those."""

FOUND, NOTHING_FOUND, BAD_INPUT, SERVICE_ERROR = range(4)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if chosen.intrinsics is None and any(
        value is not None
        for value in (chosen.mask, chosen.target_label, chosen.camera_pose, chosen.depth_scale, chosen.stride)
    ):
        parser.error(
            "--mask, --target-label, --camera-pose, --depth-scale and --stride belong to a depth image; give its "
            "--intrinsics as well"
        )
    if chosen.up is not None and chosen.up != ["auto"] and (len(chosen.up) != 3 or "auto" in chosen.up):
        parser.error("--up takes X Y Z, or auto")
    if chosen.support_height is not None and chosen.up is None and chosen.intrinsics is None:
        parser.error("--support-height is measured along `up`; give --up as well, for instance --up 0 0 1")
    try:
        with GraspClient(chosen.url, timeout=chosen.timeout, api_key=os.environ.get(API_KEY_VARIABLE)) as client:
            reply = _ask(client, chosen)
    except (CloudFileError, GraspClientError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return _exit_code(error)
    _show(reply, as_json=chosen.json)
    return FOUND if reply.grasps else NOTHING_FOUND


def table(reply: GraspReply) -> str:
    """The grasps of a reply, aligned, best first: rank, score, position (m), quaternion (x, y, z, w) and width (m)."""
    rows: list[tuple[str, ...]] = [("rank", "score", "x", "y", "z", "qx", "qy", "qz", "qw", "width")]
    for rank, grasp in enumerate(reply.grasps, start=1):
        numbers = [*grasp.position, *grasp.quaternion_xyzw, grasp.width]
        rows.append((str(rank), f"{grasp.score:.3f}", *(f"{number:.4f}" for number in numbers)))
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def _ask(client: GraspClient, chosen: argparse.Namespace) -> GraspReply:
    options = _options(chosen)
    if chosen.intrinsics is None:
        return _ask_of_cloud(client, chosen, options)
    fx, fy, cx, cy = chosen.intrinsics
    return client.grasps_from_depth(
        read_bytes(Path(chosen.cloud)),
        intrinsics={"fx": fx, "fy": fy, "cx": cx, "cy": cy},
        mask=None if chosen.mask is None else read_bytes(chosen.mask),
        T_cloud_camera=None if chosen.camera_pose is None else np.reshape(chosen.camera_pose, (4, 4)),
        depth_scale=DEFAULT_DEPTH_SCALE if chosen.depth_scale is None else chosen.depth_scale,
        stride=1 if chosen.stride is None else chosen.stride,
        request_id=chosen.request_id,
        **options,
    )


def _ask_of_cloud(client: GraspClient, chosen: argparse.Namespace, options: GraspOptions) -> GraspReply:
    name = chosen.cloud
    cloud = decode(sys.stdin.buffer.read(), formats.read, "stdin") if name == "-" else read_cloud(Path(name))
    if cloud.viewpoint is not None:
        place = " ".join(f"{number:g}" for number in cloud.viewpoint)
        if "viewpoint" in options:
            print(f"warning: the viewpoint {place} of the file is ignored, since --viewpoint is given", file=sys.stderr)
        else:
            options["viewpoint"] = cloud.viewpoint
            print(f"warning: viewpoint is that of the file: {place}", file=sys.stderr)
    normals = cloud.normals if chosen.normals is None else _array(chosen.normals)
    view_index = None if chosen.view_index is None else _array(chosen.view_index)
    return client.grasps(cloud.points, view_index=view_index, normals=normals, request_id=chosen.request_id, **options)


def _array(path: Path) -> NDArray[Any]:
    return decode(read_bytes(path), formats.npy_array, str(path))


def _show(reply: GraspReply, *, as_json: bool) -> None:
    if as_json:
        print(reply.text)
    elif reply.grasps:
        print(table(reply))
    else:
        print(f"no grasps: {reply.reason}")
    for warning in reply.warnings:
        print(f"warning: {warning}", file=sys.stderr)


def _exit_code(error: CloudFileError | GraspClientError) -> int:
    if isinstance(error, CloudFileError | InvalidArgument):
        return BAD_INPUT
    refused = isinstance(error, ProblemError) and error.status < 500 and not isinstance(error, Overloaded)
    return BAD_INPUT if refused else SERVICE_ERROR


def _options(chosen: argparse.Namespace) -> GraspOptions:
    """The options given on the command line; those left out stay the service's."""
    options: GraspOptions = {}
    if chosen.viewpoint is not None:
        options["viewpoint"] = chosen.viewpoint[0] if len(chosen.viewpoint) == 1 else chosen.viewpoint
    if chosen.workspace is not None:
        options["workspace"] = {"min": chosen.workspace[:3], "max": chosen.workspace[3:]}
    if chosen.approach is not None:
        options["approach"] = {"direction": chosen.approach[:3], "max_angle_deg": chosen.approach[3]}
    if chosen.min_separation is not None:
        options["min_separation"] = {"translation": chosen.min_separation[0], "rotation_deg": chosen.min_separation[1]}
    if chosen.target_box is not None:
        options["target"] = {"box": {"min": chosen.target_box[:3], "max": chosen.target_box[3:]}}
    if chosen.target_label is not None:
        options["target"] = {"label": chosen.target_label}
    if chosen.gripper is not None:
        options["gripper"] = _gripper(chosen.gripper)
    if chosen.up is not None:
        options["up"] = "auto" if chosen.up == ["auto"] else chosen.up
    for name in _PLAIN_OPTIONS:
        value = getattr(chosen, name)
        if value is not None:
            options[name] = value  # type: ignore[literal-required]
    return options


_PLAIN_OPTIONS = (
    "support_height",
    "max_grasps",
    "min_score",
    "num_approach_points",
    "max_candidates",
    "unseen",
    "width",
    "calibrate",
    "pregrasp_distance",
    "frame_convention",
    "seed",
    "model",
)
"""Options whose flag's value is the wire's value."""


def _number(text: str) -> float:
    value = float(text)
    if not np.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not finite")
    return value


def _number_or_auto(text: str) -> float | str:
    return text if text == "auto" else _number(text)


def _hand_or_size(text: str) -> tuple[str, str | float]:
    """`("name", NAME)` of a hand, or the name of a size and metres."""
    name, separator, value = text.partition("=")
    if separator:
        return name, _number(value)
    if not text.isidentifier():
        raise argparse.ArgumentTypeError(
            f"{text} is neither a hand's name nor SIZE=METRES; if it is the cloud, give it before --gripper"
        )
    return "name", text


def _gripper(given: Sequence[tuple[str, str | float]]) -> str | GripperSize:
    if len(given) == 1 and given[0][0] == "name":
        return str(given[0][1])
    hand: dict[str, str | float] = {}
    for name, value in given:
        if name in hand:
            raise InvalidArgument("--gripper", f"{name} is {hand[name]} and {value}; give it once")
        hand[name] = value
    return cast("GripperSize", hand)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m client",
        description="Ask the grasp service for grasps of a point cloud. Lengths are metres, in the frame of the cloud.",
        epilog=f"{API_KEY_VARIABLE} in the environment holds the API key, where the service wants one. "
        "Exit codes: 0 grasps found; 1 none found; 2 wrong usage or input; 3 no service, or it failed. "
        "Options left out get the service's defaults.",
    )
    add = parser.add_argument
    add(
        "cloud",
        help=f"file ({', '.join(formats.SUFFIXES)}; with --intrinsics a depth image, 16-bit .png or .npy), or - for "
        "such a file on stdin",
    )
    add(
        "--url",
        default=os.environ.get("GRASP_URL") or DEFAULT_URL,
        help="the service (default: $GRASP_URL, or %(default)s)",
    )
    add("--json", action="store_true", help="print the service's JSON instead of a table")
    add("--timeout", type=_number, default=DEFAULT_TIMEOUT, metavar="S", help="seconds in all (default: %(default)g)")
    add("--request-id", metavar="ID", help="names the request in the service's log")
    image = parser.add_argument_group("of a depth image")
    add = image.add_argument
    add("--intrinsics", type=_number, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="its camera, in pixels")
    add(
        "--mask",
        type=Path,
        metavar="FILE",
        help="8- or 16-bit .png, or .npy, of the same size; only what it marks is grasped",
    )
    add("--target-label", type=int, metavar="N", help="number of what is to be grasped in the mask")
    add("--camera-pose", type=_number, nargs=16, metavar="M", help="T_cloud_camera, row by row (default: identity)")
    add("--depth-scale", type=_number, metavar="M", help=f"metres per count (default: {DEFAULT_DEPTH_SCALE:g})")
    add("--stride", type=int, metavar="N", help="use every N-th row and column")
    beside = parser.add_argument_group("of a cloud")
    add = beside.add_argument
    add("--view-index", type=Path, metavar="FILE", help=".npy: which --viewpoint saw each point, from 0")
    add("--normals", type=Path, metavar="FILE", help=".npy: outward normals of the points")
    wire = parser.add_argument_group("options of the request")
    add = wire.add_argument
    vector = ("X", "Y", "Z")
    add("--top-k", "--max-grasps", dest="max_grasps", type=int, metavar="K", help="how many grasps to return")
    add(
        "--viewpoint",
        type=_number,
        nargs=3,
        metavar=vector,
        action="append",
        help="camera position; repeat it for a fused cloud",
    )
    add(
        "--up",
        type=_number_or_auto,
        nargs="+",
        metavar="X",
        help="direction against gravity, X Y Z, or auto to find it",
    )
    add(
        "--support-height",
        type=_number_or_auto,
        metavar="H",
        help="height of the support plane along --up, or auto to find it",
    )
    add(
        "--target-box",
        type=_number,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box; only what lies in it is grasped",
    )
    add(
        "--workspace",
        type=_number,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box; points outside count for collision alone",
    )
    add(
        "--approach",
        type=_number,
        nargs=4,
        metavar=(*vector, "DEG"),
        help="direction of travel and how far from it the hand may come",
    )
    add("--min-score", type=_number, metavar="P", help="least score of a returned grasp")
    add(
        "--min-separation",
        type=_number,
        nargs=2,
        metavar=("M", "DEG"),
        help="grasps nearer than both to a better one are dropped",
    )
    add("--num-approach-points", type=int, metavar="N", help="search effort")
    add("--max-candidates", type=int, metavar="N", help="search effort")
    add(
        "--gripper",
        type=_hand_or_size,
        nargs="+",
        metavar="NAME",
        help=f"another hand than the Franka's ({', '.join(HANDS)}), sizes (max_width=0.06 finger_depth=0.04 ...), or a "
        "hand and what differs",
    )
    add(
        "--width",
        choices=("fitted", "full"),
        help="how far the hand opens: by what was seen between its fingers, or fully",
    )
    add("--unseen", choices=("free", "occupied"), help="the shadow behind observed points, for collisions")
    add(
        "--calibrate",
        action="store_true",
        default=None,
        help="solve depth scale and tilt from the support seen; needs --viewpoint, --up and --support-height",
    )
    add("--pregrasp-distance", type=_number, metavar="M", help="how far behind the grasp the pregrasp lies")
    add("--frame-convention", choices=FRAME_CONVENTIONS, help="axes and origin of the printed poses")
    add("--seed", type=int, metavar="N", help="makes sampling repeatable")
    add("--model", metavar="NAME", help="one of the loaded networks")
    return parser


if __name__ == "__main__":
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:  # whoever reads the table, `head` for instance, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter's last flush fails again
        code = 128 + signal.SIGPIPE
    sys.exit(code)
