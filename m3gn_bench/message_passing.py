"""Message passing networks: embed, exchange messages along edges, read out per node.

One block (paper, section 4 and table of hyper-parameters) is

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
from torch.autograd.function import once_differentiable
from torch.nn import functional

from m3gn_bench.graph import Graph

LEAKY_RELU_SLOPE = 0.01  # torch's own, as the next
LAYER_NORM_EPS = 1e-5


class _Exchange(torch.autograd.Function):
    """The block, given what of W_e's product is known on nodes, with a backward pass of its own.

    The product on edges is A x, where x is `edges` if `inputs` is None; `endpoints` [nodes, 2 width] has the rest for
    each node as a sender and as a receiver. The backward pass accumulates in place what autograd would add up from
    tensors of their own (docs/performance.md says what that saves). It overwrites what was saved for it, so torch
    refuses to go through it a second time.
    """

    @staticmethod
    def forward(
        ctx: Any,
        nodes: Tensor,
        edges: Tensor,
        inputs: Tensor | None,
        weight: Tensor,
        endpoints: Tensor,
        edge_norm_weight: Tensor,
        edge_norm_bias: Tensor,
        node_weight: Tensor,
        node_bias: Tensor,
        message_weight: Tensor,
        node_norm_weight: Tensor,
        node_norm_bias: Tensor,
        graph: Graph,
    ) -> tuple[Tensor, Tensor]:
        ctx.graph, ctx.recurrent = graph, inputs is None
        ctx.set_materialize_grads(False)
        dtype = endpoints.dtype  # of products, also under autocast
        inputs = (edges if inputs is None else inputs).to(dtype)
        update = functional.embedding_bag(graph.endpoint_rows, endpoints.view(-1, edges.shape[1]), mode="sum")
        functional.leaky_relu_(update.addmm_(inputs, weight.to(dtype).T), LEAKY_RELU_SLOPE)
        edges, for_edges = _add_and_norm(edges, update, edge_norm_weight, edge_norm_bias)

        node_inputs = nodes.to(dtype)
        mean = _sum_by_group(edges, graph.edges_by_receiver).mul_(graph.inverse_degree).to(dtype)
        update = torch.addmm(node_bias.to(dtype), node_inputs, node_weight.to(dtype).T)
        functional.leaky_relu_(update.addmm_(mean, message_weight.to(dtype).T), LEAKY_RELU_SLOPE)
        nodes, for_nodes = _add_and_norm(nodes, update, node_norm_weight, node_norm_bias)
        products = inputs, weight, node_inputs, node_weight, mean, message_weight
        ctx.save_for_backward(*products, *for_edges, *for_nodes)
        return nodes, edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_nodes: Tensor | None, of_edges: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs, weight, node_inputs, node_weight, mean, message_weight, *saved = ctx.saved_tensors
        for_edges, for_nodes = saved[:6], saved[6:]
        if of_nodes is None:  # nobody reads the nodes
            of_nodes = torch.zeros_like(for_nodes[0])
        of_nodes, of_update, *of_node_norm = _add_and_norm_backward(of_nodes, *for_nodes)
        of_node_linear = of_update.T @ node_inputs, of_update.sum(0), of_update.T @ mean
        _add_product(of_nodes, of_update, node_weight)
        of_mean = (of_update @ message_weight.to(of_update.dtype)).mul_(ctx.graph.inverse_degree)

        received = of_mean.index_select(0, ctx.graph.receivers)
        if of_edges is not None:  # None: the last block, whose edges nobody reads
            received = received.to(of_edges.dtype).add_(of_edges)
        of_edges, of_update, *of_edge_norm = _add_and_norm_backward(received, *for_edges)
        of_endpoints = _sum_by_group(of_update, ctx.graph.edges_by_endpoint_row).view(len(mean), -1)
        of_weight = of_update.T @ inputs
        of_inputs = None
        if ctx.recurrent:
            _add_product(of_edges, of_update, weight)
        elif ctx.needs_input_grad[2]:
            of_inputs = of_update @ weight.to(of_update.dtype)
        of_products = of_inputs, of_weight, of_endpoints
        return of_nodes, of_edges, *of_products, *of_edge_norm, *of_node_linear, *of_node_norm, None


def _add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Add left @ right in place; the product has the precision of `left`, also under autocast."""
    right = right.to(left.dtype)
    if total.dtype == left.dtype:
        total.addmm_(left, right)
    else:
        total += left @ right


