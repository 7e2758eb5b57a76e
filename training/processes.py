"""Several processes that train one network together, as torchrun starts them; one alone where nothing started them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, distributed, nn


@dataclass(frozen=True, slots=True)
class Processes:
    """This process among those that share each step's views.

    Args:
        rank: of this one, from 0.
        count: of all.
    """

    rank: int = 0
    count: int = 1

    @classmethod
    def joined(cls) -> Processes:
        """Those that torchrun started, met through its environment variables."""
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            return cls()
        if not distributed.is_initialized():
            distributed.init_process_group("gloo")
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def leads(self) -> bool:
        """Whether this is the one that measures and writes for all."""
        return self.rank == 0

    def summed(self, parameters: Sequence[nn.Parameter], loss: Tensor) -> float:
        """Gives every process the sum of all gradients, and returns that of the losses ().

        A process without a view in this step takes part with zeros.
        """
        if self.count > 1:
            gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
            flat = torch.cat([gradient.flatten() for gradient in gradients] + [loss.flatten()]).cpu()
            distributed.all_reduce(flat)
            sizes = [p.numel() for p in parameters]
            *parts, loss = flat.to(parameters[0].device).split([*sizes, 1])
            for parameter, part in zip(parameters, parts, strict=True):
                parameter.grad = part.view_as(parameter)
        return float(loss)

    def from_leader(self, value: float) -> float:
        """The leader's value, for every process."""
        shared = torch.tensor(value, dtype=torch.float64)
        if self.count > 1:
            distributed.broadcast(shared, 0)
        return float(shared)

    def meet(self) -> None:
        """Waits until all are here."""
        if self.count > 1:
            distributed.barrier()


ALONE = Processes()
