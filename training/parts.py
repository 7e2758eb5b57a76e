"""The parts of an archive of labels: how scenes, views and candidates are written small. Renders nothing.

A part is one `labels_*.npz`. Its arrays hold all scenes one after the other: what belongs to a view or a scene is found
by counts. Of a candidate are kept, in the world: its pair, approach and contact point, to 0.1 mm and the closing
direction to 0.1 degrees; how far the travel is turned about it from that which follows from the pair, to 0.2 degrees;
where the TCP is from the approach point, along the hand's axes and short of the contact point's depth, and the width,
to 0.1 mm. The last are the same for many candidates, so they cost little.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from simharness.sim.camera import PRESET_SENSOR
from tesnet.candidates import grasp_poses, poses_along
from tesnet.geometry import Gripper, Pose
from tesnet.hands import HANDS
from tesnet.whole_file import write_whole
from training.viewing import SHOWS, Viewing
from training.views import gripper_of, gripper_values

LENGTH = 1e-4
"""Metres to which points, offsets and widths are kept."""

ANGLE = np.deg2rad(0.1)
TURN = np.deg2rad(0.2)
"""Radians to which directions of closing and turns about them are kept."""

_LEAST_DEPTH = 0.003
"""Metres; the direction of travel of less deep pairs does not follow from their points, straight down stands for it."""

_OLD_LENGTH = 2e-5
_DOWN = np.array([0.0, 0.0, -1.0])
_TABLES = ("approach_point", "contact_point", "closing_direction", "offset")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class ArchivedView:
    """What is kept of a view: C candidates.

    Args:
        viewing: how the scene was looked at.
        gripper: the hand that tried them.
        places: (C, 2, 3) approach and contact points in the world.
        Ts_world_grasp: (C, 4, 4) poses as they were tried.
        widths: (C,) metres.
        outcomes, collision_free: as in `LabelledView`.
    """

    viewing: Viewing
    gripper: Gripper
    places: Array
    Ts_world_grasp: Array
    widths: Array
    outcomes: NDArray[np.uint8]
    collision_free: NDArray[np.bool_]


Key = tuple[int, str, int]


@dataclass(frozen=True, eq=False, slots=True)
class ArchivedScene:
    """What is kept of a scene.

    Args:
        description: of the scene.
        views: its labelled views.
    """

    description: Mapping[str, Any]
    views: tuple[ArchivedView, ...]

    @property
    def key(self) -> Key | None:
        """Seed, kind and number, by which it is known; None of scenes without."""
        if "number" not in self.description:
            return None
        return self.description["seed"], self.description["kind"], self.description["number"]


def viewing_of_cameras(Ts_world_camera: Array) -> Viewing:
    """How views of before 0.6.0 were taken, whose noise is not known; of (V, 4, 4) cameras."""
    sensor = PRESET_SENSOR["random" if len(Ts_world_camera) == 1 else "multi3"]
    return Viewing(tuple(Pose.from_matrix(matrix) for matrix in Ts_world_camera), sensor, 0)


def write_part(path: Path, scenes: Sequence[ArchivedScene]) -> None:
    """Writes a part."""
    names = sorted({item["name"] for scene in scenes for item in scene.description["objects"]})
    hands: list[str] = []
    sensors: list[str] = []
    columns: dict[str, list[NDArray[Any]]] = {}

    def add(name: str, values: Any, dtype: Any) -> None:
        columns.setdefault(name, []).append(np.asarray(values, dtype=dtype))

    for scene in scenes:
        seed, _, number = scene.key or (-1, "", -1)
        items = scene.description["objects"]
        add("scene_kind", [scene.description["kind"] == "pile"], np.uint8)
        add("scene_seed", [seed], np.int64)
        add("scene_number", [number], np.int64)
        add("scene_objects", [len(items)], np.uint8)
        add("scene_views", [len(scene.views)], np.uint8)
        add("object_name", [names.index(item["name"]) for item in items], np.uint16)
        add("object_scale", [item["scale"] for item in items], np.float32)
        poses = [[*item["position"], *item["quaternion_xyzw"]] for item in items]
        add("object_pose", np.array(poses).reshape(-1, 7), np.float32)
        # Not a number where they are the protocol's.
        for name in ("mass", "friction"):
            add(f"object_{name}", [item.get(name, np.nan) for item in items], np.float32)
        for view in scene.views:
            add("view_hand", [_index(json.dumps(gripper_values(view.gripper)), hands)], np.uint16)
            add("view_sensor", [_index(view.viewing.sensor, sensors)], np.uint8)
            add("view_seed", [view.viewing.seed], np.uint32)
            add("view_shows", [SHOWS.index(view.viewing.shows)], np.uint8)
            add("view_cameras", [len(view.viewing.cameras)], np.uint8)
            add("camera", [camera.matrix[:3].ravel() for camera in view.viewing.cameras], np.float32)
            for name, values, dtype in _columns(view):
                add(name, values, dtype)
    arrays = {name: np.concatenate(values) for name, values in columns.items()}
    # Neighbours in the table lie close to each other: bytes of equal weight side by side compress far better.
    arrays |= {name: np.ascontiguousarray(arrays[name].T) for name in _TABLES}
    arrays |= {"names": _text(names), "hands": _text(hands), "sensors": _text(sensors)}
    write_whole(path, _compressed(arrays))


def _columns(view: ArchivedView) -> Iterator[tuple[str, NDArray[Any], type[np.generic]]]:
    """Name, values and type of the arrays that hold a view's candidates, ordered by their approach points."""
    closing = view.Ts_world_grasp[:, :3, 1]
    azimuth, elevation = np.arctan2(closing[:, 1], closing[:, 0]), np.arcsin(closing[:, 2].clip(-1, 1))
    directions = np.round(np.stack([azimuth, elevation], axis=1) / ANGLE).astype(np.int64)
    approach, which_approach = np.unique(_to_grid(view.places[:, 0]), axis=0, return_inverse=True)
    contact = np.hstack([_to_grid(view.places[:, 1]), directions])
    contact, which_contact = np.unique(contact, axis=0, return_inverse=True)
    which_approach, which_contact = which_approach.ravel(), which_contact.ravel()
    order = np.lexsort([which_contact, which_approach])
    which_approach, which_contact, poses = which_approach[order], which_contact[order], view.Ts_world_grasp[order]

    frames = _frames(approach[which_approach], contact[which_contact])
    sine = (poses[:, :3, 2] * frames.x).sum(axis=1)
    cosine = (poses[:, :3, 2] * frames.z).sum(axis=1)
    turn = np.round(np.arctan2(sine, cosine) / TURN).astype(np.int64)
    offset = np.einsum("cij,ci->cj", frames.turned(turn), poses[:, :3, 3] - frames.origin(turn))

    yield "view_approach_points", np.array([len(approach)]), np.uint16
    yield "view_contact_points", np.array([len(contact)]), np.uint16
    yield "view_labels", np.array([len(order)]), np.uint16
    yield "approach_point", approach, np.int16
    yield "contact_point", contact[:, :3], np.int16
    yield "closing_direction", contact[:, 3:], np.int16
    yield "approach", np.diff(which_approach, prepend=0), np.uint16
    yield "contact", which_contact, np.uint16
    yield "turn", turn, np.int16
    yield "offset", np.round(offset / LENGTH), np.int16
    yield "width", np.round(view.widths[order] / LENGTH), np.uint16
    yield "outcome", view.outcomes[order], np.uint8
    yield "collision_free", view.collision_free[order], np.bool_


