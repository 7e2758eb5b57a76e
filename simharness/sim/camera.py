"""Depth, colour and segmentation images from a pose, sensor noise, and the cloud that a planner is shown.

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
from simharness.sim.scene import PERCEPTION_BOX, WORKSPACE
from simharness.sim.world import World
from tesnet.geometry import Box, CameraIntrinsics, Pose

Preset = Literal["random", "giga", "multi3", "vgn6"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
FUSED: tuple[Preset, ...] = ("multi3", "vgn6")
"""Presets of several views, which become one cloud."""

INTRINSICS = CameraIntrinsics(width=640, height=480, fx=540.0, fy=540.0, cx=320.0, cy=240.0)
NEAR, FAR = 0.1, 2.0
"""Metres; nothing nearer or farther is seen."""

_FUSION_VOXELS = 120
_FUSION_TRUNCATION_VOXELS = 4


@dataclass(frozen=True, slots=True)
class Noise:
    """What a depth sensor adds; everything off by default.

    Args:
        point_sigma: standard deviation of each coordinate of each point, metres.
        depth_sigma: standard deviation of each pixel's depth, metres.
        dex: multiplicative gamma and correlated Gaussian depth noise of Mahler et al., "Dex-Net 2.0" (RSS 2017): shape
            1000 and scale 0.001; sigma 5 mm on a grid four times coarser than the image.
    """

    point_sigma: float = 0.0
    depth_sigma: float = 0.0
    dex: bool = False


PRESET_NOISE: Mapping[Preset, Noise] = {
    "random": Noise(point_sigma=0.0008),
    "giga": Noise(dex=True),
    "multi3": Noise(point_sigma=0.0008),
    "vgn6": Noise(),
}


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
        viewpoints: camera positions in the world, metres.
        Ts_world_camera: camera poses (4, 4).
        images: one set a camera, without noise.
    """

    points_world: Float32[np.ndarray, "points 3"]
    viewpoints: Float64[np.ndarray, "views 3"]
    Ts_world_camera: Float64[np.ndarray, "views 4 4"]
    images: tuple[Images, ...]

    def __post_init__(self) -> None:
        for name, kind in (("points_world", np.float32), ("viewpoints", np.float64), ("Ts_world_camera", np.float64)):
            array = np.array(getattr(self, name), dtype=kind)
            array.setflags(write=False)
            object.__setattr__(self, name, array)


def sample_camera(preset: Preset, rng: np.random.Generator, polar_deg: float | None = None) -> tuple[Pose, ...]:
    """T_world_camera of each view of a preset.

    `random`: one view on a sphere about (0.15, 0.15, 0.25), radius 0.6-0.75 m, polar angle 45-60 deg, azimuth 0-180
    deg. `giga`: one fixed view from the side. `multi3`: three views like `random`'s, 120 deg apart, azimuth of the
    first 0-120 deg. `vgn6`: six views on a circle, polar angle 30 deg, radius 0.6 m.

    Args:
        preset: which views.
        rng: source of what is random about them.
        polar_deg: replaces the polar angle of every view, more than 0 and at most 90; the rest stays as it was.

    Raises:
        ValueError: an unknown preset; the message lists the valid ones.
    """

    def on_sphere(centre: tuple[float, float, float], radius: float, polar: float, azimuth: float) -> Pose:
        return _on_sphere(centre, radius, polar if polar_deg is None else polar_deg, azimuth)

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
    depth[buffer >= 1.0] = 0.0
    return Images(depth.astype(np.float32), colour, bodies)


def observe(
    world: World,
    preset: Preset,
    rng: np.random.Generator,
    noise: Noise | None = None,
    *,
    polar_deg: float | None = None,
    voxel_size: float | None = None,
    segmentation: bool = False,
) -> Observation:
    """Sample a camera and look: depth, depth noise, points, crop to the perception box, point noise, in this order.

    Noise before the crop would lift points of the table into the box. Presets with several views are fused.

    Args:
        world: what is seen.
        preset: where cameras stand.
        rng: source of the cameras' poses, then of the noise.
        noise: the preset's own unless given.
        polar_deg: replaces the preset's polar angle.
        voxel_size: edge of the voxels to which the cloud is thinned at last, metres; None keeps every point.
        segmentation: whether the images shall hold body ids.
    """
    cameras = sample_camera(preset, rng, polar_deg)
    noise = noise or PRESET_NOISE[preset]
    return observe_from(world, cameras, rng, noise, voxel_size=voxel_size, segmentation=segmentation)


def observe_from(
    world: World,
    cameras: Sequence[Pose],
    rng: np.random.Generator,
    noise: Noise,
    *,
    voxel_size: float | None = None,
    segmentation: bool = False,
) -> Observation:
    """`observe` from given poses T_world_camera; several views are fused into one cloud."""
    images = tuple(render(world, camera, segmentation=segmentation) for camera in cameras)
    depths = [add_depth_noise(image.depth, noise, rng) for image in images]
    single = len(cameras) == 1
    points = cameras[0].apply(INTRINSICS.back_project(depths[0])) if single else _fuse(depths, cameras)
    points = crop(points, PERCEPTION_BOX)
    if noise.point_sigma > 0:
        points = points + rng.normal(0.0, noise.point_sigma, points.shape)
    if voxel_size is not None:
        points = thin(points, voxel_size)
    return Observation(
        points.astype(np.float32),
        np.stack([camera.translation for camera in cameras]),
        np.stack([camera.matrix for camera in cameras]),
        images,
    )


def add_depth_noise(
    depth: Float32[np.ndarray, "height width"], noise: Noise, rng: np.random.Generator
) -> Float32[np.ndarray, "height width"]:
    """A depth image (metres) as a noisy sensor would give it; pixels that see nothing stay 0."""
    if not noise.dex and noise.depth_sigma == 0:
        return depth
    seen = depth > 0
    noisy = depth.astype(np.float64)
    if noise.dex:
        noisy = noisy * rng.gamma(1000.0, 0.001)
        coarse = rng.normal(0.0, 0.005, (depth.shape[0] // 4, depth.shape[1] // 4))
        noisy = noisy + _ndimage().zoom(coarse, 4, order=3, mode="nearest", grid_mode=True)
    if noise.depth_sigma > 0:
        noisy = noisy + rng.normal(0.0, noise.depth_sigma, depth.shape)
    return np.where(seen, np.maximum(noisy, 1e-3), 0.0).astype(np.float32)


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
    return Pose.look_at(np.asarray(centre) + radius * direction, centre, [0.0, 0.0, 1.0])


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


def check_sensing(preset: Preset, noise: Noise) -> None:
    """Load what a camera and its noise need beyond the extra `sim`.

    Raises:
        MissingExtra: it is not installed; the message names the extra that brings it.
    """
    if preset in FUSED:
        _open3d()
    if noise.dex:
        _ndimage()


def _open3d() -> Any:
    # 400 MB and system libraries that single views do without, hence not at the top.
    with from_extra("fusion", "a camera whose views are fused needs"):
        return importlib.import_module("open3d")


def _ndimage() -> Any:
    with from_extra("sensors", "the noise of camera giga (--dex-noise) needs"):
        return importlib.import_module("scipy.ndimage")
