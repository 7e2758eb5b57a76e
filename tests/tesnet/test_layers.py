"""The layers against torch_geometric with the same parameters: outputs and gradients agree to 1e-9 in float64."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from tesnet import layers

with warnings.catch_warnings():  # torch_geometric itself uses what torch deprecates
    warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
    from torch_geometric import nn as oracle

TOLERANCE = 1e-9

shapes = st.tuples(st.integers(1, 40), st.integers(1, 6), st.integers(1, 7), st.integers(1, 7), st.integers(0, 2**31))


def random_graph(points: int, neighbours: int, seed: int) -> tuple[torch.Generator, Tensor, Tensor, Tensor]:
    """Positions, a table whose first column is the point itself and whose others may repeat, and the oracle's edges."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.randn(points, 3, generator=generator, dtype=torch.float64)
    itself = torch.arange(points)[:, None]
    steps = torch.randint(1, max(points, 2), (points, neighbours if points > 1 else 0), generator=generator)
    table = torch.cat([itself, (itself + steps) % points], dim=1)
    edges = torch.stack([table.flatten(), torch.arange(points).repeat_interleave(table.shape[1])])  # source, target
    return generator, positions, table, edges


def perceptron(*widths: int) -> nn.Sequential:
    steps = [step for a, b in pairwise(widths) for step in (nn.Linear(a, b), nn.Tanh())]
    return nn.Sequential(*steps[:-1]).double()


def share(ours: nn.Linear, *theirs: nn.Linear) -> None:
    """Copy the oracle's parameters, side by side along the input channels."""
    with torch.no_grad():
        ours.weight.copy_(torch.cat([t.weight for t in theirs], dim=1))
        biases = [b for t in theirs for name, b in t.named_parameters() if name == "bias"]
        if ours.bias is not None:
            ours.bias.copy_(sum(biases, torch.zeros_like(ours.bias)))


def assert_same(
    ours: Callable[[Tensor], Tensor],
    theirs: Callable[[Tensor], Tensor],
    x: Tensor,
    parameters: Sequence[tuple[Tensor, Tensor]],
) -> None:
    """Outputs, gradients of the input and of each pair of parameters agree; the cotangent is random."""
    x = x.requires_grad_()
    actual, expected = ours(x), theirs(x)
    assert torch.allclose(actual, expected, rtol=TOLERANCE, atol=TOLERANCE)
    cotangent = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    actual_gradients = torch.autograd.grad(actual, [x, *(a for a, _ in parameters)], cotangent)
    expected_gradients = torch.autograd.grad(expected, [x, *(b for _, b in parameters)], cotangent)
    for a, b in zip(actual_gradients, expected_gradients, strict=True):
        assert torch.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE)


def random_features(points: int, channels: int, generator: torch.Generator) -> Tensor:
    return torch.randn(points, channels, generator=generator, dtype=torch.float64)


def transformer_pair(width_in: int, width_out: int) -> tuple[layers.PointTransformerConv, oracle.PointTransformerConv]:
    """Both share `pos_nn` and `attn_nn` themselves."""
    pos_nn, attn_nn = perceptron(3, 5, width_out), perceptron(width_out, 6, width_out)
    theirs = oracle.PointTransformerConv(width_in, width_out, pos_nn, attn_nn).double()
    ours = layers.PointTransformerConv(width_in, width_out, pos_nn, attn_nn).double()
    share(ours.phi, theirs.lin_dst)
    share(ours.psi, theirs.lin_src)
    share(ours.alpha, theirs.lin)
    return ours, theirs


@given(shape=shapes)
@settings(max_examples=25, deadline=None)
def test_point_transformer_equals_torch_geometric(shape: tuple[int, int, int, int, int]) -> None:
    points, neighbours, width_in, width_out, seed = shape
    # The oracle takes self loops out and puts one back for each point: the same graph, since the table holds each once.
    generator, positions, table, edges = random_graph(points, neighbours, seed)
    ours, theirs = transformer_pair(width_in, width_out)
    assert_same(
        lambda x: ours(x, table, layers.neighbour_offsets(positions, table)),
        lambda x: theirs(x, positions, edges),
        random_features(points, width_in, generator),
        [
            (ours.phi.weight, theirs.lin_dst.weight),
            (ours.psi.weight, theirs.lin_src.weight),
            (ours.alpha.weight, theirs.lin.weight),
            *((p, p) for p in [*ours.pos_nn.parameters(), *ours.attn_nn.parameters()]),
        ],
    )


