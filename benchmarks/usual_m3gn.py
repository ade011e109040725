"""The yardstick: M3GN's network written the usual way, on the same weights.

Per block, every edge gathers the features of both its nodes, concatenates them with its own, and puts the result
through one linear layer; every node adds up its incoming edges. One graph is built per context pair, and the
graphs are concatenated. `MessagePassingBlock` computes the same function; this is what its speed is compared with.
"""

from dataclasses import fields

import torch
from torch import Tensor, nn
from torch.nn import functional

from m3gn_bench.data import Context
from m3gn_bench.graph import Graph, build_graph, on_collider, on_mesh
from m3gn_bench.m3gn import M3GN, ContextEncoder
from m3gn_bench.message_passing import MessagePassingBlock, MessagePassingNetwork


class PlainBlock(nn.Module):
    """One exchange of messages on concatenated features; initialised with the weights of `block`."""

    def __init__(self, block: MessagePassingBlock) -> None:
        super().__init__()
        width = block.edge_linear.in_features
        self.edge_linear = nn.Linear(3 * width, width)
        self.edge_norm = nn.LayerNorm(width)
        self.node_linear = nn.Linear(2 * width, width)
        self.node_norm = nn.LayerNorm(width)
        endpoints = block.endpoint_linear.weight.chunk(2)
        weights = {
            "edge_linear.weight": torch.cat([*endpoints, block.edge_linear.weight], dim=1),
            "edge_linear.bias": block.edge_linear.bias,
            "node_linear.weight": torch.cat([block.node_linear.weight, block.message_linear.weight], dim=1),
            "node_linear.bias": block.node_linear.bias,
        }
        for name in ("edge_norm", "node_norm"):
            weights |= {f"{name}.{key}": value for key, value in getattr(block, name).state_dict().items()}
        self.load_state_dict(weights)

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """Update nodes [nodes, width] and edges [edges, width]."""
        inputs = torch.cat([nodes[graph.senders], nodes[graph.receivers], edges], dim=-1)
        edges = self.edge_norm(edges + functional.leaky_relu(self.edge_linear(inputs)))
        place = graph.receivers[:, None].expand_as(edges)
        mean = torch.zeros_like(nodes).scatter_add(0, place, edges) * graph.inverse_degree
        update = self.node_linear(torch.cat([nodes, mean], dim=-1))
        return self.node_norm(nodes + functional.leaky_relu(update)), edges

    def gradients(self) -> dict[str, Tensor]:
        """Gradients by the names that the weights have in `MessagePassingBlock`."""
        found = {name: parameter.grad for name, parameter in self.named_parameters()}
        edge, node = found["edge_linear.weight"], found["node_linear.weight"]
        assert edge is not None
        assert node is not None
        sender, receiver, own = edge.chunk(3, dim=1)
        own_node, message = node.chunk(2, dim=1)
        return found | {  # type: ignore[return-value]
            "edge_linear.weight": own,
            "endpoint_linear.weight": torch.cat([sender, receiver]),
            "node_linear.weight": own_node,
            "message_linear.weight": message,
        }


class PlainNetwork(nn.Module):
    """`MessagePassingNetwork` of plain blocks; initialised with the weights of `network`."""

    def __init__(self, network: MessagePassingNetwork) -> None:
        super().__init__()

        def copy(layer: nn.Linear) -> nn.Linear:
            copied = nn.Linear(layer.in_features, layer.out_features)
            copied.load_state_dict(layer.state_dict())
            return copied

        self.embed_nodes, self.embed_edges = copy(network.embed_nodes), copy(network.embed_edges)
        self.blocks = nn.ModuleList(PlainBlock(block) for block in network.blocks)  # type: ignore[arg-type]
        self.hidden, self.readout = copy(network.hidden), copy(network.readout)

    def forward(self, graph: Graph) -> Tensor:
        """Outputs per node, shape [nodes, outputs]."""
        nodes = self.embed_nodes(graph.node_features)
        edges = self.embed_edges(graph.edge_features)
        for block in self.blocks:
            nodes, edges = block(nodes, edges, graph)
        return self.readout(functional.leaky_relu(self.hidden(nodes)))


def concatenate(graphs: list[Graph]) -> Graph:
    """The disjoint union of graphs."""
    parts = {field.name: [getattr(graph, field.name) for graph in graphs] for field in fields(Graph)}
    starts = torch.tensor([0, *(len(graph.node_features) for graph in graphs[:-1])]).cumsum(0)
    for name in ("senders", "receivers"):
        parts[name] = [part + start for part, start in zip(parts[name], starts, strict=True)]
    return Graph(**{name: torch.cat(values) for name, values in parts.items()})


class PlainEncoder(ContextEncoder):
    """The context network with one graph per pair, built one after the other."""

    def encode(self, context: Context, pairs: Tensor, velocity_scale: Tensor) -> Tensor:
        """What the network says of every pair, shape [pairs, nodes + collider_nodes, outputs]."""
        body, frames, path = context.body, context.positions, context.collider_path
        graphs = []
        for t in pairs.tolist():
            now = slice(t, t + 1)
            features = [on_mesh(body, (frames[t + 1 : t + 2] - frames[now]) / velocity_scale)]
            if self.task.has_collider:
                features.insert(0, on_collider(body, path[-1:] - path[now]))
            graphs.append(build_graph(self.task, body, frames[now], path[now], torch.cat(features, dim=-1)))
        return self.network(concatenate(graphs)).unflatten(0, (len(pairs), -1))


class PlainM3GN(M3GN):
    """M3GN of plain networks, with the weights of `model`."""

    encoder_class = PlainEncoder

    def __init__(self, model: M3GN) -> None:
        super().__init__(model.task, model.config)
        self.load_state_dict(model.state_dict())
        self.encoder.network = PlainNetwork(self.encoder.network)  # type: ignore[assignment]
        self.simulator.network = PlainNetwork(self.simulator.network)  # type: ignore[assignment]

    def gradients(self) -> dict[str, Tensor]:
        """Gradients by the names that the weights have in `M3GN`."""
        found = {}
        for prefix, module in self.named_modules():
            if isinstance(module, PlainBlock):
                found |= {f"{prefix}.{name}": value for name, value in module.gradients().items()}
        found |= {
            name: parameter.grad
            for name, parameter in self.named_parameters()
            if ".blocks." not in name and parameter.grad is not None
        }
        return found
