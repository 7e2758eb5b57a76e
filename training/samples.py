"""Samples drawn from an archive's scenes, a file a scene, and the passes over them that fit a small network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from tesnet.whole_file import write_whole
from training.views import LabelsError, number_of

_HELD_OUT = 23
"""One scene of so many is not trained on; a prime, so that these go round all folds (`views.Fold`)."""

_BATCH = 512


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """S samples.

    Args:
        columns: (S, ...) by their names.
        scenes: (S,) numbers of the scenes that they are of.
    """

    columns: dict[str, Tensor]
    scenes: Tensor

    @property
    def train(self) -> Tensor:
        """Indices of those that are trained on."""
        return (self.scenes % _HELD_OUT).nonzero()[:, 0]

    @property
    def held_out(self) -> Tensor:
        """Indices of the others."""
        return (self.scenes % _HELD_OUT == 0).nonzero()[:, 0]


def write_samples(path: Path, **columns: NDArray[Any]) -> None:
    """Writes the samples of one scene, whole."""
    packed = BytesIO()
    np.savez(packed, allow_pickle=False, **columns)
    write_whole(path, packed.getvalue())


def read_samples(folder: Path, stem: str) -> Samples:
    """The samples in the files `STEM_NUMBER.npz` of a folder, in the order of their scenes.

    Raises:
        LabelsError: there are no such files.
    """
    files = sorted(folder.glob(f"{stem}_*.npz"))
    if not files:
        raise LabelsError(f"{folder} holds no {stem}_*.npz; draw some from an archive")
    columns: dict[str, list[Tensor]] = {}
    scenes = []
    for file in files:
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: torch.from_numpy(stored[name]) for name in stored.files}
        count = len(next(iter(arrays.values())))
        if not count:
            continue
        scenes.append(torch.full((count,), number_of(file)))
        for name, array in arrays.items():
            columns.setdefault(name, []).append(array)
    return Samples({name: torch.cat(parts) for name, parts in columns.items()}, torch.cat(scenes))


def descend(
    rows: Tensor,
    loss_of: Callable[[Tensor], Tensor],
    optimiser: torch.optim.Optimizer,
    schedule_over: Callable[[int], torch.optim.lr_scheduler.LRScheduler],
    epochs: int,
) -> None:
    """Passes over samples in a new order each time, a step for each batch.

    Args:
        rows: of the samples.
        loss_of: the loss () of some rows.
        optimiser: of what is fitted.
        schedule_over: the schedule of its rate over so many steps.
        epochs: passes.
    """
    steps = -(-len(rows) // _BATCH)
    schedule = schedule_over(epochs * steps)
    for epoch in range(epochs):
        total = 0.0
        for batch in tqdm(rows[torch.randperm(len(rows))].split(_BATCH), desc=f"epoch {epoch}"):
            loss = loss_of(batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        tqdm.write(f"epoch {epoch}: {total / steps:.4f}")
