"""What a request's numbers suggest of a mistake: units, intrinsics, directions. Pure functions of numbers; numpy only.

Each returns a sentence with the value, the limit and the remedy, or None where nothing is suspicious. An answer is
given all the same: what is unlikely may be right, such as the intrinsics of a cropped image.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tesnet.geometry import CameraIntrinsics

LOW_SCORE = 0.5
"""Scores below this promise nothing; where all are, the scale may be wrong."""

UNITS: Mapping[str, float] = MappingProxyType({"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254})
"""Metres of what clouds are given in by mistake."""

_LIKELY_SPANS = (0.02, 1.5)
"""Metres from side to side of what stands before a hand: one thing, or a table."""
_WIDE = 1.0
"""Metres from which on a cloud of points that lie apart may be in another unit."""
APART = 2.0
"""Cells between neighbouring points from which on they describe no surface."""
_FARTHEST, _NEAREST = 1.5, 0.05
"""Metres: hands work on what is nearer than the one, and hardly a camera sees what is nearer than the other."""
_NEAR, _ALL_NEAR = 0.2, 0.25
"""Metres within which most depth cameras measure nothing, and within which a quarter of an image hardly is: the nearest
things alone may be a robot's own fingers."""
_FAR = 10.0
"""Metres beyond which hardly a depth camera sees."""
_LIKELY_DEPTHS = (0.3, 4.0)
_LIKELY_PLACES = (0.03, 5.0)
"""Metres from the origin of its frame at which a camera is put, by a hand or over a table."""
_COUNTS: Mapping[float, str] = MappingProxyType({0.001: "1 mm", 0.0002: "1/5000 m", 0.0001: "0.1 mm"})
"""Metres per count of the usual depth cameras."""
_SMALLEST_IMAGE = 32
"""Pixels across; of smaller images, which are tests, nothing is said."""
_OFF_MIDDLE = 0.1
_NEAR_MIDDLE = 0.05
"""Shares of an image's size by which a principal point is suspiciously, and usually, off its middle."""
_SMALL, _MANY = 0.15, 500
"""Metres from side to side within which a cloud of so many points should leave more of them on the grid."""


# ----------------------------------------------------------------------------------------------------------- the camera


def normalised_intrinsics(camera: CameraIntrinsics) -> str | None:
    """Whether the intrinsics are shares of the image's size instead of pixels, with which no point can be right."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    if min(camera.width, camera.height) < _SMALLEST_IMAGE or max(camera.cx, camera.cy) > 1 or max(numbers) > 10:
        return None
    return (
        f"are {camera.fx:g}, {camera.fy:g}, {camera.cx:g}, {camera.cy:g}, which look like shares of the image's size; "
        f"give pixels: fx and cx times {camera.width}, fy and cy times {camera.height}"
    )


def principal_point(camera: CameraIntrinsics) -> str | None:
    """Whether the optical axis meets the image far from its middle: cx and cy exchanged, or of another resolution."""
    size = np.array([camera.width, camera.height])
    point = np.array([camera.cx, camera.cy])
    middle = (size - 1) / 2
    if size.min() < _SMALLEST_IMAGE or (np.abs(point - middle) <= _OFF_MIDDLE * size).all():
        return None
    where = (
        f"the principal point ({camera.cx:g}, {camera.cy:g}) lies off the middle ({middle[0]:g}, {middle[1]:g}) of "
        f"this {camera.width} x {camera.height} image"
    )
    if (np.abs(point[::-1] - middle) <= _NEAR_MIDDLE * size).all():
        return f"{where}: are cx and cy exchanged?"
    return (
        f"{where}: it is that of an image of about {2 * camera.cx + 1:.0f} x {2 * camera.cy + 1:.0f} pixels; scale the "
        "intrinsics to the resolution of the image, unless it is cropped"
    )


def camera_distance(distance: float) -> str | None:
    """Whether a camera's distance from the origin of the cloud frame, metres, was likely given in millimetres."""
    low, high = _LIKELY_PLACES
    if not low <= distance / 1000 <= high:
        return None
    return (
        f"T_cloud_camera puts the camera {distance:.4g} m from the origin; if that is {distance:.4g} mm, divide its "
        "translation by 1000: it must be in metres"
    )


