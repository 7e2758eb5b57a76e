"""Pictures of an attempt: the scene in colour, its segmentation, the cloud with the hand drawn in it.

Everything is drawn with numpy and Pillow: a picture takes some milliseconds and is the same on every machine.
"""

from __future__ import annotations

import io
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8
from PIL import Image, ImageDraw

from tesnet.geometry import PANDA, CameraIntrinsics, Pose

PICTURE_SIZE = (320, 240)
"""Width and height of a stored picture, pixels."""

SUCCESS_COLOUR = (22, 163, 74)
FAILURE_COLOUR = (220, 38, 38)
OTHER_COLOUR = (148, 163, 184)
"""Of the hand: an attempt that succeeded, one that failed, a grasp that was not carried out."""

_BACKGROUND = (246, 247, 249)
_CLOUD_CAMERA = CameraIntrinsics(640, 480, 980, 980, 320, 250)
_CLOUD_DISTANCE = 0.5
_POINT_RADIUS_PX = 3
_LINE_PX = 4

_TABLE_MIDDLE = np.array([0.15, 0.15, 0.10])
"""Metres in the world: where pictures look."""

_CLOSE_UP_PX = (320, 240)
"""Width and height of the part of a camera image that shows the workspace."""

_PALETTE = np.array(
    [
        (230, 159, 0),
        (86, 180, 233),
        (0, 158, 115),
        (240, 228, 66),
        (0, 114, 178),
        (213, 94, 0),
        (204, 121, 167),
        (120, 94, 240),
        (254, 97, 0),
        (100, 143, 255),
        (181, 137, 110),
        (34, 197, 94),
    ],
    dtype=np.uint8,
)
"""Colours that people with any colour vision can tell apart (Okabe and Ito 2008, with six more)."""


def segmentation_colours(
    bodies: Int32[np.ndarray, "height width"], objects: Iterable[int]
) -> UInt8[np.ndarray, "height width 3"]:
    """A segmentation image in colours; everything but objects in light greys.

    Args:
        bodies: body ids, -1 where nothing is.
        objects: ids of the graspable bodies; an object keeps its colour as others go.
    """
    image = np.empty((*bodies.shape, 3), dtype=np.uint8)
    image[:] = (214, 219, 226)
    image[bodies < 0] = _BACKGROUND
    for body in objects:
        image[bodies == body] = _PALETTE[body % len(_PALETTE)]
    return image


def close_up(
    image: UInt8[np.ndarray, "height width 3"], T_world_camera: Pose, intrinsics: CameraIntrinsics
) -> UInt8[np.ndarray, "close_height close_width 3"]:
    """The part of a camera image around the middle of the workspace."""
    (column, row), _ = (values[0] for values in _project(_TABLE_MIDDLE[None], T_world_camera, intrinsics))
    width, height = _CLOSE_UP_PX
    left = int(np.clip(column - width / 2, 0, intrinsics.width - width))
    top = int(np.clip(row - height / 2, 0, intrinsics.height - height))
    return image[top : top + height, left : left + width]


def point_colours(
    points_world: Float[np.ndarray, "points 3"],
    colour: UInt8[np.ndarray, "height width 3"],
    T_world_camera: Pose,
    intrinsics: CameraIntrinsics,
) -> UInt8[np.ndarray, "points 3"]:
    """Colours (N, 3) of points, looked up in the colour image they were seen in; grey where they project outside."""
    pixels, depths = _project(points_world, T_world_camera, intrinsics)
    columns, rows = np.floor(pixels + 0.5).astype(np.int64).T
    inside = (depths > 0) & (columns >= 0) & (columns < intrinsics.width) & (rows >= 0) & (rows < intrinsics.height)
    colours = np.full((len(points_world), 3), 140, dtype=np.uint8)
    colours[inside] = colour[rows[inside], columns[inside]]
    return colours


def hand_lines(T_world_grasp: Float[np.ndarray, "4 4"], width: float) -> Float64[np.ndarray, "lines 2 3"]:
    """The usual drawing of a two-finger hand: line segments (5, 2, 3) in the world, metres.

    Two fingers at the opening `width`, the bar that joins them, the wrist, and the tick between the pads at the TCP.
    """
    tip, bar = PANDA.tip_offset, PANDA.tip_offset - PANDA.finger_length
    half = width / 2
    segments = np.array(
        [
            [[0, half, bar], [0, half, tip]],
            [[0, -half, bar], [0, -half, tip]],
            [[0, -half, bar], [0, half, bar]],
            [[0, 0, bar - 0.045], [0, 0, bar]],
            [[0, -0.004, 0], [0, 0.004, 0]],
        ]
    )
    matrix = np.asarray(T_world_grasp, dtype=np.float64)
    return np.asarray(segments @ matrix[:3, :3].T + matrix[:3, 3])


