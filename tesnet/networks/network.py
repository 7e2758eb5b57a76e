"""What the predictor and the training know of a network: two calls, what it is built from, and what clouds it wants.

Knows no network of its own. Whatever a network finds in a cloud is its own affair: nobody else looks into it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from tesnet.candidates import Candidates
from tesnet.cloud import PreparationConfig, PreparedCloud

if TYPE_CHECKING:
    from typing_extensions import Self


class Network(Protocol):
    """Scores candidate grasps of prepared clouds. Any `torch.nn.Module` with these members is one.

    Args:
        config: a frozen dataclass of JSON values and tuples of them; travels in the header of the weights.
    """

    config: Any
    preparation: ClassVar[PreparationConfig]
    """How clouds are prepared when the network is trained afresh; of trained weights the header has the last word."""
    scored_at_once: ClassVar[int]
    """So many candidates take a core some tens of milliseconds; between as many it is asked whether anybody waits."""

    def __init__(self, config: Any) -> None: ...

    @property
    def knows_hands(self) -> bool:
        """Whether scores are those of the candidates' hand; else they are the Franka hand's, whatever the hand."""
        ...

    def encode_batch(self, clouds: Sequence[PreparedCloud]) -> list[Any]:
        """What `score` needs of each cloud, one value a cloud, computed once however many candidates it has.

        Each value equals that of a batch of one up to the rounding of float32.
        """
        ...

    def score(
        self, features: Any, cloud: PreparedCloud, candidates: Candidates, mirror: Tensor | None = None
    ) -> Tensor:
        """Logits (C,) of a cloud's candidates.

        Args:
            features: what `encode_batch` gave for this cloud.
            cloud: P points.
            candidates: C grasps.
            mirror: (C,) +1 or -1; -1 shows the candidate's surroundings reflected in the hand's plane, under which the
                outcome of a grasp does not change. For training; a network that cannot do it leaves it alone.
        """
        ...

    # Of torch.nn.Module, which a protocol cannot inherit from, what this package and the training call.

    def to(self, device: torch.device) -> Self: ...  # noqa: D102
    def train(self, mode: bool = True) -> Self: ...  # noqa: D102
    def eval(self) -> Self: ...  # noqa: D102
    def parameters(self) -> Iterator[nn.Parameter]: ...  # noqa: D102
    def state_dict(self) -> dict[str, Any]: ...  # noqa: D102
    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any: ...  # noqa: D102


def mirror_factors(mirror: Tensor) -> Tensor:
    """(C, 3) factors of x, y and z in the grasp frame: those of a reflection in the hand's plane where `mirror` is -1.

    Args:
        mirror: (C,) +1 or -1, as `Network.score` takes it.
    """
    one = torch.ones_like(mirror)
    return torch.stack([mirror, one, one], dim=1)


def encode(network: Network, cloud: PreparedCloud) -> Any:
    """What `network.score` needs of one cloud."""
    return network.encode_batch([cloud])[0]