def test_point_transformer_in_parts_equals_torch_geometric() -> None:
    generator, positions, table, edges = random_graph(3 * 512 + 7, 4, seed=3)  # more points than one part holds
    ours, theirs = transformer_pair(6, 8)
    assert_same(
        lambda x: ours(x, table, layers.neighbour_offsets(positions, table)),
        lambda x: theirs(x, positions, edges),
        random_features(len(table), 6, generator),
        [(ours.psi.weight, theirs.lin_src.weight), (ours.alpha.weight, theirs.lin.weight)],
    )


def test_point_transformer_without_self_loops_equals_torch_geometric_when_told_not_to_add_them() -> None:
    generator, positions, table, edges = random_graph(30, 4, seed=5)
    table, edges = table[:, 1:], edges[:, edges[0] != edges[1]]
    ours, theirs = transformer_pair(4, 5)
    theirs.add_self_loops = False
    assert_same(
        lambda x: ours(x, table, layers.neighbour_offsets(positions, table)),
        lambda x: theirs(x, positions, edges),
        random_features(30, 4, generator),
        [],
    )


def test_point_transformer_bears_logits_beyond_the_range_of_exp() -> None:
    _, positions, table, _ = random_graph(20, 4, seed=1)
    layer = layers.PointTransformerConv(3, 4, nn.Linear(3, 4), nn.Linear(4, 4)).double()
    x = (1e6 * positions).requires_grad_()
    out = layer(x, table, layers.neighbour_offsets(positions, table))
    (gradient,) = torch.autograd.grad(out.sum(), x)
    assert out.isfinite().all()
    assert gradient.isfinite().all()


@given(shape=shapes)
@settings(max_examples=25, deadline=None)
def test_sage_equals_torch_geometric(shape: tuple[int, int, int, int, int]) -> None:
    points, neighbours, width_in, width_out, seed = shape
    generator, _, table, edges = random_graph(points, neighbours, seed)
    theirs = oracle.SAGEConv(width_in, width_out, aggr="mean").double()
    ours = layers.SAGEConv(width_in, width_out).double()
    share(ours.update, theirs.lin_r, theirs.lin_l)
    assert_same(
        lambda x: ours(x, table),
        lambda x: theirs(x, edges),
        random_features(points, width_in, generator),
        [(ours.update.bias, theirs.lin_l.bias)],
    )