@dataclass(frozen=True, eq=False, slots=True)
class _Frames:
    """What the poses of C pairs are told from.

    Args:
        approach: (C, 3) points, metres.
        d: (C, 3) from there to the contact points.
        x, y, z: (C, 3) axes of the hand: closes along y, travels along z.
    """

    approach: Array
    d: Array
    x: Array
    y: Array
    z: Array

    def turned(self, turn: NDArray[np.int64]) -> Array:
        """Axes (C, 3, 3), as columns, turned about y by multiples of `TURN` from z towards x."""
        cosine, sine = np.cos(turn * TURN)[:, None], np.sin(turn * TURN)[:, None]
        return np.stack([cosine * self.x - sine * self.z, self.y, cosine * self.z + sine * self.x], axis=2)

    def origin(self, turn: NDArray[np.int64]) -> Array:
        """Where offsets begin (C, 3): over the approach points as deep as the contact points."""
        z = self.turned(turn)[:, :, 2]
        return np.asarray(self.approach + (self.d * z).sum(axis=1, keepdims=True) * z)


def _frames(approach: NDArray[np.int64], contact: NDArray[np.int64]) -> _Frames:
    """Of approach points (C, 3) and contact points with directions (C, 5) on the grid."""
    p_a, p_c = np.asarray(approach * LENGTH), np.asarray(contact[:, :3] * LENGTH)
    azimuth, elevation = (contact[:, 3:] * ANGLE).T
    y = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)
    d = p_c - p_a
    across = d - (d * y).sum(axis=1, keepdims=True) * y
    shallow = np.linalg.norm(across, axis=1) < _LEAST_DEPTH
    down = _DOWN - y[:, 2:] * -y
    # Where y is upright there is no down across it; any direction does, since the turn makes up for it.
    down = np.where(np.linalg.norm(down, axis=1, keepdims=True) > 0.1, down, np.cross(y, [1.0, 0.0, 0.0]))
    z = np.where(shallow[:, None], down, across)
    z = np.asarray(z / np.linalg.norm(z, axis=1, keepdims=True))
    return _Frames(p_a, d, np.cross(y, z), y, z)


