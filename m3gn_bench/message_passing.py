"""Message passing networks: embed, exchange messages along edges, read out per node.

One block (paper, section 5 and table of hyper-parameters) is

    e <- LN(e + act(W_e [h_sender, h_receiver, e] + b_e)),
    h <- LN(h + act(W_h [h, mean of incoming e] + b_h)).

The products W_s h and W_r h are taken on nodes before they are gathered on edges. This is the same function
with the same number of parameters, and saves two of three matrix products per edge. The first block's products
with embedded edges and nodes are composed with the embeddings, which saves most of them.
"""

from collections.abc import Iterable
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from m3gn_bench.graph import Graph


class _SumOfEndpoints(torch.autograd.Function):
    """table[2 sender] + table[2 receiver + 1] for every edge, in one pass over memory.

    The backward pass of `embedding_bag` itself sorts the edges anew each time.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, graph: Graph) -> Tensor:
        ctx.rows, ctx.graph = len(table), graph
        return functional.embedding_bag(graph.endpoint_rows, table, mode="sum")

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,) = gradients
        total = gradient.new_zeros(ctx.rows, gradient.shape[1])
        for rows in ctx.graph.endpoint_rows.T.contiguous():
            total.index_add_(0, rows, gradient)
        return total, None


class MessagePassingBlock(nn.Module):
    """One exchange of messages; all features have the same width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge_linear = nn.Linear(width, width)
        self.endpoint_linear = nn.Linear(width, 2 * width, bias=False)  # sender's and receiver's part
        self.edge_norm = nn.LayerNorm(width)
        self.node_linear = nn.Linear(width, width)
        self.message_linear = nn.Linear(width, width, bias=False)
        self.node_norm = nn.LayerNorm(width)

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """Update nodes [nodes, width] and edges [edges, width]."""
        product = (edges, self.edge_linear.weight, self.edge_linear.bias)
        return self.update(nodes, edges, self.endpoint_linear(nodes), product, graph)

    def update(
        self,
        nodes: Tensor,
        edges: Tensor,
        endpoints: Tensor,
        product: tuple[Tensor, Tensor, Tensor],
        graph: Graph,
    ) -> tuple[Tensor, Tensor]:
        """Update nodes and edges.

        Args:
            nodes, edges: shape [nodes, width] and [edges, width].
            endpoints: the products of W_s and W_r with nodes, shape [nodes, 2 width].
            product: x, A and c with A x + c = W_e e + b_e on every edge.
            graph: the graph.
        """
        inputs, weight, bias = product
        # In place where autograd allows it, and c added to nodes, of which there are fewer than edges: on a CPU this
        # is bound by memory, not by arithmetic.
        endpoints = endpoints + functional.pad(bias, (0, len(bias)))
        message = cast(Tensor, _SumOfEndpoints.apply(endpoints.view(-1, len(bias)), graph))
        message.addmm_(inputs.to(message.dtype), weight.to(message.dtype).T)
        edges = self.edge_norm(edges + functional.leaky_relu_(message))
        # Under autocast on CUDA, edges are float32 after the norm, and nodes need not be.
        summed = edges.new_zeros(nodes.shape).index_add_(0, graph.receivers, edges)
        update = self.node_linear(nodes)
        update += self.message_linear(summed * graph.inverse_degree)
        return self.node_norm(nodes + functional.leaky_relu_(update)), edges


class MessagePassingNetwork(nn.Module):
    """Linear embeddings, blocks, and a readout of one hidden layer per node.

    Args:
        node_features: length of a node's input.
        edge_features: length of an edge's input.
        outputs: length of a node's output.
        width: of all latent features.
        steps: number of blocks (each with weights of its own).
    """

    def __init__(
        self, node_features: int, edge_features: int, outputs: int, *, width: int, steps: int
    ) -> None:
        super().__init__()
        self.embed_nodes = nn.Linear(node_features, width)
        self.embed_edges = nn.Linear(edge_features, width)
        self.blocks = nn.ModuleList(MessagePassingBlock(width) for _ in range(steps))
        self.hidden = nn.Linear(width, width)
        self.readout = nn.Linear(width, outputs)

    def forward(self, graph: Graph) -> Tensor:
        """Outputs per node, shape [nodes, outputs]."""
        nodes = self.embed_nodes(graph.node_features)
        edges = self.embed_edges(graph.edge_features)
        first, *others = cast(Iterable[MessagePassingBlock], self.blocks)
        # Inputs are many and short, so a product of weights saves one with each of them.
        weight, bias = _composed(first.edge_linear.weight, self.embed_edges)
        endpoints = functional.linear(
            graph.node_features, *_composed(first.endpoint_linear.weight, self.embed_nodes)
        )
        product = (graph.edge_features, weight, bias + first.edge_linear.bias)
        nodes, edges = first.update(nodes, edges, endpoints, product, graph)
        for block in others:
            nodes, edges = block(nodes, edges, graph)
        outputs = self.readout(functional.leaky_relu(self.hidden(nodes)))
        return outputs.to(graph.node_features.dtype)  # also under autocast


def _composed(weight: Tensor, inner: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of the layer that multiplies the output of `inner`."""
    return weight @ inner.weight, weight @ inner.bias