def pixel_pitch(camera: CameraIntrinsics, depth: float, stride: int, cell: float) -> str | None:
    """Whether pixels at a depth (metres) lie farther apart than the cells (metres) of the grid that a network sees."""
    pitch = depth * stride / min(camera.fx, camera.fy)
    if pitch <= cell or min(camera.width, camera.height) < _SMALLEST_IMAGE:
        return None
    finer = " or a smaller stride" if stride > 1 else ""
    return (
        f"neighbouring pixels lie {pitch * 1000:.1f} mm apart at {depth:.2f} m, more than the {cell * 1000:g} mm cells "
        f"of the network's grid: go nearer, take a finer image{finer}; check depth_scale and fx, fy"
    )


def depth_scale(depth: float, scale: float | None) -> str | None:
    """Whether another scale of counts is more likely.

    Args:
        depth: of the nearest things, metres.
        scale: metres per count; None where metres were given.
    """
    if _NEAREST <= depth <= _FARTHEST:
        return None
    what = f"the nearest things are {depth:.3g} m from the camera, "
    what += "where no hand reaches" if depth > _FARTHEST else "nearer than cameras see"
    if scale is None:
        return f"{what}: if that is not so, depths of floating point are no metres, as they must be: {_metres(depth)}"
    return f"{what}: if that is not so, depth_scale {scale:g} is wrong: {_other_scales(depth, scale)}"


def all_near(nearest: float, quarter: float, scale: float | None) -> str | None:
    """Whether an image shows what is nearer than cameras see, and another usual scale is more likely.

    Args:
        nearest: depth of the nearest things, metres.
        quarter: depth that a quarter of what is seen is nearer than, metres.
        scale: metres per count; None where metres were given.
    """
    if scale is None or nearest > _NEAR or quarter > _ALL_NEAR or not (others := _likely_scales(nearest, scale)):
        return None
    return (
        f"a quarter of what is seen is within {quarter:.2g} m of the camera, the nearest things at {nearest:.2g} m, "
        f"nearer than most depth cameras see; if that is not so, depth_scale {scale:g} is wrong: {', '.join(others)}"
    )


def far_away(farthest: float, scale: float | None) -> str | None:
    """Whether an image shows what is farther (metres) than cameras see, and another usual scale is more likely.

    Of counts of `scale` metres; None where metres were given.
    """
    if scale is None or farthest <= _FAR or not (others := _likely_scales(farthest, scale)):
        return None
    return (
        f"the farthest things are {farthest:.3g} m from the camera, farther than depth cameras see; if that is not so, "
        f"depth_scale {scale:g} is wrong: {', '.join(others)}"
    )


def depths_beyond(diagonal: float, depth: float, scale: float | None) -> tuple[str, str]:
    """The field at fault, and why, where an image's points span more than any scene.

    Args:
        diagonal: of the central 90 % of the points, metres.
        depth: the median, metres or, with a scale, counts.
        scale: metres per count; None where metres were given.
    """
    if scale is None:
        return "depth", (
            f"spans {diagonal:.0f} m with a median depth of {depth:.3g} m; floating point must be metres: "
            f"{_metres(depth)}; check intrinsics, which must be in pixels"
        )
    metres = depth * scale
    return "depth_scale", (
        f"is {scale:g} metres per count, with which the median depth is {metres:.3g} m and the points span "
        f"{diagonal:.0f} m: {_other_scales(metres, scale)}; check intrinsics, which must be in pixels of this image"
    )


def _other_scales(depth: float, scale: float) -> str:
    """What to do about a scale with which a depth (metres) is none that is likely."""
    return ", ".join(_likely_scales(depth, scale)) or "give the metres of one count of your camera"