def _to_grid(points: Array) -> NDArray[np.int64]:
    return np.round(points / LENGTH).astype(np.int64)


def _index(value: str, known: list[str]) -> int:
    """Where a value stands among those known, which it joins."""
    if value not in known:
        known.append(value)
    return known.index(value)


def _text(value: Any) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def _compressed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An .npz, with LZMA, which makes it a tenth smaller than what numpy would write."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_LZMA) as file:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # which has no time, so equal labels make equal files
            info.compress_type = zipfile.ZIP_LZMA
            with file.open(info, "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return content.getvalue()


def keys_of(path: Path) -> set[Key]:
    """Of the scenes of a part; parts of before 0.6.0 name none."""
    with np.load(path, allow_pickle=False) as stored:
        if "scene_seed" not in stored:
            return set()
        kinds = np.where(stored["scene_kind"], "pile", "packed")
        rows = zip(stored["scene_seed"].tolist(), kinds.tolist(), stored["scene_number"].tolist(), strict=True)
        return {key for key in rows if key[0] >= 0}


def read_part(path: Path) -> Iterator[ArchivedScene]:
    """The scenes of a part, one after the other."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        part = _Part({name: stored[name] for name in stored.files})
    read_view = _read_view if "width" in part.arrays else _read_old_view
    for pile in part.arrays["scene_kind"]:
        description: dict[str, Any] = {"kind": "pile" if pile else "packed"}
        if "scene_seed" in part.arrays and (seed := part.number("scene_seed")) >= 0:
            description |= {"seed": seed, "number": part.number("scene_number")}
        description["objects"] = part.objects()
        yield ArchivedScene(description, tuple(read_view(part) for _ in range(part.number("scene_views"))))


class _Part:
    """The arrays of a part, read from front to back."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.texts = {
            name: json.loads(arrays[name].tobytes()) for name in ("names", "hands", "sensors") if name in arrays
        }
        self.arrays = {
            name: array.T if name in _TABLES else array for name, array in arrays.items() if name not in self.texts
        }
        self._position = dict.fromkeys(self.arrays, 0)

    def take(self, name: str, count: int) -> NDArray[Any]:
        """The next rows of an array."""
        begin = self._position[name]
        self._position[name] += count
        return self.arrays[name][begin : begin + count]

    def number(self, name: str) -> int:
        """The next value of an array."""
        return int(self.take(name, 1)[0])

    def objects(self) -> list[dict[str, Any]]:
        """Of the next scene."""
        count = self.number("scene_objects")
        names, scales, poses = (self.take(f"object_{name}", count) for name in ("name", "scale", "pose"))
        items: list[dict[str, Any]] = [
            {
                "name": self.texts["names"][name],
                "scale": float(scale),
                "position": pose[:3].tolist(),
                "quaternion_xyzw": pose[3:].tolist(),
            }
            for name, scale, pose in zip(names, scales, poses.astype(np.float64), strict=True)
        ]
        for name in ("mass", "friction"):
            if f"object_{name}" in self.arrays:
                for item, value in zip(items, self.take(f"object_{name}", count).tolist(), strict=True):
                    item.update({} if np.isnan(value) else {name: value})
        return items

    def cameras(self) -> Array:
        """(V, 4, 4) of the next view."""
        cameras = np.tile(np.eye(4), (self.number("view_cameras"), 1, 1))
        cameras[:, :3] = self.take("camera", len(cameras)).reshape(-1, 3, 4)
        return cameras

    def counts(self) -> tuple[int, int, int]:
        """Approach points, contact points and labels of the next view."""
        return self.number("view_approach_points"), self.number("view_contact_points"), self.number("view_labels")


