"""The block's own backward pass."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from m3gn_bench.graph import Graph
from m3gn_bench.message_passing import MessagePassingBlock, MessagePassingNetwork

NODES, EDGES, NODE_FEATURES, EDGE_FEATURES = 7, 19, 3, 4


def random_graph(edges: int = EDGES) -> Graph:
    """The first and the last node receive nothing, and some pairs of nodes have several edges."""
    senders = torch.randint(NODES, (edges,))
    receivers = torch.randint(1, NODES - 1, (edges,))
    degree = torch.bincount(receivers, minlength=NODES).clamp(min=1)[:, None]
    return Graph(
        node_features=torch.randn(NODES, NODE_FEATURES),
        edge_features=torch.randn(edges, EDGE_FEATURES),
        senders=senders,
        receivers=receivers,
        inverse_degree=1 / degree,
    )


@pytest.fixture
def _double() -> Iterator[None]:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize("edges", [EDGES, 0])
def test_gradients_are_those_of_finite_differences(edges: int) -> None:
    """Along a random direction of every weight and every input."""
    graph = random_graph(edges)
    network = MessagePassingNetwork(NODE_FEATURES, EDGE_FEATURES, 2, width=8, steps=3)
    direction_of_output = torch.randn(NODES, 2)
    inputs = {
        "node_features": graph.node_features,
        "edge_features": graph.edge_features,
        **{name: value.detach().clone() for name, value in network.named_parameters()},
    }

    def value(tensors: dict[str, Tensor]) -> Tensor:
        given = replace(graph, node_features=tensors["node_features"], edge_features=tensors["edge_features"])
        weights = {name: tensor for name, tensor in tensors.items() if not name.endswith("_features")}
        return (torch.func.functional_call(network, weights, (given,)) * direction_of_output).sum()

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    gradients = dict(zip(leaves, torch.autograd.grad(value(leaves), list(leaves.values())), strict=True))
    step = 1e-6
    for name, tensor in inputs.items():
        direction = torch.randn_like(tensor)
        with torch.no_grad():
            plus, minus = (value(inputs | {name: tensor + sign * step * direction}) for sign in (1, -1))
        slope = ((plus - minus) / (2 * step)).item()
        assert (gradients[name] * direction).sum().item() == pytest.approx(slope, rel=1e-6, abs=1e-8), name


@pytest.mark.usefixtures("_double")
def test_a_second_backward_pass_is_refused() -> None:
    """What the first one overwrote would give wrong gradients."""
    network = MessagePassingNetwork(NODE_FEATURES, EDGE_FEATURES, 2, width=8, steps=2)
    loss = network(random_graph()).sum()
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.usefixtures("_double")
def test_edges_alone_have_gradients() -> None:
    """Of a block whose nodes nobody reads."""
    graph, block = random_graph(), MessagePassingBlock(8)
    edges = torch.randn(EDGES, 8, requires_grad=True)
    block(torch.randn(NODES, 8), edges, graph)[1].square().sum().backward()
    assert edges.grad is not None
    assert edges.grad.abs().max() > 0
    assert block.node_linear.weight.grad is not None
    assert block.node_linear.weight.grad.abs().max() == 0


def test_bfloat16_is_near() -> None:
    """Under autocast outputs and gradients are those of float32, but for the digits that bfloat16 has.

    With this seed no activation is so near to zero that it has another sign there, which alone can make a quarter.
    """
    torch.manual_seed(10)
    graph = random_graph()
    network = MessagePassingNetwork(NODE_FEATURES, EDGE_FEATURES, 2, width=16, steps=3)

    def results(precise: bool) -> list[Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=not precise):
            outputs = network(graph)
        gradients = torch.autograd.grad(outputs.square().sum(), list(network.parameters()))
        return [outputs, *gradients]

    for precise, rough in zip(results(True), results(False), strict=True):
        assert precise.dtype == rough.dtype == torch.float32
        assert (precise - rough).norm() < 0.03 * precise.norm() + 1e-6