def _sum_by_group(edges: Tensor, groups: tuple[Tensor, Tensor]) -> Tensor:
    """Sums of edges, shape [groups, width]; `index_add` takes three times as long."""
    order, starts = groups
    return functional.embedding_bag(order, edges, starts, mode="sum")


def _add_and_norm(
    before: Tensor, update: Tensor, weight: Tensor, bias: Tensor
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """LN(before + update), and what `_add_and_norm_backward` takes after the gradient."""
    total = before + update
    if total.is_cuda:
        total = total.to(weight.dtype)  # as autocast does there
    normed, mean, inverse_deviation = torch.native_layer_norm(
        total, weight.shape, weight, bias, LAYER_NORM_EPS
    )
    return normed, (update, total, mean, inverse_deviation, weight, bias)


def _add_and_norm_backward(
    gradient: Tensor,
    update: Tensor,
    total: Tensor,
    mean: Tensor,
    inverse_deviation: Tensor,
    weight: Tensor,
    bias: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of `before`, of what was activated to `update` (and is written there), of weight and bias."""
    of_total, of_weight, of_bias = torch.ops.aten.native_layer_norm_backward(
        gradient.to(total.dtype), total, weight.shape, mean, inverse_deviation, weight, bias, [True] * 3
    )
    of_update = torch.ops.aten.leaky_relu_backward(
        of_total.to(update.dtype), update, LEAKY_RELU_SLOPE, True, grad_input=update
    )
    return of_total, of_update, of_weight, of_bias


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
        bias = _of_senders(self.edge_linear.bias)
        endpoints = functional.linear(nodes, self.endpoint_linear.weight, bias)
        return self.exchange(nodes, edges, None, self.edge_linear.weight, endpoints, graph)

    def exchange(
        self,
        nodes: Tensor,
        edges: Tensor,
        inputs: Tensor | None,
        weight: Tensor,
        endpoints: Tensor,
        graph: Graph,
    ) -> tuple[Tensor, Tensor]:
        """The same, given the products of which `_Exchange` makes the message."""
        edge_norm, node_norm = (
            (self.edge_norm.weight, self.edge_norm.bias),
            (self.node_norm.weight, self.node_norm.bias),
        )
        node_linear = self.node_linear.weight, self.node_linear.bias, self.message_linear.weight
        products = inputs, weight, endpoints
        updated = _Exchange.apply(nodes, edges, *products, *edge_norm, *node_linear, *node_norm, graph)
        return cast(tuple[Tensor, Tensor], updated)


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
        endpoint_weight, endpoint_bias = _composed(first.endpoint_linear.weight, self.embed_nodes)
        endpoint_bias = endpoint_bias + _of_senders(bias + first.edge_linear.bias)
        endpoints = functional.linear(graph.node_features, endpoint_weight, endpoint_bias)
        nodes, edges = first.exchange(nodes, edges, graph.edge_features, weight, endpoints, graph)
        for block in others:
            nodes, edges = block(nodes, edges, graph)
        outputs = self.readout(functional.leaky_relu(self.hidden(nodes)))
        return outputs.to(graph.node_features.dtype)  # also under autocast


def _composed(weight: Tensor, inner: nn.Linear) -> tuple[Tensor, Tensor]:
    """Weight and bias of the layer that multiplies the output of `inner`."""
    return weight @ inner.weight, weight @ inner.bias


def _of_senders(bias: Tensor) -> Tensor:
    """A bias of edges as one of endpoints: added to nodes as senders, of which there are fewer than edges."""
    return functional.pad(bias, (0, len(bias)))