def _read_view(part: _Part) -> ArchivedView:
    gripper = gripper_of(json.loads(part.texts["hands"][part.number("view_hand")]))
    sensor = part.texts["sensors"][part.number("view_sensor")]
    seed, shows = part.number("view_seed"), SHOWS[part.number("view_shows")]
    viewing = Viewing(tuple(Pose.from_matrix(matrix) for matrix in part.cameras()), sensor, seed, shows)
    num_approach, num_contact, num_labels = part.counts()
    approach = part.take("approach_point", num_approach).astype(np.int64)
    contact = np.hstack([part.take(name, num_contact) for name in ("contact_point", "closing_direction")])
    approach = approach[np.cumsum(part.take("approach", num_labels))]
    contact = contact.astype(np.int64)[part.take("contact", num_labels)]
    frames, turn = _frames(approach, contact), part.take("turn", num_labels).astype(np.int64)
    poses = np.tile(np.eye(4), (num_labels, 1, 1))
    poses[:, :3, :3] = frames.turned(turn)
    offset = part.take("offset", num_labels) * LENGTH
    poses[:, :3, 3] = frames.origin(turn) + np.einsum("cij,cj->ci", poses[:, :3, :3], offset)
    return ArchivedView(
        viewing=viewing,
        gripper=gripper,
        places=np.stack([approach, contact[:, :3]], axis=1) * LENGTH,
        Ts_world_grasp=poses,
        widths=part.take("width", num_labels) * LENGTH,
        outcomes=part.take("outcome", num_labels),
        collision_free=part.take("collision_free", num_labels),
    )


def _read_old_view(part: _Part) -> ArchivedView:
    """A view of parts from before 0.6.0: pairs alone, of the wide open Franka hand, to 0.02 mm."""
    gripper = HANDS["franka"].gripper
    viewing = viewing_of_cameras(part.cameras())
    num_approach, num_contact, num_labels = part.counts()
    approach, contact = (
        part.take(f"{name}_point", count) * _OLD_LENGTH
        for name, count in (("approach", num_approach), ("contact", num_contact))
    )
    closing = part.take("closing_direction", num_contact) / np.iinfo(np.int16).max
    which_approach, which_contact = part.take("approach", num_labels), part.take("contact", num_labels)
    approach, contact, closing = approach[which_approach], contact[which_contact], closing[which_contact]
    closing /= np.linalg.norm(closing, axis=1, keepdims=True)
    poses = grasp_poses(*(torch.from_numpy(rows) for rows in (approach, contact, closing)), hand=gripper).numpy()
    # The oldest parts are from before there were pairs that travel straight down.
    if "straight_down" in part.arrays:
        down = part.take("straight_down", num_labels)
        travel = np.tile(_DOWN, (num_labels, 1))
        some = (torch.from_numpy(rows[down]) for rows in (approach, contact, closing, travel))
        poses[down] = poses_along(*some, hand=gripper).numpy()
    return ArchivedView(
        viewing=viewing,
        gripper=gripper,
        places=np.stack([approach, contact], axis=1),
        Ts_world_grasp=poses,
        widths=np.full(num_labels, gripper.max_width),
        outcomes=part.take("outcome", num_labels),
        collision_free=part.take("collision_free", num_labels),
    )
