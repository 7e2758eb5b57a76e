"""Networks that score candidate grasps, by name. One file and one line of `NETWORKS` each.

All are given the same candidates, and clouds prepared as they ask for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from tesnet import weights
from tesnet.errors import WeightsError
from tesnet.networks.edgegrasp import EdgeGrasp, EdgeGraspConfig
from tesnet.networks.gatv2 import GATv2Config, TesNetGATv2
from tesnet.networks.gpd import GPD, GPDConfig
from tesnet.networks.heuristic import Heuristic, HeuristicConfig
from tesnet.networks.network import Network, encode
from tesnet.networks.pointnetgpd import PointNetGPD, PointNetGPDConfig
from tesnet.networks.tesnet import TesNet, TesNetConfig
from tesnet.networks.tesnet_paper import TesNetEuclideanConfig, TesNetPaper, TesNetPaperConfig

__all__ = ["NETWORKS", "Network", "build", "device_of", "encode", "is_weightless", "load"]

NETWORKS: Mapping[str, tuple[type[Network], type[Any]]] = {
    "tesnet": (TesNet, TesNetConfig),
    "tesnet-paper": (TesNetPaper, TesNetPaperConfig),
    "tesnet-euclidean": (TesNetPaper, TesNetEuclideanConfig),
    "gatv2": (TesNetGATv2, GATv2Config),
    "edgegrasp": (EdgeGrasp, EdgeGraspConfig),
    "pointnetgpd": (PointNetGPD, PointNetGPDConfig),
    "gpd": (GPD, GPDConfig),
    "heuristic": (Heuristic, HeuristicConfig),
}
"""The class of each network and of its configuration, whose fields all have defaults."""


def build(name: str, config: Mapping[str, Any] | None = None) -> Network:
    """A network with fresh parameters.

    Args:
        name: one of `NETWORKS`.
        config: fields of its configuration that differ from the defaults; lists stand for tuples, as in JSON.

    Raises:
        ValueError: an unknown name or field; the message lists the valid ones.
    """
    if name not in NETWORKS:
        raise ValueError(f"unknown network {name!r}; valid: {', '.join(NETWORKS)}")
    network_class, config_class = NETWORKS[name]
    given: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in (config or {}).items()
    }
    fields = config_class.__dataclass_fields__
    unknown = sorted(set(given) - set(fields))
    if unknown:
        raise ValueError(f"unknown configuration {', '.join(unknown)} of {name}; valid: {', '.join(fields)}")
    return network_class(config_class(**given))


def is_weightless(name: str) -> bool:
    """Whether a network, one of `NETWORKS`, has no parameters: nothing to train and no file to load.

    Raises:
        ValueError: an unknown name; the message lists the valid ones.
    """
    return not list(build(name).parameters())


def device_of(network: Network) -> torch.device:
    """Where a network's parameters are; the CPU for one without."""
    return next(network.parameters(), torch.empty(0)).device


def load(path: Path) -> tuple[Network, weights.Header]:
    """The network of a weights file, on the CPU and in evaluation mode, and the file's header.

    Raises:
        WeightsError: the file is missing, corrupted or does not fit its network.
    """
    state_dict, header = weights.load(path)
    try:
        network = build(header.network, header.configuration["network"])
    except (KeyError, TypeError, ValueError) as error:
        why = f"its configuration does not build a network of this version ({error}); get matching weights"
        raise WeightsError(path, why) from error
    weights.verify(path, state_dict, {name: tensor.shape for name, tensor in network.state_dict().items()})
    network.load_state_dict(state_dict)
    return network.eval(), header
