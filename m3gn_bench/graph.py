"""Graphs for message passing: features of nodes and edges at given moments.

Features, for every method alike (paper, appendix B; lengths from its parameter counts):

- A node has its type's one-hot code (mesh or collider), the task's static features (zero on the collider), the
  height where the task has no other way to know the ground, and whatever a model adds.
- An edge has its type's one-hot code; the vector between its nodes at rest and the length, zero unless it is a
  mesh edge; and the same at the moment. Vectors are sender minus receiver, so nothing changes when the whole
  scene is translated.

Mesh and collider are connected, both ways, where nodes are closer than `CONTACT_RADIUS` at the moment.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from torch import Tensor

from m3gn_bench.data import Body, with_length
from m3gn_bench.tasks import Task

CONTACT_RADIUS = 0.3  # scaled units (paper, table of hyper-parameters)
FAR_AWAY = 1e30  # scaled units


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

    @cached_property
    def endpoint_rows(self) -> Tensor:
        """Rows of a table [2 nodes, n] with a node's part as sender and as receiver in turn, shape [edges, 2]."""
        return torch.stack([2 * self.senders, 2 * self.receivers + 1], dim=1)

    @cached_property
    def edges_by_receiver(self) -> tuple[Tensor, Tensor]:
        """Edges grouped by receiver, shape [edges], and where each node's begin, shape [nodes]."""
        return _by_group(self.receivers, len(self.node_features))

    @cached_property
    def edges_by_endpoint_row(self) -> tuple[Tensor, Tensor]:
        """Edges grouped by the rows of `endpoint_rows`, shape [2 edges], and where each row's begin, [2 nodes]."""
        ends, starts = _by_group(self.endpoint_rows.flatten(), 2 * len(self.node_features))
        return ends // 2, starts


def _by_group(groups: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Members grouped, those of a group in order, and where each of `count` groups begins."""
    if groups.is_cuda:
        sizes = torch.bincount(groups, minlength=count)
        return torch.argsort(groups, stable=True), sizes.cumsum(0) - sizes
    members = np.arange(len(groups))
    # Counts instead of sorting, which takes five times as long.
    table = coo_array(
        (np.ones(len(groups), dtype=bool), (groups.cpu().numpy(), members)), shape=(count, len(groups))
    )
    rows = table.tocsr()
    order, starts = (torch.from_numpy(part.astype(np.int64)) for part in (rows.indices, rows.indptr[:-1]))
    return order.to(groups.device), starts.to(groups.device)


def build_graph(
    task: Task, body: Body, positions: Tensor, collider: Tensor, features: Tensor | None = None
) -> Graph:
    """The union of one graph per moment.

    Args:
        task: says which features all models share.
        body: the bodies.
        positions: of mesh nodes at each moment, shape [moments, nodes, dim].
        collider: of collider nodes, shape [moments, collider_nodes, dim].
        features: what the model adds to each node if anything, mesh nodes first, shape [moments,
            nodes + collider_nodes, features].

    Returns:
        A graph whose nodes are ordered by moment; in a moment, mesh nodes come first.
    """
    moments, nodes = len(positions), body.nodes + body.collider_nodes
    shift = (torch.arange(moments, device=positions.device) * nodes)[:, None]
    edges = [(body.edges[:, None] + shift).flatten(1)]
    if task.collider_has_edges:
        edges.append((body.collider_edges[:, None] + body.nodes + shift).flatten(1))
    if task.has_collider:
        contacts = contact_pairs(body, positions, collider)
        edges += [contacts.flip(0), contacts]
    senders, receivers = torch.cat(edges, dim=1)
    place = torch.cat([positions, collider], dim=1).flatten(0, 1)
    world = with_length(place[senders] - place[receivers])
    static = world.new_zeros(len(senders), task.edge_types + task.dimension + 1)
    for kind, part in enumerate(static.split([pairs.shape[1] for pairs in edges])):
        part[:, kind] = 1
    static[: moments * body.edges.shape[1], task.edge_types :] = body.rest_vectors.repeat(moments, 1)
    node_features = shared_node_features(task, body, positions)
    if features is not None:
        node_features = torch.cat([node_features, features], dim=-1)
    return Graph(
        node_features=node_features.flatten(0, 1),
        edge_features=torch.cat([static, world], dim=-1),
        senders=senders,
        receivers=receivers,
        inverse_degree=1 / torch.bincount(receivers, minlength=moments * nodes).clamp(min=1)[:, None],
    )


def shared_node_features(task: Task, body: Body, positions: Tensor) -> Tensor:
    """What every model knows of a node, shape [moments, nodes + collider_nodes, task.node_features]."""
    moments = len(positions)
    features = positions.new_zeros(moments, body.nodes + body.collider_nodes, task.node_features)
    mesh, collider = features[:, : body.nodes], features[:, body.nodes :]
    mesh[..., 0] = 1
    if task.has_collider:
        collider[..., 1] = 1
    last = task.node_types + len(task.static_features)
    mesh[..., task.node_types : last] = body.static_features
    if task.height_feature:
        mesh[..., last] = positions[..., -1]
    return features


def on_mesh(body: Body, values: Tensor) -> Tensor:
    """Values of mesh nodes [moments, nodes, n] with zeros on collider nodes appended."""
    return torch.cat([values, values.new_zeros(len(values), body.collider_nodes, values.shape[-1])], dim=1)


def on_collider(body: Body, values: Tensor) -> Tensor:
    """Values of collider nodes [moments, collider_nodes, n] after zeros on mesh nodes."""
    return torch.cat([values.new_zeros(len(values), body.nodes, values.shape[-1]), values], dim=1)


def contact_pairs(body: Body, positions: Tensor, collider: Tensor) -> Tensor:
    """Mesh nodes and collider nodes of the same body closer than the contact radius at the same moment.

    Args:
        body: the bodies.
        positions, collider: shape [moments, nodes, dim] and [moments, collider_nodes, dim].

    Returns:
        Indices into the nodes of all moments (in each, mesh nodes come first), shape [2, pairs].
    """
    moments, nodes = len(positions), body.nodes + body.collider_nodes
    bodies = len(body.node_counts)

    def tree(points: Tensor, body_of_point: Tensor) -> cKDTree:
        # One more coordinate keeps bodies and moments apart, so a single tree serves all of them.
        group = np.arange(moments)[:, None] * bodies + body_of_point.cpu().numpy()
        flat = points.detach().cpu().numpy().astype(np.float64)
        # What a diverging rollout has thrown to infinity touches nothing.
        flat = np.where(np.isfinite(flat), flat, FAR_AWAY)
        apart = np.concatenate([flat, 2 * CONTACT_RADIUS * group[..., None]], axis=-1)
        return cKDTree(apart.reshape(-1, apart.shape[-1]))

    found = tree(positions, body.body_of_node).sparse_distance_matrix(
        tree(collider, body.body_of_collider_node), CONTACT_RADIUS, output_type="ndarray"
    )
    found = found[found["v"] < CONTACT_RADIUS]
    mesh_moment, mesh_node = np.divmod(found["i"], body.nodes)
    collider_moment, collider_node = np.divmod(found["j"], body.collider_nodes)
    pairs = np.stack([mesh_moment * nodes + mesh_node, collider_moment * nodes + body.nodes + collider_node])
    return torch.from_numpy(pairs).to(positions.device)
