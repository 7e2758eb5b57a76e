"""Where a hand stands along its closing direction so that both fingers pass beside the thing: a small network tells.

Of most things the camera sees one side. How far the other lies, what was seen between the fingers tells in part: a rim,
how the surface curves, where the table begins to show. This network learned it from simulated things whose walls are
known, so it needs no grasp to be tried; `training.centring` makes it. Vectorised torch; lengths in metres; everything
in the cloud's canonical frame.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from tesnet import weights
from tesnet.candidates import Candidates, between_palm_and_tips, contact_places
from tesnet.cloud import PreparedCloud
from tesnet.errors import WeightsError
from tesnet.geometry import Gripper

NAME = "centring"

_BINS_PAST_CONTACT, _BINS_BEHIND = 6, 42
BINS = _BINS_PAST_CONTACT + _BINS_BEHIND
"""Slices across the closing direction, each a fortieth of the widest opening thick, from a few past the contact point
to as far as the other finger can be."""

OPENING = 40.0
"""Half of the widest opening, in the unit of places."""

PLACES = torch.arange(44) - 41.5
"""Where the hand's middle may stand, from the contact point, in eightieths of the widest opening."""

_BY_BIN, BY_HAND = 6, 10
SEEN = BINS * _BY_BIN + BY_HAND
"""Numbers that the network is told of each candidate."""

_MOST_POINTS = 10.0
_DEPTH_UNIT, _BREADTH_UNIT, _HEIGHT_UNIT = 0.05, 0.02, 0.1

_TOWARDS_MIDDLE = (0.003, 0.03)
"""Log probability that a place loses for each eightieth of the opening between it and the likely middle: where the hand
hardly fits, and where it surely has room to spare."""

_SURE, _ABOUT = 0.97, 0.01
"""Of the likeliest place the probability that the fingers pass, from which on there is room to spare; within what."""

_SHARPNESS = 0.03
"""Log probability within which places count as equally good; their mean is taken, so that rounding decides nothing."""


class Centring(nn.Module):
    """Tells at which places a hand's middle may stand so that its fingers pass on both sides of what they close on.

    Args:
        hidden: units of the two layers in between.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, hidden: int = 128) -> None:
        super().__init__()
        self.hidden = hidden
        self.register_buffer("mean", torch.zeros(SEEN))
        self.register_buffer("spread", torch.ones(SEEN))
        self.layers = nn.Sequential(
            nn.Linear(SEEN, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, len(PLACES) + 1)
        )

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (C, 44) of passing there, and the likely middle (C,) in the places' unit, from the contact point.

        Args:
            seen: (C, SEEN), of `seen_between`.
        """
        told = self.layers((seen - self.mean) / self.spread)
        return told[:, :-1], 10 * told[:, -1]

    def place(self, seen: Tensor) -> Tensor:
        """(C,) where each hand's middle should stand, in the places' unit, from the contact point.

        Args:
            seen: (C, SEEN), of `seen_between`.
        """
        logits, middle = self(seen)
        places = PLACES.to(logits.device)
        probable = nn.functional.logsigmoid(logits)
        has_room = torch.sigmoid((probable.exp().amax(dim=1, keepdim=True) - _SURE) / _ABOUT)
        (least, most), aside = _TOWARDS_MIDDLE, (places - middle[:, None]).abs()
        worth = probable - (least + (most - least) * has_room) * aside
        best: Tensor = (worth / _SHARPNESS).softmax(dim=1) @ places
        return best

    @torch.no_grad()
    def shifts(self, seen: Tensor, cloud: PreparedCloud, candidates: Candidates) -> Tensor:
        """(C,) metres along the closing direction from where each hand stands to where it should.

        Args:
            seen: (C, SEEN), of `seen_between`.
            cloud: what was seen.
            candidates: whose tips are where they rest (`candidates.at_rest`).
        """
        return contact_places(cloud, candidates) + self.place(seen) * place_unit(candidates.gripper)


def place_unit(hand: Gripper) -> float:
    """Metres between neighbouring places."""
    return hand.max_width / (2 * OPENING)


