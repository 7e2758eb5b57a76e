"""Samples come back in the order of their scenes, and every one that is trained on is shown once a pass."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from training.samples import descend, read_samples, write_samples
from training.views import LabelsError


def test_samples_come_back_by_scene_and_some_scenes_are_held_out(tmp_path: Path) -> None:
    for number, count in ((21, 2), (46, 3), (3, 1), (50, 0)):
        seen = np.full((count, 4), number, np.float16)
        write_samples(tmp_path / f"looks_{number:07d}.npz", seen=seen, kind=np.full(count, number, np.uint8))
    write_samples(tmp_path / "walls_0000001.npz", seen=np.zeros((5, 4)))
    known = read_samples(tmp_path, "looks")
    assert known.scenes.tolist() == [3, 21, 21, 46, 46, 46]
    assert set(known.columns) == {"seen", "kind"}
    assert known.columns["seen"].dtype == torch.float16
    assert torch.equal(known.columns["seen"][:, 0].long(), known.scenes)
    assert torch.equal(known.columns["kind"].long(), known.scenes)
    assert (known.train.tolist(), known.held_out.tolist()) == ([0, 1, 2], [3, 4, 5])
    with pytest.raises(LabelsError, match="holds no cells_"):
        read_samples(tmp_path, "cells")


def test_each_pass_shows_every_row_once_and_the_rate_follows_the_schedule_to_its_end() -> None:
    weight = torch.nn.Parameter(torch.zeros(()))
    optimiser = torch.optim.SGD([weight], lr=1.0)
    shown: list[torch.Tensor] = []

    def loss_of(rows: torch.Tensor) -> torch.Tensor:
        shown.append(rows)
        return (weight - 1) ** 2

    rows = torch.arange(100, 700)
    torch.manual_seed(0)
    descend(rows, loss_of, optimiser, partial(torch.optim.lr_scheduler.CosineAnnealingLR, optimiser), epochs=3)
    assert [len(batch) for batch in shown] == [512, 88] * 3
    passes = [torch.cat(shown[first : first + 2]) for first in (0, 2, 4)]
    assert all(torch.equal(one.sort().values, rows) for one in passes)
    assert not torch.equal(passes[0], passes[1])
    assert optimiser.param_groups[0]["lr"] == pytest.approx(0.0, abs=1e-9)
    assert weight.item() != 0
