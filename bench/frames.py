"""Whole frames of depth cameras, and what the service's grasps do in them: `python -m bench.frames DIR`.

A frame is a depth PNG and, beside it, a JSON of the request's options. Where the surface that things stand on is known,
`truth: {up, height, outline}` in the camera's frame stands in that JSON or in `NAME.truth.json`. Counted are grasps
whose hand holds what the camera saw, and grasps on the things of that surface. `--generate N` writes made-up rooms.
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench.rooms import DEPTH_SCALE, SIZES, RoomFrame, Truth, frames
from bench.serve import running_service
from bench.solids import Array
from client import GraspClient, GraspReply, ProblemError
from client.request import GraspOptions
from simharness.play.server import free_port
from tesnet.geometry import PANDA, CameraIntrinsics, Gripper, Pose

HELD_DEPTH = 0.004
HELD_POINTS = 10
"""A hand at the grasp holds what was seen where so many posted points lie so deep in it."""
LOWEST, HIGHEST = 0.003, 0.35
"""Above the surface: where both the approach point and the contact point of a grasp on its things lie, metres."""
CAMERA = ("intrinsics", "T_cloud_camera", "depth_scale", "stride")
MOST_PIXELS = 1_000_000
"""Frames of more, which would be over a service's limit of points, are sent with a stride of 2."""
_READY_WITHIN_S = 120.0


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """A frame of a folder.

    Args:
        name: of its files.
        depth: the PNG.
        options: of the request, the camera included.
        truth: None where it is not known.
    """

    name: str
    depth: bytes
    options: Mapping[str, Any]
    truth: Truth | None

    def bare(self) -> Frame:
        """The same with nothing but its camera."""
        camera = {
            name: value for name, value in self.options.items() if name in ("intrinsics", "depth_scale", "stride")
        }
        return Frame(self.name, self.depth, camera, self.truth)


@dataclass(frozen=True, slots=True)
class Count:
    """What was counted in a frame.

    Args:
        name: of the frame.
        grasps: returned.
        colliding: of them, with points in the open hand.
        first_collides: whether the best one is among them.
        on_things: of them, on things of the surface; None where that is not known.
        milliseconds: as the service measured them.
        reason, warnings: the service's.
    """

    name: str
    grasps: int
    colliding: int
    first_collides: bool
    on_things: int | None
    milliseconds: float
    reason: str | None
    warnings: tuple[str, ...]


def read_frames(folder: Path) -> list[Frame]:
    """The frames of a folder, in order: every PNG with a JSON that has intrinsics.

    Raises:
        FileNotFoundError: there is none.
    """
    found = []
    for image in sorted(folder.glob("*.png")):
        beside = image.with_suffix(".json")
        if not beside.exists():
            continue
        options = json.loads(beside.read_text(encoding="utf-8"))
        truth = options.pop("truth", None)
        apart = image.with_suffix(".truth.json")
        if truth is None and apart.exists():
            truth = json.loads(apart.read_text(encoding="utf-8"))
        if "intrinsics" in options:
            found.append(Frame(image.stem, image.read_bytes(), options, None if truth is None else _truth(truth)))
    if not found:
        raise FileNotFoundError(
            f"{folder} has no PNG with a JSON of intrinsics beside it; write some with --generate 20"
        )
    return found


def _truth(given: Mapping[str, Any]) -> Truth:
    return Truth(np.array(given["up"]), float(given["height"]), np.array(given["outline"]))


def write_frames(folder: Path, named: Iterator[tuple[str, RoomFrame]]) -> None:
    """Write frames as `read_frames` reads them; the pose is left out, so that the cloud's frame is the camera's."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in named:
        Image.fromarray(frame.counts).save(folder / f"{name}.png")
        k, truth = frame.intrinsics, frame.truth
        options = {
            "intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy},
            "depth_scale": DEPTH_SCALE,
            "stride": 1 if frame.counts.size <= MOST_PIXELS else 2,
            "up": truth.up.tolist(),
            "support_height": "auto",
            "truth": {"up": truth.up.tolist(), "height": truth.height, "outline": truth.outline.tolist()},
        }
        (folder / f"{name}.json").write_text(json.dumps(options, indent=1) + "\n", encoding="utf-8")


def ask(client: GraspClient, frame: Frame) -> GraspReply:
    """The service's answer to a frame."""
    options: GraspOptions = {name: value for name, value in frame.options.items() if name not in CAMERA}  # type: ignore[assignment]
    return client.grasps_from_depth(
        frame.depth,
        intrinsics=frame.options["intrinsics"],
        T_cloud_camera=frame.options.get("T_cloud_camera"),
        depth_scale=frame.options.get("depth_scale", DEPTH_SCALE),
        stride=frame.options.get("stride", 1),
        **options,
    )


def count(frame: Frame, reply: GraspReply) -> Count:
    """What the grasps of an answer, of the Panda hand in its own convention, do in their frame."""
    matrix = frame.options.get("T_cloud_camera")
    T_camera_cloud = (Pose.identity() if matrix is None else Pose.from_matrix(matrix)).inverse()
    points_camera = posted_points(frame)
    Ts_camera_grasp = T_camera_cloud.matrix @ reply.poses.reshape(-1, 4, 4)
    held = [
        held_points(points_camera, pose, float(width)) >= HELD_POINTS
        for pose, width in zip(Ts_camera_grasp, reply.widths, strict=True)
    ]
    on_things = None
    if frame.truth is not None:
        ends = [T_camera_cloud.apply(np.reshape(end, (-1, 3))) for end in (reply.approach_points, reply.contact_points)]
        on_things = int((on_surface(ends[0], frame.truth) & on_surface(ends[1], frame.truth)).sum())
    milliseconds = reply.timings_ms["total"]
    return Count(
        name=frame.name,
        grasps=len(held),
        colliding=sum(held),
        first_collides=bool(held and held[0]),
        on_things=on_things,
        milliseconds=milliseconds,
        reason=reply.reason,
        warnings=reply.warnings,
    )