@given(shape=shapes, heads=st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_gatv2_equals_torch_geometric(shape: tuple[int, int, int, int, int], heads: int) -> None:
    points, neighbours, width_in, width_head, seed = shape
    generator, _, table, edges = random_graph(points, neighbours, seed)
    theirs = oracle.GATv2Conv(width_in, width_head, heads=heads).double()
    ours = layers.GATv2Conv(width_in, heads * width_head, heads=heads).double()
    share(ours.source, theirs.lin_l)
    share(ours.target, theirs.lin_r)
    with torch.no_grad():
        theirs.bias.normal_()
        ours.bias.copy_(theirs.bias)
        ours.attention.copy_(theirs.att[0])
    assert_same(
        lambda x: ours(x, table),
        lambda x: theirs(x, edges),
        random_features(points, width_in, generator),
        [
            (ours.source.weight, theirs.lin_l.weight),
            (ours.target.weight, theirs.lin_r.weight),
            (ours.bias, theirs.bias),
        ],
    )


@given(shape=shapes, has_local=st.booleans(), has_global=st.booleans())
@settings(max_examples=25, deadline=None)
def test_pointnet_equals_torch_geometric(
    shape: tuple[int, int, int, int, int], has_local: bool, has_global: bool
) -> None:
    points, neighbours, width_in, width_out, seed = shape
    generator, positions, table, edges = random_graph(points, neighbours, seed)
    first = nn.Linear(width_in + 3, 6).double()
    local_nn = nn.Sequential(nn.ReLU(), perceptron(6, 5, width_out)) if has_local else nn.Identity()
    global_nn = perceptron(width_out if has_local else 6, 4) if has_global else nn.Identity()
    theirs = oracle.PointNetConv(nn.Sequential(first, local_nn), global_nn).double()
    ours = layers.PointNetConv(
        width_in, 3, 6, local_nn if has_local else None, global_nn if has_global else None
    ).double()
    share(ours.first, first)
    assert_same(
        lambda x: ours(x, table, -layers.neighbour_offsets(positions, table)),
        lambda x: theirs(x, positions, edges),
        random_features(points, width_in, generator),
        [(ours.first.weight, first.weight), (ours.first.bias, first.bias)],
    )


def test_pointnet_takes_points_without_features() -> None:
    _, positions, table, edges = random_graph(25, 5, seed=2)
    local_nn = nn.Linear(3, 6).double()
    theirs = oracle.PointNetConv(local_nn)  # which draws its parameters anew
    ours = layers.PointNetConv(0, 3, 6).double()
    share(ours.first, local_nn)
    expected = theirs(None, positions, edges)
    actual = ours(positions[:, :0], table, -layers.neighbour_offsets(positions, table))
    assert torch.allclose(actual, expected, rtol=TOLERANCE, atol=TOLERANCE)


def run(layer: nn.Module, x: Tensor, table: Tensor, offsets: Tensor) -> Tensor:
    takes_edges = isinstance(layer, layers.PointTransformerConv | layers.PointNetConv)
    out: Tensor = layer(x, table, offsets) if takes_edges else layer(x, table)
    return out


EVERY_LAYER: dict[str, Callable[[], nn.Module]] = {
    "point_transformer": lambda: layers.PointTransformerConv(3, 6, perceptron(3, 6), perceptron(6, 6)),
    "sage": lambda: layers.SAGEConv(3, 6),
    "gatv2": lambda: layers.GATv2Conv(3, 6, heads=2),
    "pointnet": lambda: layers.PointNetConv(3, 3, 8, perceptron(8, 6)),
}


@pytest.fixture(params=EVERY_LAYER)
def layer(request: pytest.FixtureRequest) -> nn.Module:
    torch.manual_seed(0)
    return EVERY_LAYER[request.param]().double()


def test_a_permutation_of_the_points_permutes_the_output(layer: nn.Module) -> None:
    generator, positions, table, _ = random_graph(50, 5, seed=0)
    order = torch.randperm(50, generator=generator)
    rank = torch.argsort(order)
    out = run(layer, positions, table, layers.neighbour_offsets(positions, table))
    offsets = layers.neighbour_offsets(positions[order], rank[table[order]])
    assert torch.allclose(run(layer, positions[order], rank[table[order]], offsets), out[order], atol=TOLERANCE)


def test_the_order_of_the_neighbours_does_not_matter(layer: nn.Module) -> None:
    generator, positions, table, _ = random_graph(50, 5, seed=1)
    shuffled = table[:, torch.randperm(table.shape[1], generator=generator)]
    out = run(layer, positions, table, layers.neighbour_offsets(positions, table))
    again = run(layer, positions, shuffled, layers.neighbour_offsets(positions, shuffled))
    assert torch.allclose(again, out, atol=TOLERANCE)


def test_clouds_stacked_with_shifted_tables_equal_clouds_by_themselves(layer: nn.Module) -> None:
    graphs = [random_graph(points, 5, seed=points)[1:3] for points in (20, 600, 33)]
    firsts = [0, 20, 620]
    alone = [run(layer, p, t, layers.neighbour_offsets(p, t)) for p, t in graphs]
    positions = torch.cat([p for p, _ in graphs])
    table = torch.cat([t + first for (_, t), first in zip(graphs, firsts, strict=True)])
    together = run(layer, positions, table, layers.neighbour_offsets(positions, table))
    assert torch.allclose(together, torch.cat(alone), atol=TOLERANCE)


def test_output_depends_on_neighbours_alone(layer: nn.Module) -> None:
    _, positions, _, _ = random_graph(40, 5, seed=4)
    table = torch.stack([torch.arange(40), (torch.arange(40) + 1) % 20], dim=1)  # nothing points at 21 ... but itself
    x = positions.clone()
    out = run(layer, x, table, layers.neighbour_offsets(positions, table))
    x[25] += 1.0
    changed = (run(layer, x, table, layers.neighbour_offsets(positions, table)) != out).any(dim=1)
    assert changed.nonzero().flatten().tolist() == [25]


def test_offsets_point_from_neighbour_to_point() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    offsets = layers.neighbour_offsets(points, torch.tensor([[0, 1], [1, 0]]))
    assert offsets.tolist() == [[[0, 0, 0], [-1, -2, -3]], [[0, 0, 0], [1, 2, 3]]]


@pytest.mark.parametrize("heads", [0, -1, 4])
def test_heads_that_do_not_divide_the_channels_are_refused(heads: int) -> None:
    with pytest.raises(ValueError, match=f"{heads} heads do not divide 6 output channels; choose a divisor"):
        layers.GATv2Conv(3, 6, heads=heads)
