"""Depth, colour and segmentation images from a pose, through a sensor, and the cloud that a planner is shown.

OpenGL's camera axes exist only inside this file; everything outside has +x right, +y down, +z forward.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from numpy.typing import NDArray

from simharness.errors import from_extra
from simharness.sim.scene import PERCEPTION_BOX, TABLE_HEIGHT, WORKSPACE
from simharness.sim.sensors.catalogue import SENSORS, SensorName
from simharness.sim.sensors.images import ndimage
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.world import World
from tesnet.geometry import Box, CameraIntrinsics, Pose

Preset = Literal["random", "giga", "multi3", "vgn6", "top"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
FUSED: tuple[Preset, ...] = ("multi3", "vgn6")
"""Presets of several views, which become one cloud."""

INTRINSICS = CameraIntrinsics(width=640, height=480, fx=540.0, fy=540.0, cx=320.0, cy=240.0)
NEAR, FAR = 0.1, 2.0
"""Metres; nothing nearer or farther is seen."""

_SKY = 1.0 - 1e-7
"""In the renderer's buffer: empty pixels fall short of 1 by the rounding of float32."""

_TABLE_BOX = Box(np.array([-0.1, -0.1, -0.1]), np.array([0.4, 0.4, 0.35]))
"""Table and things as far as wrong scales and poses may move them."""

_TABLE_MIDDLE = (0.15, 0.15, TABLE_HEIGHT)
_FUSION_VOXELS = 120
_FUSION_TRUNCATION_VOXELS = 4


PRESET_SENSOR: Mapping[Preset, SensorName] = {
    "random": "gaussian",
    "giga": "dex",
    "multi3": "gaussian",
    "vgn6": "ideal",
    "top": "gaussian",
}
"""Names of the sensors that presets have unless another is asked for."""


@dataclass(frozen=True, eq=False, slots=True)
class Images:
    """What a camera sees; rows from the top.

    Args:
        depth: metres along the optical axis, 0 where nothing is seen.
        colour: RGB.
        segmentation: body ids, -1 where nothing is seen or where no ids were asked for.
    """

    depth: Float32[np.ndarray, "height width"]
    colour: UInt8[np.ndarray, "height width 3"]
    segmentation: Int32[np.ndarray, "height width"]

    def __post_init__(self) -> None:
        for name, kind in (("depth", np.float32), ("colour", np.uint8), ("segmentation", np.int32)):
            image = np.array(getattr(self, name), dtype=kind)
            image.setflags(write=False)
            object.__setattr__(self, name, image)


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """What a planner is shown, and the images behind it.

    Args:
        points_world: cloud inside the perception box, metres.
        viewpoints: camera positions in the world, metres, as the planner believes them to be.
        Ts_world_camera: true camera poses (4, 4).
        images: one set a camera, without noise.
        table_height: of the table's top, metres, as the planner believes it to be.
    """

    points_world: Float32[np.ndarray, "points 3"]
    viewpoints: Float64[np.ndarray, "views 3"]
    Ts_world_camera: Float64[np.ndarray, "views 4 4"]
    images: tuple[Images, ...]
    table_height: float = TABLE_HEIGHT

    def __post_init__(self) -> None:
        for name, kind in (("points_world", np.float32), ("viewpoints", np.float64), ("Ts_world_camera", np.float64)):
            array = np.array(getattr(self, name), dtype=kind)
            array.setflags(write=False)
            object.__setattr__(self, name, array)


@dataclass(frozen=True, slots=True)
class Stand:
    """What is asked of where cameras stand; None leaves it to the preset.

    Args:
        polar_deg: angle of every view from straight above, 0 to 90.
        distance: metres from every camera to the middle of the table's top, which it then looks at.
    """

    polar_deg: float | None = None
    distance: float | None = None


AS_PRESET = Stand()
"""Everything as the preset has it."""


