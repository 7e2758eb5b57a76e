"""Pictures of an attempt: the scene in colour, its segmentation, the cloud with the hand drawn in it.

Everything is drawn with numpy and Pillow: a picture takes some milliseconds and is the same on every machine.
"""

from __future__ import annotations

import io
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8
from PIL import Image, ImageDraw

from simharness.sim.scene import TABLE_HEIGHT, WORKSPACE
from tesnet.geometry import PANDA, CameraIntrinsics, Gripper, Pose

PICTURE_SIZE = (480, 360)
"""Width and height of a stored picture, pixels."""

SUCCESS_COLOUR = (22, 163, 74)
FAILURE_COLOUR = (220, 38, 38)
OTHER_COLOUR = (148, 163, 184)
"""Of the hand: an attempt that succeeded, one that failed, a grasp that was not carried out."""

_BACKGROUND = (246, 247, 249)
_TABLE = (236, 239, 243)
_GRID = (214, 219, 226)
_GRID_STEP = 0.05

_CANVAS_PX = (960, 720)
"""Width and height in which the cloud is drawn, before it is scaled down."""

_CLOUD_DISTANCE = 0.6
_CLOUD_MARGIN = 0.1
_LONGEST_FOCAL_PX = 3200.0
_POINT_RADIUS = 0.0016
_LINE_PX = 8
_HALO_PX = 4
_HIDDEN_ALPHA = 90
_HIDDEN_BEHIND = 0.003
"""Metres: what is so far behind a point is hidden by it."""

_TABLE_MIDDLE = np.array([0.15, 0.15, 0.10])
"""Metres in the world: where the cloud's pictures look."""

_CLOSE_UP_PX = (160, 120)
"""The least width and height of the part of a camera image that shows the objects."""

_CLOSE_UP_MARGIN = 1.3

_PALETTE = np.array(
    [
        (0, 114, 178),
        (230, 159, 0),
        (0, 158, 115),
        (204, 121, 167),
        (86, 180, 233),
        (213, 94, 0),
        (120, 94, 240),
        (240, 228, 66),
    ],
    dtype=np.uint8,
)
"""Colours that people with any colour vision can tell apart (Okabe and Ito 2008, with one more); bodies that are loaded
one after the other get neighbours."""


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


def close_up(bodies: Int32[np.ndarray, "height width"], objects: Iterable[int]) -> tuple[slice, slice]:
    """Rows and columns of the part of a camera image that shows the objects, as wide to high as a picture.

    Args:
        bodies: body ids.
        objects: ids of the graspable bodies; where none is seen, the part is the whole image.
    """
    height, width = bodies.shape
    rows, columns = np.nonzero(np.isin(bodies, list(objects)))
    if not len(rows):
        return slice(0, height), slice(0, width)
    aspect = PICTURE_SIZE[0] / PICTURE_SIZE[1]
    needed = _CLOSE_UP_MARGIN * max(float(np.ptp(columns)), aspect * float(np.ptp(rows)))
    wide = round(min(max(needed, _CLOSE_UP_PX[0]), width, aspect * height))
    high = round(wide / aspect)
    left = int(np.clip((columns.min() + columns.max() - wide) / 2, 0, width - wide))
    top = int(np.clip((rows.min() + rows.max() - high) / 2, 0, height - high))
    return slice(top, top + high), slice(left, left + wide)