def cloud_picture(
    points_world: Float32[np.ndarray, "points 3"],
    colours: UInt8[np.ndarray, "points 3"],
    T_world_grasp: Float[np.ndarray, "4 4"],
    width: float,
    hand_colour: tuple[int, int, int],
    viewpoint: Float[np.ndarray, 3],
) -> Image.Image:
    """The cloud and a hand, seen from the camera's side but turned so that the hand's plane is broad.

    Args:
        points_world: metres.
        colours: of the points.
        T_world_grasp: pose of the TCP.
        width: opening, metres.
        hand_colour: red, green, blue.
        viewpoint: the camera's position in the world, metres.
    """
    camera = _cloud_view(np.asarray(T_world_grasp), np.asarray(viewpoint))
    canvas = _splat(points_world, colours, camera)
    image = Image.fromarray(canvas)
    drawing = ImageDraw.Draw(image)
    for segment in hand_lines(T_world_grasp, width):
        pixels, depths = _project(segment, camera, _CLOUD_CAMERA)
        if (depths > 0).all():
            line = [tuple(pixel) for pixel in pixels.tolist()]
            drawing.line(line, fill=(255, 255, 255), width=2 * _LINE_PX)
            drawing.line(line, fill=hand_colour, width=_LINE_PX)
            for x, y in line:
                drawing.ellipse((x - 2, y - 2, x + 2, y + 2), fill=hand_colour)
    return image


def png(image: Image.Image | UInt8[np.ndarray, "height width 3"]) -> bytes:
    """A picture, scaled to `PICTURE_SIZE`, as a small PNG of at most 128 colours."""
    picture = Image.fromarray(image) if isinstance(image, np.ndarray) else image
    small = picture.resize(PICTURE_SIZE, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _cloud_view(T_world_grasp: Float64[np.ndarray, "4 4"], viewpoint: Float64[np.ndarray, 3]) -> Pose:
    """A camera that looks at the middle of the table from at most 35 degrees beside the real one, the hand broad."""
    away = viewpoint - _TABLE_MIDDLE
    azimuth = np.arctan2(away[1], away[0])
    elevation = np.deg2rad(32.0)

    def direction(turn_deg: float) -> Float64[np.ndarray, 3]:
        angle = azimuth + np.deg2rad(turn_deg)
        return np.array([np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)])

    # The hand's plane is spanned by its y and z; x is its normal.
    broadest = max((-35.0, -20.0, 20.0, 35.0), key=lambda turn: abs(float(direction(turn) @ T_world_grasp[:3, 0])))
    return Pose.look_at(_TABLE_MIDDLE + _CLOUD_DISTANCE * direction(broadest), _TABLE_MIDDLE, (0.0, 0.0, 1.0))


def _project(
    points_world: Float[np.ndarray, "points 3"], T_world_camera: Pose, intrinsics: CameraIntrinsics
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, " points"]]:
    """Pixels (column, row) and depths in metres; pixels of points behind the camera mean nothing."""
    points_camera = T_world_camera.inverse().apply(points_world)
    depths = points_camera[:, 2]
    divisor = np.where(np.abs(depths) < 1e-9, 1e-9, depths)
    columns = points_camera[:, 0] / divisor * intrinsics.fx + intrinsics.cx
    rows = points_camera[:, 1] / divisor * intrinsics.fy + intrinsics.cy
    return np.stack([columns, rows], axis=1), depths


def _splat(
    points_world: Float32[np.ndarray, "points 3"], colours: UInt8[np.ndarray, "points 3"], camera: Pose
) -> UInt8[np.ndarray, "height width 3"]:
    """Points as small discs, nearer ones over farther ones, darker with depth."""
    height, width = _CLOUD_CAMERA.height, _CLOUD_CAMERA.width
    canvas = np.empty((height, width, 3), dtype=np.uint8)
    canvas[:] = _BACKGROUND
    if not len(points_world):
        return canvas
    pixels, depths = _project(points_world, camera, _CLOUD_CAMERA)
    order = np.argsort(-depths, kind="stable")
    pixels, depths = np.floor(pixels[order] + 0.5).astype(np.int64), depths[order]
    near, far = depths.min(), max(depths.max(), depths.min() + 1e-6)
    shade = 1.0 - 0.35 * (depths - near) / (far - near)
    shaded = (colours[order] * shade[:, None]).astype(np.uint8)
    # Numpy keeps the last of several assignments to one pixel: the nearest, as the order is from far to near.
    reach = range(-_POINT_RADIUS_PX, _POINT_RADIUS_PX + 1)
    offsets = np.array([(x, y) for x in reach for y in reach if x * x + y * y <= _POINT_RADIUS_PX**2 + 1])
    spots = (pixels[:, None] + offsets[None]).reshape(-1, 2)
    colour = np.repeat(shaded, len(offsets), axis=0)
    inside = (spots >= 0).all(axis=1) & (spots[:, 0] < width) & (spots[:, 1] < height)
    canvas[spots[inside, 1], spots[inside, 0]] = colour[inside]
    return canvas
