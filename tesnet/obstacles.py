"""Points that a hand must not meet, sorted into blocks so that each hand is held against those near it alone.

Knows no query and no network. Vectorised torch; lengths in metres; points and poses in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tesnet.geometry import Gripper
from tesnet.points import members_of_cells, points_in_grasp_frames
from tesnet.swept import boxes_of, inside_hand

BLOCK_SIZE = 0.025
"""Edge of a block: many lie within a hand, and one holds some dozen cells of a surface."""

_POSES_AT_ONCE = 512
_PAIRS_AT_ONCE = 250_000
"""Pairs of a hand and a point that are in memory at a time, some 10 MB."""


@dataclass(frozen=True, eq=False, slots=True)
class Obstacles:
    """O points in B blocks; make it with `Obstacles.of`.

    Args:
        points: (O, 3), the points of a block one after the other.
        first, count: (B,) where a block begins and how many points it has.
        centres, radii: (B, 3) and (B,) of a sphere about each block's points.
    """

    points: Tensor
    first: Tensor
    count: Tensor
    centres: Tensor
    radii: Tensor

    @classmethod
    def of(cls, points: Tensor) -> Obstacles:
        """The points (O, 3) in blocks."""
        if len(points) == 0:
            none = torch.zeros(0, dtype=torch.long, device=points.device)
            return cls(points, none, none, points, points.new_zeros(0))
        block, count = members_of_cells(points, BLOCK_SIZE)
        order = block.argsort(stable=True)
        points, block = points[order], block[order]
        low = points.new_zeros(len(count), 3).scatter_reduce(
            0, block[:, None].expand(-1, 3), points, "amin", include_self=False
        )
        high = points.new_zeros(len(count), 3).scatter_reduce(
            0, block[:, None].expand(-1, 3), points, "amax", include_self=False
        )
        return cls(points, count.cumsum(0) - count, count, (low + high) / 2, (high - low).norm(dim=1) / 2)

    def __len__(self) -> int:
        return len(self.points)

    def count_in_hands(
        self,
        poses: Tensor,
        gripper: Gripper,
        widths: Tensor | float,
        *,
        distance: float = 0.0,
        depth: float = 0.0,
        between: Callable[[], None] = lambda: None,
    ) -> Tensor:
        """(C,) how many of the points lie in each hand.

        Args:
            poses: (C, 4, 4) TCP poses.
            gripper: the hand.
            widths: openings of the fingers, (C,) or one for all.
            distance: length of the straight way, ending in the pose, on which a point counts as in the hand.
            depth: only points at least so deep under the hand's surface count.
            between: called between blocks of work of some milliseconds.
        """
        found = torch.zeros(len(poses), dtype=torch.long, device=poses.device)
        if len(poses) == 0:
            return found
        widths = torch.as_tensor(widths, dtype=poses.dtype, device=poses.device).expand(len(poses))
        boxes = boxes_of(gripper, float(widths.min()), float(widths.max()), distance)
        for row, local in self._near(poses, boxes, between):
            found.index_add_(0, row, inside_hand(*local, gripper, widths[row], distance, depth).long())
        return found

    def _near(
        self,
        poses: Tensor,
        boxes: Sequence[tuple[Sequence[float], Sequence[float]]],
        between: Callable[[], None],
    ) -> Iterator[tuple[Tensor, tuple[Tensor, Tensor, Tensor]]]:
        """The points of the blocks that a box in the frame of each pose touches, many poses at a time.

        Args:
            poses: (C, 4, 4).
            boxes: their least and greatest |x|, |y| and z in the frame of a pose.
            between: called between blocks of work of some milliseconds.

        Yields:
            (K,) numbers of poses, and x, y and z, each (K,), of a point in the frame of that pose.
        """
        if len(self) == 0:
            return
        for first in range(0, len(poses), _POSES_AT_ONCE):
            some = poses[first : first + _POSES_AT_ONCE]
            row, block = self._touching(some, boxes)
            between()
            total = self.count[block].cumsum(0)
            begin = 0
            while begin < len(row):
                done = int(total[begin - 1]) if begin else 0
                stop = max(begin + 1, int(torch.searchsorted(total, done + _PAIRS_AT_ONCE, right=True)))
                pose_of, points = self._pairs(row[begin:stop], block[begin:stop])
                yield first + pose_of, _in_grasp_frames(points, some[pose_of])
                begin = stop
                between()

    def _touching(self, poses: Tensor, boxes: Sequence[tuple[Sequence[float], Sequence[float]]]) -> tuple[Tensor, ...]:
        """Pairs, (K,) and (K,), of poses and blocks whose sphere meets a box (of |x|, |y|, z) at the pose."""
        x, y, z = points_in_grasp_frames(self.centres, poses)
        places = (x.abs_(), y.abs_(), z)
        touching = torch.zeros_like(x, dtype=torch.bool)
        for low, high in boxes:
            outside = torch.zeros_like(x)
            for place, least, most in zip(places, low, high, strict=True):
                outside += (place - place.clamp(least, most)).square_()
            touching |= outside <= self.radii.square()
        return touching.nonzero(as_tuple=True)

    def _pairs(self, row: Tensor, block: Tensor) -> tuple[Tensor, Tensor]:
        """The rows (K,) of all points (K, 3) of the blocks, row by row."""
        count = self.count[block]
        start = count.cumsum(0) - count
        within = torch.arange(int(count.sum()), device=row.device) - start.repeat_interleave(count)
        return row.repeat_interleave(count), self.points[self.first[block].repeat_interleave(count) + within]


def _in_grasp_frames(points: Tensor, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z, each (K,), of each point (K, 3) in the grasp frame of its pose (K, 4, 4)."""
    x, y, z = ((points - poses[:, :3, 3])[:, :, None] * poses[:, :3, :3]).sum(dim=1).unbind(dim=1)
    return x, y, z