def widen(
    image: UInt8[np.ndarray, "height width 3"], known: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """An image in which every pixel has the colour of the nearest known one."""
    if not known.any():
        return image
    nearest, off = _nearest_in_column(known)
    candidates = np.flatnonzero(known.any(axis=0))
    aside = (np.arange(known.shape[1], dtype=np.int32)[:, None] - candidates.astype(np.int32)) ** 2
    columns = np.stack([candidates[(aside + of_row[candidates] ** 2).argmin(axis=1)] for of_row in off])
    widened: UInt8[np.ndarray, "height width 3"] = image[np.take_along_axis(nearest, columns, axis=1), columns]
    return widened


def _nearest_in_column(
    known: Bool[np.ndarray, "height width"],
) -> tuple[Int32[np.ndarray, "height width"], Int32[np.ndarray, "height width"]]:
    """The row of the nearest known pixel in each pixel's own column and how many rows off it is; any where none is."""
    row, far = np.arange(len(known), dtype=np.int32)[:, None], np.int32(2 * len(known))
    above = np.maximum.accumulate(np.where(known, row, -far))
    below = np.minimum.accumulate(np.where(known, row, far)[::-1])[::-1]
    nearest = np.where(row - above <= below - row, above, below)
    return nearest, np.abs(nearest - row)


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


def hand_lines(
    T_world_grasp: Float[np.ndarray, "4 4"], width: float, hand: Gripper = PANDA
) -> Float64[np.ndarray, "lines 2 3"]:
    """The usual drawing of a two-finger hand: line segments (4, 2, 3) in the world, metres.

    Two fingers at the opening `width`, the bar that joins them, and the wrist.
    """
    left, right, palm = hand.parts
    (inner, _), (other, _) = (finger.span(0.0, width) for finger in (left, right))
    segments = np.array(
        [
            [[0, inner, left.back], [0, inner, left.front]],
            [[0, other, right.back], [0, other, right.front]],
            [[0, other, palm.front], [0, inner, palm.front]],
            [[0, 0, palm.front - 0.045], [0, 0, palm.front]],
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
    hand: Gripper = PANDA,
) -> Image.Image:
    """The cloud over the table and a hand, seen from the camera's side but turned so that the hand's plane is broad.

    What points hide of the hand is pale.

    Args:
        points_world: metres.
        colours: of the points.
        T_world_grasp: pose of the TCP.
        width: opening, metres.
        hand_colour: red, green, blue.
        viewpoint: the camera's position in the world, metres.
        hand: which hand.
    """
    T_world_view = _cloud_view(np.asarray(T_world_grasp), np.asarray(viewpoint))
    lines = hand_lines(T_world_grasp, width, hand)
    view = _fitted(np.concatenate([points_world, lines.reshape(-1, 3)]), T_world_view)
    canvas = _table(T_world_view, view)
    depths = _splat(canvas, points_world, colours, T_world_view, view)
    image = Image.fromarray(canvas)
    _draw_hand(image, depths, lines, hand_colour, T_world_view, view)
    return image


def picture(image: Image.Image | UInt8[np.ndarray, "height width 3"]) -> Image.Image:
    """An image scaled to `PICTURE_SIZE`."""
    whole = Image.fromarray(image) if isinstance(image, np.ndarray) else image
    return whole.resize(PICTURE_SIZE, Image.Resampling.LANCZOS)


def png(image: Image.Image | UInt8[np.ndarray, "height width 3"]) -> bytes:
    """A picture as a small PNG of at most 128 colours."""
    buffer = io.BytesIO()
    picture(image).quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
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


def _fitted(points_world: Float64[np.ndarray, "points 3"], T_world_view: Pose) -> CameraIntrinsics:
    """The camera that has all points on the canvas, as large as they go."""
    width, height = _CANVAS_PX
    pixels, _ = _project(points_world, T_world_view, CameraIntrinsics(width, height, 1.0, 1.0, 0.0, 0.0))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    room = (1 - 2 * _CLOUD_MARGIN) * np.array(_CANVAS_PX)
    focal = float(min((room / np.maximum(high - low, 1e-6)).min(), _LONGEST_FOCAL_PX))
    centre = np.array(_CANVAS_PX) / 2 - focal * (low + high) / 2
    return CameraIntrinsics(width, height, focal, focal, float(centre[0]), float(centre[1]))


def _table(T_world_view: Pose, view: CameraIntrinsics) -> UInt8[np.ndarray, "height width 3"]:
    """A canvas with the workspace's floor and its grid of 5 cm."""
    image = Image.new("RGB", _CANVAS_PX, _BACKGROUND)
    drawing = ImageDraw.Draw(image)
    low, high = float(WORKSPACE.minimum[0]), float(WORKSPACE.maximum[0])
    corners = np.array([(x, y, TABLE_HEIGHT) for x, y in ((low, low), (high, low), (high, high), (low, high))])
    drawing.polygon(_corners(corners, T_world_view, view), fill=_TABLE)
    for at in np.linspace(low, high, round((high - low) / _GRID_STEP) + 1):
        for ends in (((at, low), (at, high)), ((low, at), (high, at))):
            line = np.array([(x, y, TABLE_HEIGHT) for x, y in ends])
            drawing.line(_corners(line, T_world_view, view), fill=_GRID, width=2)
    return np.array(image)


def _corners(
    points_world: Float64[np.ndarray, "points 3"], T_world_view: Pose, view: CameraIntrinsics
) -> list[tuple[float, float]]:
    pixels, _ = _project(points_world, T_world_view, view)
    return [(x, y) for x, y in pixels.tolist()]


def _splat(
    canvas: UInt8[np.ndarray, "height width 3"],
    points_world: Float32[np.ndarray, "points 3"],
    colours: UInt8[np.ndarray, "points 3"],
    T_world_view: Pose,
    view: CameraIntrinsics,
) -> Float64[np.ndarray, "height width"]:
    """Draw points as small discs, nearer ones over farther ones, darker with depth; the depths of what is seen."""
    nearest = np.full(canvas.shape[:2], np.inf)
    if not len(points_world):
        return nearest
    pixels, depths = _project(points_world, T_world_view, view)
    order = np.argsort(-depths, kind="stable")
    pixels, depths = np.floor(pixels[order] + 0.5).astype(np.int64), depths[order]
    near, far = depths.min(), max(depths.max(), depths.min() + 1e-6)
    shade = 1.0 - 0.35 * (depths - near) / (far - near)
    shaded = (colours[order] * shade[:, None]).astype(np.uint8)
    # Numpy keeps the last of several assignments to one pixel: the nearest, as the order is from far to near.
    radius = max(2, round(_POINT_RADIUS * view.fx / _CLOUD_DISTANCE))
    reach = range(-radius, radius + 1)
    offsets = np.array([(x, y) for x in reach for y in reach if x * x + y * y <= radius**2 + 1])
    spots = (pixels[:, None] + offsets[None]).reshape(-1, 2)
    inside = (spots >= 0).all(axis=1) & (spots[:, 0] < canvas.shape[1]) & (spots[:, 1] < canvas.shape[0])
    columns, rows = spots[inside].T
    canvas[rows, columns] = np.repeat(shaded, len(offsets), axis=0)[inside]
    nearest[rows, columns] = np.repeat(depths, len(offsets))[inside]
    return nearest


def _draw_hand(
    image: Image.Image,
    nearest: Float64[np.ndarray, "height width"],
    lines: Float64[np.ndarray, "lines 2 3"],
    colour: tuple[int, int, int],
    T_world_view: Pose,
    view: CameraIntrinsics,
) -> None:
    seen: list[list[tuple[float, float]]] = []
    hidden: list[list[tuple[float, float]]] = []
    for start, end in lines:
        points = start + np.linspace(0.0, 1.0, 100)[:, None] * (end - start)
        pixels, depths = _project(points, T_world_view, view)
        columns, rows = np.floor(pixels + 0.5).astype(np.int64).T
        inside = (columns >= 0) & (columns < image.width) & (rows >= 0) & (rows < image.height)
        behind = np.zeros(len(points), dtype=bool)
        behind[inside] = depths[inside] > nearest[rows[inside], columns[inside]] + _HIDDEN_BEHIND
        for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(behind)) + 1):
            stroke = [(x, y) for x, y in pixels[run].tolist()]
            (hidden if behind[run[0]] else seen).append(stroke)
    drawing = ImageDraw.Draw(image, "RGBA")
    for stroke in hidden:
        drawing.line(stroke, fill=(*colour, _HIDDEN_ALPHA), width=_LINE_PX)
    for reach, fill in ((_HALO_PX, (255, 255, 255)), (0, colour)):
        for stroke in seen:
            drawing.line(stroke, fill=fill, width=_LINE_PX + 2 * reach)
            radius = _LINE_PX / 2 + reach
            for x, y in (stroke[0], stroke[-1]):
                drawing.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill)
