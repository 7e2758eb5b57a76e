"""Networks that score candidate grasps, by name. One file each; all see the same prepared cloud and candidates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tesnet.networks.tesnet import TesNet, TesNetConfig

Network = TesNet
"""What scores candidates: `encode(cloud)` or `encode_batch(clouds)` once, then `score(features, cloud, candidates)`."""

NETWORKS: Mapping[str, tuple[type[TesNet], type[TesNetConfig]]] = {"tesnet": (TesNet, TesNetConfig)}


def build(name: str, config: Mapping[str, Any] | None = None) -> TesNet:
    """A network with fresh parameters.

    Args:
        name: one of `NETWORKS`.
        config: fields of its configuration that differ from the defaults; lists stand for tuples, as in JSON.

    Raises:
        ValueError: an unknown name or field; the message lists the valid ones.
    """
    if name not in NETWORKS:
        raise ValueError(f"unknown network {name!r}; valid: {', '.join(NETWORKS)}")
    network, config_class = NETWORKS[name]
    given: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in (config or {}).items()
    }
    fields = config_class.__dataclass_fields__
    unknown = sorted(set(given) - set(fields))
    if unknown:
        raise ValueError(f"unknown configuration {', '.join(unknown)} of {name}; valid: {', '.join(fields)}")
    return network(config_class(**given))
