from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tesnet import weights
from tests.training.synthetic import labelled_view, write
from training.fit import PRESETS, fit
from training.processes import Processes


def test_a_process_that_nothing_started_is_alone() -> None:
    alone = Processes.joined()
    assert (alone.rank, alone.count, alone.leads) == (0, 1, True)


def test_two_processes_train_what_one_trains(tmp_path: Path) -> None:
    # Five views make steps of two, of which the last has none for the second process.
    write(tmp_path / "train", [labelled_view(seed) for seed in range(5)])
    write(tmp_path / "validation", [labelled_view(5)])
    alone, together = tmp_path / "alone.safetensors", tmp_path / "together.safetensors"
    fit("tesnet", [tmp_path / "train"], [tmp_path / "validation"], PRESETS["comparison"], alone, epochs=2, threads=1)
    torchrun = "-m torch.distributed.run --standalone --nproc-per-node 2 -m training fit --preset comparison --epochs 2"
    paths = {"--data": tmp_path / "train", "--validation": tmp_path / "validation", "--out": together}
    options = ["--threads", "1", *(str(word) for pair in paths.items() for word in pair)]
    subprocess.run([sys.executable, *torchrun.split(), *options], check=True, capture_output=True, timeout=600)

    def losses(path: Path) -> list[float]:
        lines = path.with_suffix(".log.jsonl").read_text().splitlines()
        return [json.loads(line)["train_loss"] for line in lines]

    assert losses(together) == pytest.approx(losses(alone), abs=1e-5)
    expected, found = weights.load(alone)[0], weights.load(together)[0]
    assert all(torch.allclose(found[name], tensor, atol=1e-4) for name, tensor in expected.items())
