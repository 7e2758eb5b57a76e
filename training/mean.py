"""The mean of several weights of one network, where each was trained from the one before it.

Such a mean is often better than each on what they were trained on in turn (Wortsman et al. 2022, arXiv 2109.01903).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from tesnet import networks, weights
from tesnet.predictor import configuration_of
from training.evaluate import validate
from training.views import LabelsError, load_views


def mean(
    files: Sequence[Path],
    validation: Sequence[Path],
    out: Path,
    *,
    settings: Mapping[str, Any] = MappingProxyType({}),
    seed: int = 0,
    version: str = "0",
) -> dict[str, Any]:
    """Writes the mean of the weights in `files` to `out` and returns its validation measures.

    Args:
        files: of one network with one configuration.
        validation: folders of labelled scenes, which fit the calibration, too.
        out: the weights file.
        settings: fields of the network's configuration that are to differ from that of the files.
        seed: of the measures' subsampling.
        version: that the weights' header carries.

    Raises:
        LabelsError: files of different networks, or folders without labels.
        WeightsError: a file cannot be read.
    """
    loaded = [networks.load(path) for path in files]
    begun, first = loaded[0]
    # Of the networks, not of the headers: an older file says nothing of a field that came after it.
    configuration = configuration_of(begun)["network"]
    for path, (other, header) in zip(files, loaded, strict=True):
        if (header.network, configuration_of(other)["network"]) != (first.network, configuration):
            raise LabelsError(f"{path} holds another network than {files[0]}; give weights of one network")
    states = [one.state_dict() for one, _ in loaded]
    network = networks.build(first.network, {**configuration, **settings})
    network.load_state_dict({name: torch.stack([state[name] for state in states]).mean(dim=0) for name in states[0]})
    measures, of_all = validate(network, list(load_views(validation, network.preparation)), seed)
    training = {
        "mean_of": [
            {"sha256": weights.sha256(path), "training": header.training}
            for path, (_, header) in zip(files, loaded, strict=True)
        ],
        "validation": measures,
        "validation_with_blocked": of_all,
    }
    weights.save(
        out,
        network.state_dict(),
        weights.Header(first.network, version, configuration_of(network), tuple(measures["calibration"]), training),
    )
    return training