def _metres(depth: float) -> str:
    """What makes metres of a depth (metres, as it was taken) in another unit."""
    low, high = _LIKELY_DEPTHS
    likely = [
        f"divide {name} by {1 / factor:.4g} (then it is {depth * factor:.2g} m)"
        for name, factor in UNITS.items()
        if low <= depth * factor <= high
    ]
    return " or ".join(likely) or "save whole numbers and give depth_scale, the metres of one count"


def _likely_scales(depth: float, scale: float) -> list[str]:
    """The usual other scales with which a depth (metres) would be a likely one."""
    low, high = _LIKELY_DEPTHS
    return [
        f"counts of {name} need {other:g} (then it is {depth * other / scale:.2g} m)"
        for other, name in _COUNTS.items()
        if low <= depth * other / scale <= high and not np.isclose(other, scale)
    ]


def depth_notes(
    camera: CameraIntrinsics, depths: NDArray[Any], scale: float | None, stride: int
) -> tuple[list[str], bool]:
    """What is to be said of a depth image, and whether its scale is a likely one.

    Args:
        camera: its camera.
        depths: (N,) of the pixels with a depth: counts, or metres where `scale` is None.
        scale: metres per count.
        stride: between the pixels that are used.
    """
    notes, wrong = [principal_point(camera)], None
    if len(depths) and min(camera.width, camera.height) >= _SMALLEST_IMAGE:
        nearest, quarter, farthest = (np.percentile(depths, _SHARES) * (1.0 if scale is None else scale)).tolist()
        wrong = depth_scale(nearest, scale) or all_near(nearest, quarter, scale) or far_away(farthest, scale)
        notes.append(wrong or pixel_pitch(camera, nearest, stride, _CELL))
    return [note for note in notes if note is not None], wrong is None


_SHARES = (5, 25, 95)
"""Per cent of the depths: those that lie before the nearest things, a quarter, and those before the farthest things."""
_CELL = 0.0045
"""Metres: the usual `tesnet.cloud.PreparationConfig.voxel_size`; which network answers is not known with an image."""


# ------------------------------------------------------------------------------------------------------------ the cloud


def cloud_notes(spacing: float, extent: float, cell: float) -> list[str]:
    """What is to be said of a posted cloud.

    Args:
        spacing: the median distance from one of its points to the nearest other one, metres.
        extent: from side to side, metres.
        cell: of the network's grid, metres.
    """
    notes = [unit(spacing, extent, cell), tiny(extent)]
    return [note for note in notes if note is not None]


def answer_notes(
    best: float, extent: float, extents: NDArray[np.float64], max_width: float, *, of_image: bool = False
) -> list[str]:
    """What is to be said where the best score is low; 0 where nothing was found.

    Args:
        best: of the scores.
        extent: of the posted cloud, from side to side, metres.
        extents: (E,) of what grasps were looked for on, metres.
        max_width: of the hand.
        of_image: whether a depth image was posted, whose coordinates nobody has seen.
    """
    notes = [low_scores(best, extent, of_image=of_image), too_wide(best, extents, max_width)]
    return [note for note in notes if note is not None]


def unit(spacing: float, extent: float, cell: float) -> str | None:
    """Whether a cloud is in another unit than metres.

    Args:
        spacing: the median distance from a point to the nearest other one, metres.
        extent: from side to side, metres.
        cell: of the network's grid, metres.
    """
    if spacing <= APART * cell:
        return None
    apart = f"the points lie {spacing * 1000:.0f} mm apart, over {APART:g} of the {cell * 1000:g} mm cells of the grid"
    if extent >= _WIDE and (units := _likely_units(extent)):
        return f"{apart}, and span {extent:.1f} m; coordinates must be in metres: {units}"
    return f"{apart}: they describe no surface that a hand could close on; send a denser cloud, in metres"


def tiny(extent: float) -> str | None:
    """Whether a cloud spans less (metres) than anything that a hand grasps."""
    if extent >= _LIKELY_SPANS[0] / 2:
        return None
    return f"the cloud spans {extent * 1000:.2g} mm, less than anything to grasp; coordinates must be in metres"


