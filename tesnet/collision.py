"""The hand's volume, swept along its approach, against what was seen, what may go on unseen and what is hidden.

`blocked` is the one judgement of it, the predictor's and that of the training's labels. Vectorised torch; lengths in
metres; everything in the cloud's canonical frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from tesnet.candidates import Candidates
from tesnet.cloud import PreparedCloud
from tesnet.geometry import Gripper, Part
from tesnet.obstacles import Obstacles
from tesnet.points import in_box, points_in_grasp_frames
from tesnet.swept import inside_hand, inside_palm
from tesnet.visibility import hidden

APPROACH_DISTANCE = 0.05
"""Length of the straight approach that is kept clear of observed points, metres."""

BORDER = 0.005
"""Points this near to a side of the workspace are taken to be cut off by it: as far as prepared points are apart."""

REACH_BEYOND = 0.04
"""How far beyond the workspace things are taken to go on."""

MOST_BEYOND = 12_000
"""Such places; of more, as where a surface runs along a side, they are thinned evenly."""

HELD_DEPTH = 0.004
HELD_POINTS = 10
"""Of a hand that a robot would drive into things: so many posted points lie so deep in it."""

_BLOCK = 4_000_000
_COARSE_STRIDES = (36, 6)
"""Most collisions show with every so many points."""

_STRIDES = (400, 20, 1)
"""Obstacles are tried from few to all, each time with the hands that met none."""


def blocked(
    cloud: PreparedCloud,
    candidates: Candidates,
    unseen: Literal["free", "occupied"],
    between: Callable[[], None] = lambda: None,
) -> Tensor:
    """Mask (C,): the open hand meets a posted point on its way, or what a side of the workspace cuts off.

    The latter is a guess, which counts only while it leaves a candidate.

    Args:
        cloud: what was observed.
        candidates: C of them.
        unseen: whether the shadow behind observed points counts as `free` or `occupied`.
        between: called between blocks of work of some milliseconds.
    """
    poses, widths, gripper = candidates.Ts_canonical_grasp, candidates.widths, candidates.gripper
    mask = in_collision(cloud.points, poses, gripper, widths, APPROACH_DISTANCE, between)
    if cloud.unsought is not None:
        mask |= _meets(cloud.unsought, candidates, ~mask, between)
    unsafe = _meets(Obstacles.of(beyond(cloud)), candidates, ~mask, between)
    if not bool((mask | unsafe).all()):
        mask |= unsafe
    if unseen == "occupied":
        free = ~mask
        mask[free] = in_shadow(cloud, poses[free], gripper, widths[free], between)
    return mask


def palm_blocked(
    points: Tensor, candidates: Candidates, least: Tensor, most: Tensor, rise: float, between: Callable[[], None]
) -> Tensor:
    """Mask (C,) of hands whose palm meets a point on its way wherever they may yet be moved within these limits.

    A quick look at every sixth of the points; `blocked` finds the others.

    Args:
        points: (P, 3) that the hand shall not meet.
        candidates: C of them.
        least: (C,) limits of their moves against the closing direction, zero or less.
        most: (C,) limits of their moves along it.
        rise: limit of their moves along the travel, either way.
        between: called between blocks of work of some milliseconds.
    """

    def meets(some: Tensor, rows: Tensor) -> Tensor:
        x, y, z = points_in_grasp_frames(some, candidates.Ts_canonical_grasp[rows])
        farthest = torch.maximum((y - least[rows, None]).abs(), (y - most[rows, None]).abs())
        inside = [
            inside_palm(x, farthest, place, candidates.gripper, APPROACH_DISTANCE)
            for place in ((z,) if rise == 0.0 else (z - rise, z + rise))
        ]
        return torch.stack(inside).all(dim=0).any(dim=1)

    return _with_few(points, len(candidates), meets, between)


def _with_few(
    points: Tensor, count: int, meets: Callable[[Tensor, Tensor], Tensor], between: Callable[[], None]
) -> Tensor:
    """Mask (C,) of the `count` hands that meet a point of the few that are tried.

    Args:
        points: (P, 3).
        count: C.
        meets: of some points and rows (R,) of hands, which of these meet one of those.
        between: called between blocks of work of some milliseconds.
    """
    met = torch.zeros(count, dtype=torch.bool, device=points.device)
    for some in (points[::stride] for stride in _COARSE_STRIDES):
        for rows in (~met).nonzero()[:, 0].split(max(1, _BLOCK // max(1, len(some)))):
            between()
            met[rows] = meets(some, rows)
    return met


def _meets(obstacles: Obstacles, candidates: Candidates, asked: Tensor, between: Callable[[], None]) -> Tensor:
    """Mask (C,) of the candidates, among those asked about (C,), whose hand meets an obstacle on its way."""
    met = torch.zeros_like(asked)
    # A large hand in a dense cloud holds a hundred thousand obstacles, of which one tells that it does.
    for stride in _STRIDES:
        some = obstacles if stride == 1 else Obstacles.of(obstacles.points[::stride])
        open_rows = (asked & ~met).nonzero()[:, 0]
        hands = candidates.select(open_rows)
        found = some.count_in_hands(
            hands.Ts_canonical_grasp, hands.gripper, hands.widths, distance=APPROACH_DISTANCE, between=between
        )
        met[open_rows] = found > 0
    return met


def holds(posted: Tensor, candidates: Candidates, between: Callable[[], None] = lambda: None) -> Tensor:
    """Mask (C,): posted points lie well inside the open hand at the grasp, `HELD_POINTS` or more `HELD_DEPTH` deep.

    The last word on grasps that are to be returned: `blocked` looks at cells, and leaves out points that stand alone.

    Args:
        posted: (N, 3) every point of the query, its support's included.
        candidates: C of them.
        between: called between blocks of work of some milliseconds.
    """
    poses, widths = candidates.Ts_canonical_grasp, candidates.widths
    posted = _in_reach(posted, candidates)
    held = Obstacles.of(posted).count_in_hands(poses, candidates.gripper, widths, depth=HELD_DEPTH, between=between)
    return held >= HELD_POINTS


def _in_reach(posted: Tensor, candidates: Candidates) -> Tensor:
    """Those of the posted points (N, 3) that the hands of the candidates, one at least, may hold."""
    if len(candidates) == 0:
        return posted[:0]
    Ts_canonical_grasp, gripper = candidates.Ts_canonical_grasp, candidates.gripper
    corners = torch.tensor(gripper.corners(gripper.max_width), dtype=posted.dtype, device=posted.device)
    places = corners @ Ts_canonical_grasp[:, :3, :3].transpose(1, 2) + Ts_canonical_grasp[:, None, :3, 3]
    low, high = places.amin(dim=(0, 1)), places.amax(dim=(0, 1))
    return posted[in_box(posted, low, high)]


def in_collision(
    points: Tensor,
    Ts_canonical_grasp: Tensor,
    gripper: Gripper,
    widths: Tensor | float,
    approach_distance: float,
    between: Callable[[], None] = lambda: None,
) -> Tensor:
    """Mask (C,): a point lies in the hand anywhere on its way to the grasp.

    Args:
        points: (P, 3) that the hand shall not meet.
        Ts_canonical_grasp: (C, 4, 4) TCP poses.
        gripper: the hand.
        widths: openings of the fingers, (C,) or one for all.
        approach_distance: length of the straight approach, which ends in the grasp.
        between: called between blocks of work of some milliseconds.
    """
    opened = torch.as_tensor(widths, dtype=points.dtype, device=points.device).expand(len(Ts_canonical_grasp))

    def meets(some: Tensor, rows: Tensor) -> Tensor:
        x, y, z = points_in_grasp_frames(some, Ts_canonical_grasp[rows])
        return inside_hand(x, y, z, gripper, opened[rows, None], approach_distance).any(dim=1)

    hit = _with_few(points, len(Ts_canonical_grasp), meets, between)
    left = (~hit).nonzero()[:, 0]
    obstacles = Obstacles.of(points)
    found = obstacles.count_in_hands(
        Ts_canonical_grasp[left], gripper, opened[left], distance=approach_distance, between=between
    )
    hit[left] = found > 0
    return hit


def beyond(cloud: PreparedCloud) -> Tensor:
    """Places (B, 3) where things that a side of the workspace cuts off are taken to go on, straight out of it."""
    steps = torch.arange(BORDER, REACH_BEYOND, BORDER, device=cloud.points.device)
    distance = cloud.points @ cloud.sides[:, :3].T - cloud.sides[:, 3]
    point, side = (distance.abs() < BORDER).nonzero(as_tuple=True)
    some = slice(None, None, 1 + len(point) * len(steps) // MOST_BEYOND)
    places = cloud.points[point[some]][:, None] + steps[:, None] * cloud.sides[side[some], None, :3]
    return places.reshape(-1, 3)


def in_shadow(
    cloud: PreparedCloud,
    Ts_canonical_grasp: Tensor,
    gripper: Gripper,
    widths: Tensor | float,
    between: Callable[[], None] = lambda: None,
) -> Tensor:
    """Mask (C,): part of the hand at the grasp lies where every viewpoint's sight is blocked by observed points.

    The fingers and the palm's front are sampled, for hands open by `widths`, (C,) or one for all. `between` is called
    between the viewpoints.
    """
    samples = torch.tensor(
        [(*place, part.side / 2) for part in gripper.parts for place in _samples(part)],
        dtype=torch.float32,
        device=cloud.points.device,
    )
    local = samples[:, :3].repeat(len(Ts_canonical_grasp), 1, 1)
    widths = torch.as_tensor(widths, device=local.device).expand(len(local))
    local[:, :, 1] += widths[:, None] * samples[:, 3]
    places = local @ Ts_canonical_grasp[:, :3, :3].transpose(1, 2) + Ts_canonical_grasp[:, None, :3, 3]
    return hidden(cloud, places, between=between).any(dim=1)


def _samples(part: Part) -> list[tuple[float, float, float]]:
    """Places in the middle plane of a finger of the closed hand, or 5 mm behind the front of the palm."""
    if not part.side:
        return [(0.0, share * part.thickness.full / 2, part.front - 0.005) for share in (-0.9, -0.45, 0.0, 0.45, 0.9)]
    depths = [part.back + (part.front - part.back) * step / 4 for step in range(5)]
    shares = (0.1, 0.5, 0.9)
    return [(0.0, part.side * share * part.thickness.at(part.front - z), z) for share in shares for z in depths]