def seen_between(cloud: PreparedCloud, candidates: Candidates) -> Tensor:
    """(C, SEEN) what was seen between the fingers of each candidate, slice by slice, and its hand.

    Of each slice: how many points, their mean normal along the closing direction and along the travel, their mean depth
    behind the tips, their mean distance from the hand's middle plane, and how deep the deepest lies. Of the hand: where
    its contact point lies, its sizes, the direction of travel against `up` and the height over the support, 0 where
    these are not known, and the direction to the camera.
    """
    poses, hand = candidates.Ts_canonical_grasp, candidates.gripper
    near, thickness = contact_places(cloud, candidates), 2 * place_unit(hand)
    beside, y, z, inside = between_palm_and_tips(cloud, candidates)
    along = (near[:, None] - y) / thickness + _BINS_PAST_CONTACT
    inside &= (along >= 0) & (along < BINS)
    row, index = inside.nonzero(as_tuple=True)
    normals = cloud.normals[index]
    behind = (hand.tip_offset - z[row, index]) / _DEPTH_UNIT
    told = torch.stack(
        [
            torch.ones_like(behind),
            (normals * poses[row, :3, 1]).sum(dim=1),
            (normals * poses[row, :3, 2]).sum(dim=1),
            behind,
            beside[row, index] / _BREADTH_UNIT,
        ],
        dim=1,
    )
    slot = row * BINS + along[row, index].long()
    sums = torch.zeros(len(near) * BINS, told.shape[1], dtype=told.dtype, device=told.device).index_add_(0, slot, told)
    deepest = torch.zeros(len(near) * BINS, dtype=told.dtype, device=told.device)
    deepest.scatter_reduce_(0, slot, 1 / (1 + behind.clamp(min=0)), "amax")
    count = sums[:, :1]
    by_bin = torch.cat([count.clamp(max=_MOST_POINTS) / _MOST_POINTS, sums[:, 1:] / count.clamp(min=1)], dim=1)
    by_bin = torch.cat([by_bin, deepest[:, None]], dim=1).view(len(near), -1)
    return torch.cat([by_bin, _of_hand(cloud, candidates, near)], dim=1)


def reaches(seen: Tensor, share: float) -> Tensor:
    """(C,) whether something was seen farther from the contact point than a share of the opening, and within it.

    Args:
        seen: (C, SEEN), of `seen_between`.
        share: of the widest opening.
    """
    slices = int(OPENING)  # two places thick each
    counts = seen[:, : BINS * _BY_BIN : _BY_BIN]
    return (counts[:, _BINS_PAST_CONTACT + int(share * slices) : _BINS_PAST_CONTACT + slices] > 0).any(dim=1)


def _of_hand(cloud: PreparedCloud, candidates: Candidates, near: Tensor) -> Tensor:
    poses, hand = candidates.Ts_canonical_grasp, candidates.gripper
    travel, tcp = poses[:, :3, 2], poses[:, :3, 3]
    down = height = torch.zeros_like(near)
    if cloud.up is not None:
        down = -(travel @ cloud.up)
        if cloud.support_height is not None:
            height = ((tcp @ cloud.up - cloud.support_height) / _HEIGHT_UNIT).clamp(-1.0, 4.0)
    sizes = (hand.max_width, hand.finger_breadth, hand.tip_offset - hand.palm_front)
    view = (cloud.view_directions[candidates.contact][:, None] @ poses[:, :3, :3])[:, 0]
    return torch.cat(
        [
            (near / hand.max_width)[:, None],
            down[:, None],
            height[:, None],
            torch.full_like(height, float(cloud.support_height is not None))[:, None],
            view,
            near.new_tensor(sizes).expand(len(near), 3),
        ],
        dim=1,
    )


def load(path: Path) -> tuple[Centring, str]:
    """The network in a weights file, ready to be asked, and its version.

    Raises:
        WeightsError: the file is missing, damaged or holds something else.
    """
    state, header = weights.load(path)
    if header.network != NAME:
        raise WeightsError(path, f"holds network {header.network!r}, not {NAME!r}; get the file of this version")
    network = Centring(**header.configuration)
    weights.verify(path, state, {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()})
    network.load_state_dict(state)
    return network.eval().requires_grad_(requires_grad=False), header.version


@cache
def shipped(version: str, device: torch.device) -> Centring:
    """The network that comes with the project, where it is to be asked.

    Raises:
        WeightsError: the file is missing or damaged, or of another version than is asked for.
    """
    path = weights.default_weights(NAME)
    network, found = load(path)
    if found != version:
        raise WeightsError(path, f"is version {found}, and version {version} is wanted; install matching weights")
    return network.to(device)
