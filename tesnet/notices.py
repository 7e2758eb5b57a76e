"""The warnings of an answer, in words: of the query, of its cloud, its target, its support and the scores.

What the numbers themselves suggest of a mistake is judged in `tesnet.plausibility`.
"""

from __future__ import annotations

import numpy as np
import torch

from tesnet import plausibility
from tesnet.cloud import MINIMUM_POINTS, PreparationConfig, PreparedCloud
from tesnet.geometry import NARROWEST, PANDA, Box
from tesnet.planes import spread
from tesnet.points import nearest_neighbours
from tesnet.query import NO_VIEWPOINT, GraspQuery, span

_SAMPLE = 10_000
"""Posted points by which their extent, and the distance from one to the nearest other one, are measured."""

COARSEST_RESOLUTION = 0.0005
"""Points whose coordinates float32 resolves no finer than this, in metres, are answered with a warning."""


def of_query(query: GraspQuery, *, knows_hands: bool) -> list[str]:
    """What the query itself leaves open, for a network that knows other hands than the Franka one or does not."""
    notes = list(query.notes)
    if query.viewpoints is None:
        notes.append(NO_VIEWPOINT)
    if query.up is None:
        notes.append("up not given: grasps from below are not filtered, only those that come from behind what is seen")
    if query.gripper != PANDA and not knows_hands:
        notes.append("gripper is not the hand that the network was trained with: only collision and width follow it")
    if query.gripper.max_width < NARROWEST and knows_hands:
        notes.append(
            f"gripper opens {query.gripper.max_width:g} m, less than any that the network was trained with "
            f"({NARROWEST:g} m): scores are rough, and points are seen no finer than a few millimetres"
        )
    return notes


def of_target(prepared: PreparedCloud, query: GraspQuery, config: PreparationConfig) -> list[str]:
    """Why a target holds nothing that is left."""
    if not _misses(prepared):
        return []
    if query.target is None or isinstance(query.target, Box):
        return ["target holds none of the points that are left after the crop: nothing can be grasped there"]
    if not query.target.any():
        return ["target has 0 points: nothing can be grasped there"]
    note = (
        f"target has {int(query.target.sum())} points, but no {config.voxel_size * 1000:g} mm cell that is left after "
        "the crop has as many of them as of others: mark all points of the object, or give a box"
    )
    return [note]


def _misses(prepared: PreparedCloud) -> bool:
    """Whether there is a target that holds nothing."""
    return prepared.on_target is not None and not bool(prepared.on_target.any())


def of_support(query: GraspQuery) -> list[str]:
    """Whether up points away from the camera's side of the plane."""
    up = query.known_up
    if up is None or query.viewpoints is None or not isinstance(query.support_height, float):
        return []
    note = plausibility.reversed_up(query.viewpoints @ up, query.support_height)
    return [] if note is None else [note]


def of_answer(best: float, prepared: PreparedCloud, query: GraspQuery) -> list[str]:
    """Whether the scores are so low that the scale may be wrong, unless it is known why they are."""
    if best >= plausibility.LOW_SCORE or _misses(prepared) or query.image_scale == "unlikely":
        return []
    points, sight = prepared.points.cpu().numpy(), prepared.view_directions.double().mean(dim=0).cpu().numpy()
    sight /= max(np.linalg.norm(sight), 1e-9)
    # Where nothing was found, what lies along the sight has not been seen, as of a box from straight above.
    measured = plausibility.extents(points) if best > 0 else plausibility.extents_across(points, sight)
    of_image = query.image_scale is not None
    return plausibility.answer_notes(best, _extent(query), measured, query.gripper.max_width, of_image=of_image)


def _extent(query: GraspQuery) -> float:
    """Of what was posted, from side to side, metres."""
    return span(spread(query.points, _SAMPLE))


def _of_posted(prepared: PreparedCloud, query: GraspQuery, config: PreparationConfig) -> list[str]:
    """What the posted points suggest, whatever of them was left to look for grasps on."""
    if len(prepared) < MINIMUM_POINTS:
        if query.image_scale == "unlikely":
            return []
        note = plausibility.crowded(len(query.points), len(prepared), _extent(query), config.voxel_size)
        return [] if note is None else [note]
    notes = []
    if query.image_scale is None:
        notes += plausibility.cloud_notes(_spacing(prepared, query, config), _extent(query), config.voxel_size)
    if query.viewpoints is not None:
        enclosed = (plausibility.enclosed_viewpoint(query.points, viewpoint) for viewpoint in query.viewpoints)
        notes += [note for note in enclosed if note is not None]
    return notes


def _spacing(prepared: PreparedCloud, query: GraspQuery, config: PreparationConfig) -> float:
    """The median distance from a prepared point to the nearest other one or, where that is large, of posted ones."""
    points = prepared.points
    # A network that uses no graph asks for no neighbours but the point itself.
    neighbours = prepared.neighbours if config.graph_neighbours > 1 else nearest_neighbours(points, 2)
    spacing = float((points - points[neighbours[:, 1]]).norm(dim=1).median())
    if spacing <= plausibility.APART * config.voxel_size:
        return spacing
    posted = torch.from_numpy(query.points.copy())
    sample = posted[torch.from_numpy(spread(np.arange(len(posted)), _SAMPLE))]
    return float((sample - posted[nearest_neighbours(posted, 2, sample)[:, 1]]).norm(dim=1).median())


def of_cloud(prepared: PreparedCloud, query: GraspQuery, config: PreparationConfig) -> list[str]:
    """What the cloud suggests of a mistake, and what was left out of it."""
    notes = _of_posted(prepared, query, config)
    distance = float(np.abs(prepared.T_cloud_canonical.translation).max())
    resolution = float(np.spacing(np.float32(distance)))
    if resolution > COARSEST_RESOLUTION:
        notes.append(
            f"the cloud lies {distance:.0f} m from the origin of its frame, where coordinates are kept to "
            f"{resolution * 1000:.2g} mm only: use a frame near the cloud"
        )
    if prepared.dropped_far:
        notes.append(
            f"{prepared.dropped_far} points farther than {config.max_extent:g} m from the cloud's median were ignored"
        )
    if prepared.dropped_surplus:
        notes.append(
            f"the cloud is large: in {prepared.dropped_surplus} of its {config.voxel_size * 1000:g} mm cells, the "
            f"farthest from its middle or, on a support that was found, from the camera, no grasps were looked for; "
            f"set workspace or target to choose what matters"
        )
    return notes