def crowded(posted: int, left: int, extent: float, cell: float) -> str | None:
    """Whether a cloud is so small for its points that it may be in another unit, where too few are left on the grid.

    Args:
        posted: how many points were.
        left: how many of them are left on the grid.
        extent: of what was posted, from side to side, metres.
        cell: of the grid, metres.
    """
    if extent > _SMALL or posted < _MANY:
        return None
    return (
        f"the {posted} points posted span {extent * 1000:.2g} mm, of which {left} of the grid's {cell * 1000:g} mm "
        "cells are left: coordinates must be in metres, and depth_scale of an image in metres per count"
    )


def low_scores(best: float, extent: float, *, of_image: bool = False) -> str | None:
    """Whether a scale that would fit stands beside scores that are all low; nothing found is a best score of 0."""
    if best >= LOW_SCORE or extent < _LIKELY_SPANS[1] or not (units := _likely_units(extent)):
        return None
    found = f"no score is over {best:.2f}" if best > 0 else "nothing was found"
    if of_image:
        return f"{found}, and what the image shows spans {extent:.1f} m: check depth_scale, the metres of one count"
    return f"{found}, and the cloud spans {extent:.1f} m: check its unit; {units}"


def too_wide(best: float, extents: NDArray[np.float64], max_width: float) -> str | None:
    """Whether all extents (E,) of what was looked at exceed the hand's opening, metres, and scores are low."""
    if best >= LOW_SCORE or extents.min() <= max_width:
        return None
    size = " x ".join(f"{extent:.2f}" for extent in sorted(extents, reverse=True))
    return (
        f"what was looked at measures {size} m, and the hand opens {max_width:g} m: if it is one thing, no "
        "hand of this size fits it; check that it is in metres, or set a workspace"
    )


def reversed_up(camera_heights: NDArray[np.float64], support_height: float) -> str | None:
    """Whether every camera looks at the support from below, by the heights (V,) of the cameras along `up`, metres."""
    below = support_height - float(camera_heights.max())
    if below <= 0:
        return None
    return (
        f"up points away from the side that the camera sees: it lies {below:.2f} m below the support; up is the "
        "direction against gravity, so reverse it, or check viewpoint"
    )


def enclosed_viewpoint(points: NDArray[np.float32], viewpoint: NDArray[np.float64]) -> str | None:
    """Whether points (N, 3) lie on all sides of a viewpoint (3,), which is then within what it should see."""
    offsets = points[:: 1 + len(points) // 20_000] - viewpoint
    near = offsets[(np.abs(offsets) <= _REACH).all(axis=1)]
    octants = np.bincount(((near > 0) @ np.array([1, 2, 4])).astype(np.int64), minlength=8)
    if len(near) < 0.5 * len(offsets) or octants.min() < _LEAST_SHARE * len(offsets):
        return None
    place = ", ".join(f"{number:g}" for number in viewpoint)
    return (
        f"the viewpoint [{place}] lies within the cloud, which then shows its inner side; give the position of the "
        "camera, or of several"
    )


_REACH = 0.5
"""Metres from a viewpoint within which a camera sees little."""
_LEAST_SHARE = 0.02


def extents(points: NDArray[Any]) -> NDArray[np.float64]:
    """(3,) metres between the 2nd and the 98th percentile of points (N, 3) along their principal axes."""
    centred = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    _, axes = np.linalg.eigh(centred.T @ centred)
    low, high = np.percentile(centred @ axes, [2, 98], axis=0)
    return np.asarray(high - low)


def extents_across(points: NDArray[Any], sight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) metres from side to side of points (N, 3) as they are seen along a unit direction (3,), as `extents`."""
    return np.sort(extents(points - (points @ sight)[:, None] * sight))[1:]


def _likely_units(extent: float) -> str:
    """The units in which an extent (metres) would be a likely one, with what to do."""
    low, high = _LIKELY_SPANS
    likely = [
        f"if they are {name}, in which it is {extent * factor:.2g} m, multiply them by {factor:g}"
        for name, factor in UNITS.items()
        if low <= extent * factor <= high
    ]
    return "; ".join(likely)
