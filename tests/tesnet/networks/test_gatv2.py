from __future__ import annotations

from tesnet import networks
from tesnet.layers import GATv2Conv, SAGEConv
from tesnet.networks.tesnet_paper import TesNetPaper


def test_gatv2_has_attention_where_the_paper_has_sage_and_nothing_else_differs() -> None:
    paper, gatv2 = networks.build("tesnet-paper"), networks.build("gatv2")
    assert isinstance(paper, TesNetPaper)
    assert isinstance(gatv2, TesNetPaper)
    assert all(isinstance(stage.aggregate, SAGEConv) for stage in paper.stages)
    assert all(isinstance(stage.aggregate, GATv2Conv) and stage.aggregate.heads == 4 for stage in gatv2.stages)
    shapes = [
        {key: value.shape for key, value in network.state_dict().items() if ".aggregate." not in key}
        for network in (paper, gatv2)
    ]
    assert shapes[0] == shapes[1]