def posted_points(frame: Frame) -> Array:
    """Points (N, 3) of all of a frame's depth image, in the camera's frame."""
    with Image.open(io.BytesIO(frame.depth)) as image:
        counts = np.array(image)
    k = frame.options["intrinsics"]
    camera = CameraIntrinsics(counts.shape[1], counts.shape[0], fx=k["fx"], fy=k["fy"], cx=k["cx"], cy=k["cy"])
    return camera.back_project(counts * frame.options.get("depth_scale", DEPTH_SCALE))


def held_points(points: Array, T_grasp: Array, width: float, hand: Gripper = PANDA) -> int:
    """How many points (N, 3) lie `HELD_DEPTH` or deeper in one of the parts of a hand at a pose (4, 4)."""
    near = points[((points - T_grasp[:3, 3]) ** 2).sum(axis=1) < 0.3**2]
    x, y, z = ((near - T_grasp[:3, 3]) @ T_grasp[:3, :3]).T
    deepest = np.full(len(near), -np.inf)
    for part in hand.parts:
        at = [section.z for section in reversed(part.sections)]
        breadth = np.interp(z, at, [section.breadth for section in reversed(part.sections)])
        spans = [part.span(section.thickness, width) for section in reversed(part.sections)]
        low, high = (np.interp(z, at, [span[end] for span in spans]) for end in (0, 1))
        low, high = np.minimum(low, high), np.maximum(low, high)
        depth = np.stack([part.front - z, z - part.back, breadth / 2 - np.abs(x), y - low, high - y]).min(axis=0)
        deepest = np.maximum(deepest, depth)
    return int((deepest >= HELD_DEPTH).sum())


def on_surface(points: Array, truth: Truth) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Mask (M,) of points (M, 3) over the surface's outline and as high above it as things there."""
    height = points @ truth.up - truth.height
    level = points - height[:, None] * truth.up
    corners = truth.outline
    sides = np.roll(corners, -1, axis=0) - corners
    across = np.cross(sides, truth.up)
    outward = across * np.sign(((corners - corners.mean(axis=0)) * across).sum(axis=1))[:, None]
    inside = ((level[:, None] - corners) * outward).sum(axis=2) <= 1e-9
    mask: np.ndarray[Any, np.dtype[np.bool_]] = inside.all(axis=1) & (height >= LOWEST) & (height <= HIGHEST)
    return mask


def table(counts: Sequence[Count]) -> str:
    """A line a frame, and the sums."""
    width = max(len("all"), *(len(count.name) for count in counts))
    lines = [f"{'frame':{width}}  grasps  colliding  on things      ms"]
    for one in counts:
        things = "-" if one.on_things is None else str(one.on_things)
        why = f"  {one.reason}" if one.reason else ""
        lines.append(
            f"{one.name:{width}}  {one.grasps:6}  {one.colliding:9}  {things:>9}  {one.milliseconds:6.0f}{why}"
        )
    known = [one for one in counts if one.on_things is not None]
    things = f"{sum(one.on_things or 0 for one in known)} of {sum(one.grasps for one in known)}"
    grasps, colliding = sum(one.grasps for one in counts), sum(one.colliding for one in counts)
    middle = float(np.nanmedian([one.milliseconds for one in counts]))
    lines.append(f"{'all':{width}}  {grasps:6}  {colliding:9}  {things:>9}  {middle:6.0f} (median)")
    lines.append(f"the best grasp collides in {sum(one.first_collides for one in counts)} of {len(counts)} frames")
    return "\n".join(lines)


def _counted(client: GraspClient, frame: Frame) -> Count:
    try:
        return count(frame, ask(client, frame))
    except ProblemError as refused:
        return Count(frame.name, 0, 0, False, None, np.nan, str(refused), ())


@contextmanager
def _service(url: str | None, threads: int) -> Iterator[GraspClient]:
    if url is not None:
        with GraspClient(url) as client:
            yield client
        return
    port = free_port()
    with running_service(port, threads), GraspClient(f"http://127.0.0.1:{port}") as client:
        client.wait_until_ready(_READY_WITHIN_S)
        yield client


def main(arguments: Sequence[str] | None = None) -> None:
    """Generate, or measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR", help="of the frames")
    parser.add_argument("--generate", type=int, metavar="N", help="write so many frames of rooms into DIR, and end")
    parser.add_argument("--seed", type=int, default=0, help="of the rooms")
    parser.add_argument("--bare", action="store_true", help="send depth and intrinsics alone")
    parser.add_argument("--url", help="of a running service; one is started where this is left out")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of the service that is started")
    parser.add_argument("--out", type=Path, help="JSON file for the counts")
    chosen = parser.parse_args(arguments)
    if chosen.generate is not None:
        write_frames(chosen.folder, frames(chosen.generate, chosen.seed, SIZES))
        return
    asked = [frame.bare() if chosen.bare else frame for frame in read_frames(chosen.folder)]
    with _service(chosen.url, chosen.threads) as client:
        counts = [_counted(client, frame) for frame in asked]
    print(table(counts))
    if chosen.out is not None:
        chosen.out.write_text(json.dumps([asdict(one) for one in counts], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
