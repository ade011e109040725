"""Graphs for message passing: features of nodes and edges at a given moment.

Edge features, for every method alike (paper, appendix B; order as in reference implementations): the edge
type's one-hot code, the vector between the two nodes at rest and its length, the same at the moment. All
vectors are sender minus receiver, so features do not change when the whole scene is translated.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from m3gn_bench.data import Body


@dataclass(frozen=True, eq=False)
class Graph:
    """A graph, or a disjoint union of several.

    Attributes:
        node_features: shape [nodes, features].
        edge_features: shape [edges, features].
        senders, receivers: node indices, shape [edges].
        inverse_degree: one over the number of incoming edges, shape [nodes, 1].
    """

    node_features: Tensor
    edge_features: Tensor
    senders: Tensor
    receivers: Tensor
    inverse_degree: Tensor


def with_length(vectors: Tensor) -> Tensor:
    """Vectors and their lengths, shape [..., dim + 1]."""
    return torch.cat([vectors, vectors.norm(dim=-1, keepdim=True)], dim=-1)


def build_graph(body: Body, positions: Tensor, node_features: Tensor) -> Graph:
    """The union of one mesh graph per moment.

    Args:
        body: the bodies.
        positions: at each moment, shape [moments, nodes, dim].
        node_features: shape [moments, nodes, features].

    Returns:
        A graph of moments * nodes nodes, ordered by moment.
    """
    moments = len(positions)
    senders, receivers = body.edges
    rest = with_length(body.rest_positions[senders] - body.rest_positions[receivers])
    world = with_length(positions[:, senders] - positions[:, receivers])
    kind = rest.new_ones(1, 1).expand(len(senders), -1)  # a single type of edge: the mesh's
    static = torch.cat([kind, rest], dim=-1).expand(moments, -1, -1)
    shift = (torch.arange(moments, device=senders.device) * body.nodes)[:, None]
    degree = torch.bincount(receivers, minlength=body.nodes).clamp(min=1)
    return Graph(
        node_features=node_features.flatten(0, 1),
        edge_features=torch.cat([static, world], dim=-1).flatten(0, 1),
        senders=(senders + shift).flatten(),
        receivers=(receivers + shift).flatten(),
        inverse_degree=(1 / degree).repeat(moments)[:, None],
    )


def static_node_features(body: Body) -> Tensor:
    """Node type (one-hot; here a single type) and the task's static features, shape [nodes, features]."""
    kind = body.static_features.new_ones(body.nodes, 1)
    return torch.cat([kind, body.static_features], dim=-1)