def sample_camera(preset: Preset, rng: np.random.Generator, stand: Stand = AS_PRESET) -> tuple[Pose, ...]:
    """T_world_camera of each view of a preset.

    `random`: one view on a sphere about (0.15, 0.15, 0.25), radius 0.6-0.75 m, polar angle 45-60 deg, azimuth 0-180
    deg. `giga`: one fixed view from the side. `multi3`: three views like `random`'s, 120 deg apart, azimuth of the
    first 0-120 deg. `vgn6`: six views on a circle, polar angle 30 deg, radius 0.6 m. `top`: one view from straight
    above, 0.6 m over the table.

    Args:
        preset: which views.
        rng: source of what is random about them.
        stand: what replaces the preset's; the rest stays as it was.

    Raises:
        ValueError: an unknown preset; the message lists the valid ones.
    """

    def on_sphere(centre: tuple[float, float, float], radius: float, polar: float, azimuth: float) -> Pose:
        polar = polar if stand.polar_deg is None else stand.polar_deg
        if stand.distance is not None:
            centre, radius = _TABLE_MIDDLE, stand.distance
        return _on_sphere(centre, radius, polar, azimuth)

    if preset == "random":
        radius, polar, azimuth = rng.uniform(0.6, 0.75), rng.uniform(45, 60), rng.uniform(0, 180)
        return (on_sphere((0.15, 0.15, 0.25), radius, polar, azimuth),)
    if preset == "giga":
        return (on_sphere((0.15, 0.15, 0.1), 0.6, 60, -90),)
    if preset == "multi3":
        radius, polar, azimuth = rng.uniform(0.6, 0.75), rng.uniform(45, 60), rng.uniform(0, 120)
        return tuple(on_sphere((0.15, 0.15, 0.25), radius, polar, azimuth + turn) for turn in (0, 120, 240))
    if preset == "vgn6":
        return tuple(on_sphere((0.15, 0.15, 0.0), 0.6, 30, azimuth) for azimuth in range(0, 360, 60))
    if preset == "top":
        return (on_sphere(_TABLE_MIDDLE, 0.6, 0, -90),)
    raise ValueError(f"unknown camera preset {preset!r}; valid: {', '.join(PRESETS)}")


def render(world: World, T_world_camera: Pose, *, segmentation: bool = True) -> Images:
    """Images of the world from a pose, without noise.

    Args:
        world: what is seen.
        T_world_camera: camera pose, +z forward.
        segmentation: whether body ids are wanted.
    """
    opengl_from_opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    view = opengl_from_opencv @ T_world_camera.inverse().matrix
    colour, buffer, bodies = world.render(
        view, _projection(INTRINSICS), INTRINSICS.width, INTRINSICS.height, segmentation=segmentation
    )
    buffer = buffer.astype(np.float64)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)
    depth[buffer >= _SKY] = 0.0
    return Images(depth.astype(np.float32), colour, bodies)


def observe(
    world: World,
    preset: Preset,
    rng: np.random.Generator,
    sensor: Sensor | None = None,
    *,
    stand: Stand = AS_PRESET,
    table_in_view: bool = False,
    voxel_size: float | None = None,
    segmentation: bool = False,
) -> Observation:
    """Sample a camera and look: depth, depth errors, points, crop to the perception box, point noise, in this order.

    Noise before the crop would lift points of the table into the box. Presets with several views are fused.

    Args:
        world: what is seen.
        preset: where cameras stand.
        rng: source of the cameras' poses, then of the sensor's errors.
        sensor: the preset's own unless given.
        stand: what replaces the preset's poses.
        table_in_view: leave the table, around the workspace too, in the cloud.
        voxel_size: edge of the voxels to which the cloud is thinned at last, metres; None keeps every point.
        segmentation: whether the images shall hold body ids.
    """
    cameras = sample_camera(preset, rng, stand)
    sensor = sensor or SENSORS[PRESET_SENSOR[preset]]
    return observe_from(
        world, cameras, rng, sensor, table_in_view=table_in_view, voxel_size=voxel_size, segmentation=segmentation
    )


def observe_from(
    world: World,
    cameras: Sequence[Pose],
    rng: np.random.Generator,
    sensor: Sensor,
    *,
    table_in_view: bool = False,
    voxel_size: float | None = None,
    segmentation: bool = False,
) -> Observation:
    """`observe` from given poses T_world_camera; several views are fused into one cloud."""
    images = tuple(render(world, camera, segmentation=segmentation) for camera in cameras)
    believed = [sensor.calibration.believed_pose(camera, rng) for camera in cameras]
    table_height = TABLE_HEIGHT + sensor.calibration.height_error(rng)
    scale = sensor.calibration.scale_error(rng)
    depths = [sensor.measure(image.depth, INTRINSICS, rng) * np.float32(scale) for image in images]
    single = len(cameras) == 1
    points = believed[0].apply(INTRINSICS.back_project(depths[0])) if single else _fuse(depths, believed)
    points = crop(points, _TABLE_BOX if table_in_view else perception_box(table_height))
    if sensor.point_sigma > 0:
        points = points + rng.normal(0.0, sensor.point_sigma, points.shape)
    if voxel_size is not None:
        points = thin(points, voxel_size)
    return Observation(
        points.astype(np.float32),
        np.stack([camera.translation for camera in believed]),
        np.stack([camera.matrix for camera in cameras]),
        images,
        table_height,
    )


