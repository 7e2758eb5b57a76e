"""TES-Net-GATv2: the paper's network with graph attention in SAGE's place (section 5.2).

Everything else is `tesnet_paper`'s, cosine neighbours included.

Source of the layer: Brody et al., How Attentive are Graph Attention Networks?, arXiv 2105.14491.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

from tesnet.layers import GATv2Conv
from tesnet.networks.tesnet_paper import TesNetPaper, TesNetPaperConfig


@dataclass(frozen=True, slots=True)
class GATv2Config(TesNetPaperConfig):
    """`TesNetPaperConfig` and the number of attention heads, which divides each of `channels`."""

    heads: int = 4


class TesNetGATv2(TesNetPaper):
    """`TesNetPaper` with GATv2Conv instead of SAGEConv."""

    config: GATv2Config

    def __init__(self, config: GATv2Config) -> None:
        self._heads = config.heads
        super().__init__(config)

    def aggregation(self, channels: int) -> nn.Module:
        """The layer after each PointTransformerConv."""
        return GATv2Conv(channels, channels, heads=self._heads)
