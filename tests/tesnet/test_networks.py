from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from tesnet import cloud, networks, weights
from tesnet.candidates import Candidates
from tesnet.networks import Network
from tesnet.networks.tesnet import TesNet, TesNetConfig
from tesnet.predictor import GraspPredictor, configuration_of
from tests.tesnet.scenes import prepared, tabletop_query


def test_an_unknown_network_or_field_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="unknown network 'vgn'; valid: tesnet"):
        networks.build("vgn")
    with pytest.raises(ValueError, match="unknown configuration depth of tesnet; valid: channels, wide_channels"):
        networks.build("tesnet", {"depth": 3})


def test_a_configuration_from_json_builds_the_same_network() -> None:
    network = networks.build("tesnet", {"channels": 16, "region_channels": [32, 48]})
    assert isinstance(network, TesNet)
    assert network.config.region_channels == (32, 48)
    assert network.state_dict()["lift.weight"].shape[0] == 16


class Counting(torch.nn.Module):
    """The least that is a network: its feature of a cloud is the number of its points, and all candidates score it."""

    preparation: ClassVar[cloud.PreparationConfig] = cloud.PreparationConfig(voxel_size=0.006)
    scored_at_once: ClassVar[int] = 100
    knows_hands: ClassVar[bool] = False

    def __init__(self, config: TesNetConfig) -> None:
        super().__init__()
        self.config = config
        self.factor = torch.nn.Parameter(torch.ones(1))

    def encode_batch(self, clouds: Sequence[cloud.PreparedCloud]) -> list[int]:
        return [len(one) for one in clouds]

    def score(
        self, features: int, cloud: cloud.PreparedCloud, candidates: Candidates, mirror: torch.Tensor | None = None
    ) -> torch.Tensor:
        return (features / 1e5 * self.factor).expand(len(candidates))


def test_a_network_that_is_registered_answers_from_its_weights_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any module with the protocol's members, its clouds prepared as it wants them."""
    entry: tuple[type[Network], type[Any]] = (Counting, TesNetConfig)
    monkeypatch.setattr(networks, "NETWORKS", {**networks.NETWORKS, "counting": entry})
    network = networks.build("counting")
    path = tmp_path / "counting.safetensors"
    weights.save(path, network.state_dict(), weights.Header("counting", "1", configuration_of(network)))
    result = GraspPredictor.load(path).predict(tabletop_query())
    expected = torch.sigmoid(torch.tensor(len(prepared(tabletop_query(), voxel_size=0.006)) / 1e5))
    assert len(result.grasps)
    np.testing.assert_allclose(result.grasps.scores, float(expected), rtol=1e-6)