def together(looks: Sequence[Observation]) -> Observation:
    """Several looks at a scene in which nothing has moved, as one: all points, seen from all viewpoints.

    Args:
        looks: one or more; the last tells how high the table is.
    """
    if len(looks) == 1:
        return looks[0]
    return Observation(
        np.concatenate([look.points_world for look in looks]),
        np.concatenate([look.viewpoints for look in looks]),
        np.concatenate([look.Ts_world_camera for look in looks]),
        tuple(image for look in looks for image in look.images),
        looks[-1].table_height,
    )


def perception_box(table_height: float) -> Box:
    """What a planner is shown that believes the table to be so high, metres."""
    minimum = PERCEPTION_BOX.minimum + np.array([0.0, 0.0, table_height - TABLE_HEIGHT])
    return Box(minimum, PERCEPTION_BOX.maximum)


def crop(points: Float64[np.ndarray, "points 3"], box: Box) -> Float64[np.ndarray, "inside 3"]:
    """The points inside a box."""
    return np.asarray(points[((points >= box.minimum) & (points <= box.maximum)).all(axis=1)])


def thin(points: Float64[np.ndarray, "points 3"], voxel_size: float) -> Float64[np.ndarray, "voxels 3"]:
    """The mean of the points in each voxel that holds any, ordered by voxel.

    Args:
        points: metres.
        voxel_size: edge of the voxels, metres; one has a corner at the origin.
    """
    cells = np.floor(points / voxel_size).astype(np.int64)
    _, members, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), 3))
    np.add.at(sums, members.reshape(-1), points)
    return np.asarray(sums / counts[:, None])


def _on_sphere(centre: tuple[float, float, float], radius: float, polar_deg: float, azimuth_deg: float) -> Pose:
    polar, azimuth = np.deg2rad(polar_deg), np.deg2rad(azimuth_deg)
    direction = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    # Straight above, the image's upper edge points where it does when the camera comes there from its azimuth.
    up = [0.0, 0.0, 1.0] if polar_deg > 0 else [-np.cos(azimuth), -np.sin(azimuth), 0.0]
    return Pose.look_at(np.asarray(centre) + radius * direction, centre, up)


def _projection(camera: CameraIntrinsics) -> NDArray[np.float64]:
    """OpenGL projection matrix (4, 4) whose image of a point is this camera's, pixel centres at whole numbers."""
    # The CPU renderer samples columns at their left edge and rows at their lower edge (compared with ray casts).
    cx, cy = camera.cx, camera.cy + 1.0
    return np.array(
        [
            [2 * camera.fx / camera.width, 0, 1 - 2 * cx / camera.width, 0],
            [0, 2 * camera.fy / camera.height, 2 * cy / camera.height - 1, 0],
            [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
            [0, 0, -1, 0],
        ]
    )


def _fuse(depths: Sequence[NDArray[np.float32]], cameras: Sequence[Pose]) -> NDArray[np.float64]:
    """Points (N, 3) in the world on the surface of a truncated signed distance field over the workspace.

    Curless and Levoy, "A volumetric method for building complex models from range images" (SIGGRAPH 1996), by Open3D.
    """
    open3d = _open3d()
    size = float((WORKSPACE.maximum - WORKSPACE.minimum).max())
    integration = open3d.pipelines.integration
    volume = integration.UniformTSDFVolume(
        length=size,
        resolution=_FUSION_VOXELS,
        sdf_trunc=_FUSION_TRUNCATION_VOXELS * size / _FUSION_VOXELS,
        color_type=integration.TSDFVolumeColorType.NoColor,
        origin=WORKSPACE.minimum,
    )
    intrinsic = open3d.camera.PinholeCameraIntrinsic(
        INTRINSICS.width, INTRINSICS.height, INTRINSICS.fx, INTRINSICS.fy, INTRINSICS.cx, INTRINSICS.cy
    )
    for depth, camera in zip(depths, cameras, strict=True):
        colour = open3d.geometry.Image(np.zeros((*depth.shape, 3), dtype=np.uint8))
        image = open3d.geometry.RGBDImage.create_from_color_and_depth(
            colour, open3d.geometry.Image(np.ascontiguousarray(depth)), depth_scale=1.0, depth_trunc=FAR
        )
        volume.integrate(image, intrinsic, camera.inverse().matrix)
    return np.asarray(volume.extract_point_cloud().points, dtype=np.float64).reshape(-1, 3)


def check_sensing(preset: Preset, sensor: Sensor) -> None:
    """Load what a camera and its sensor need beyond the extra `sim`.

    Raises:
        MissingExtra: it is not installed; the message names the extra that brings it.
    """
    if preset in FUSED:
        _open3d()
    if sensor.depth:
        ndimage()


def _open3d() -> Any:
    # 400 MB and system libraries that single views do without, hence not at the top.
    with from_extra("fusion", "a camera whose views are fused needs"):
        return importlib.import_module("open3d")
