"""EGNO: equivariant message passing and convolutions in Fourier space over a fixed number of predicted steps.

Xu et al. 2024 as the M3GN paper adapts it (section 4, appendix C). The anchor's state is repeated for every
predicted step; each of the layers is, per time and with vectors r_ij = x_i - x_j,

    h <- h + act(K h),   (x - mean, v) <- (x - mean, v) + K' (x - mean, v),
    m_ij = phi_e(h_i, h_j, |r_ij|^2, e_ij),
    h <- h + phi_h(h, mean_j m_ij),
    x <- x + v phi_v(h) + mean_j r_ij phi_x(m_ij),

with K and K' linear and diagonal in time's frequencies, of which the lowest are kept. Vectors are only scaled
by scalars and added, so that the prediction turns with the scene where the scalars do not depend on axes.

Decisions where the paper and its parameter counts leave a choice:

- The horizon is what the smallest context, two frames, leaves. For later anchors the tail is cut, in training
  and in prediction (paper, appendix C); there the collider's path goes on at rest.
- The counts give edges the features of all other models, and nodes the collider's displacement. Both contain
  vectors, and reading them as scalars would break the equivariance that gives the model its name. With
  `invariant` (the default) their places hold zeros except for the vector's length, so that shapes and counts
  remain; otherwise they are read as they are. The sheet's load and the height above ground are scalars in both.
- v is the last movement, in units of its standard deviation; positions are in units of the displacement's.
- What enters as direction is then v, the vectors between nodes, and the collider's true path: its nodes are at
  their place at every time, and are not updated.
- Nodes of prescribed position are put back before every exchange, so that distances tell of them, too.
- Squared distances are given as their difference to the anchor's, which is more precise and no less.
- Messages and vectors are averaged: sums grow with the number of neighbours, and diverge with depth.
- The velocity is scaled by the updated h, or the last layer's phi_h would do nothing.
- The layers' last weights for vectors start small, so that training starts from standing still.
- What neighbours move a node by in a layer is limited per component, as in the authors' code: squared distances, which
  messages read, throw out the further what is out already. In units of displacements the limit is far off.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from m3gn_bench.baselines.spacetime import TIME_FEATURES, edges_at_a_time, time_embedding
from m3gn_bench.data import Body, Case, Context
from m3gn_bench.errors import ConfigError
from m3gn_bench.graph import Graph, build_graph, on_collider
from m3gn_bench.model import ModelConfig, TrajectoryModel, hold_fixed
from m3gn_bench.tasks import Task

SMALL = 0.1  # of a usual initial weight
FAR = 100.0  # standard deviations of displacements


class EGNOConfig(ModelConfig):
    """Hyper-parameters of EGNO (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    layers: int = Field(default=5, ge=1)
    modes: int = Field(default=2, ge=1, le=16)  # lowest frequencies kept in time, the mean included
    invariant: bool = True  # lengths instead of vectors among the scalar features


class SpectralConvolution(nn.Module):
    """A linear map of the lowest frequencies in time; the others are dropped.

    Equals a real Fourier transform over time, a complex matrix for each of the first `modes` coefficients, and
    the inverse transform. For so few modes both transforms are products with small matrices.
    """

    analysis: Tensor
    synthesis: Tensor

    def __init__(self, channels: int, times: int, modes: int, initial: float) -> None:
        super().__init__()
        if 2 * (modes - 1) >= times:
            raise ConfigError(
                f"model.modes: {times} steps have no more than {(times + 1) // 2} modes, not {modes}"
            )
        self.weight = nn.Parameter(initial * torch.randn(modes, 2, channels, channels))  # real, imaginary
        angles = 2 * math.pi / times * torch.outer(torch.arange(modes), torch.arange(times))
        waves = torch.stack([angles.cos(), -angles.sin()], dim=1).flatten(0, 1)  # of real, of imaginary
        share = torch.full((2 * modes, 1), 2 / times)  # every frequency but zero stands for two
        share[:2] = 1 / times
        self.register_buffer("analysis", waves, persistent=False)
        self.register_buffer("synthesis", (share * waves).T.contiguous(), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Features [items, times, channels] mapped to the same shape."""
        modes, _, channels, _ = self.weight.shape
        real, imaginary = self.weight.unbind(1)
        matrices = torch.cat(  # from real and imaginary parts to real and imaginary parts
            [torch.cat([real, imaginary], dim=-1), torch.cat([-imaginary, real], dim=-1)], dim=1
        )
        spectrum = (self.analysis @ features).view(-1, modes, 2 * channels)
        spectrum = torch.bmm(spectrum.transpose(0, 1), matrices).transpose(0, 1)
        return self.synthesis @ spectrum.reshape(-1, 2 * modes, channels)


@dataclass(frozen=True, eq=False)
class Scene:
    """What the layers read and do not change; lengths are in units of displacements.

    Attributes:
        graph: the anchor's.
        edge_features: shape [edges, features].
        fixed: mesh nodes that never move, shape [nodes, 1, 1], bool.
        anchor: positions of mesh nodes minus the body's mean, shape [nodes, 1, dim].
        collider: its positions minus the bodies' mean, shape [collider_nodes, times, dim].
        squared_distances: of every edge at the anchor, shape [edges, 1, 1].
        edge_length: typical length of a mesh edge, no shape.
    """

    graph: Graph
    edge_features: Tensor
    fixed: Tensor
    anchor: Tensor
    collider: Tensor
    squared_distances: Tensor
    edge_length: Tensor


class EquivariantLayer(nn.Module):
    """One convolution over time and one exchange of messages."""

    def __init__(self, width: int, edge_features: int, times: int, modes: int) -> None:
        super().__init__()
        self.convolution = SpectralConvolution(width, times, modes, 0.5 / width**0.5)
        self.vector_convolution = SpectralConvolution(2, times, modes, 1e-3)
        self.distance_linear = nn.Linear(1, width)
        self.edge_linear = nn.Linear(edge_features, width, bias=False)
        self.sender_linear = nn.Linear(width, width, bias=False)
        self.receiver_linear = nn.Linear(width, width, bias=False)
        self.message_linear = nn.Linear(width, width)
        self.vector_scalar = _scalar_network(width)
        self.velocity_scalar = _scalar_network(width)
        self.node_linear = nn.Linear(width, width)
        self.received_linear = nn.Linear(width, width, bias=False)
        self.node_readout = nn.Linear(width, width)

    def forward(self, nodes: Tensor, vectors: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
        """Update scalars and vectors.

        Args:
            nodes: scalars, shape [nodes + collider_nodes, times, width].
            vectors: position minus mean and velocity of mesh nodes, shape [nodes, dim, times, 2].
            scene: the rest.
        """
        # In place where autograd allows it: on a CPU this is bound by memory, not by arithmetic. It does so at
        # a cost for views, hence the flattened inputs of linear layers.
        nodes = nodes + functional.leaky_relu(self.convolution(nodes))
        vectors = vectors + self.vector_convolution(vectors.flatten(0, 1)).view_as(vectors)
        position, velocity = vectors.transpose(1, 2).unbind(-1)
        position = torch.where(scene.fixed, scene.anchor, position)

        received, pulled = self._exchange(nodes, torch.cat([position, scene.collider]), scene)
        update = self.node_linear(nodes.flatten(0, 1))
        update += self.received_linear(received.flatten(0, 1))
        nodes = nodes + self.node_readout(functional.leaky_relu_(update)).view_as(nodes)
        mesh = len(position)
        position = position + velocity * self.velocity_scalar(nodes[:mesh]) + pulled[:mesh]
        return nodes, torch.stack([position, velocity], dim=-1).transpose(1, 2)

    def _exchange(self, nodes: Tensor, places: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
        """Means over incoming edges of messages and of scaled vectors, shape [nodes, times, width or dim]."""
        graph = scene.graph
        sender, receiver = self.sender_linear(nodes), self.receiver_linear(nodes)
        received, pulled = torch.zeros_like(nodes), torch.zeros_like(places)
        for senders, receivers, features, distances in zip(
            *(
                values.split(edges_at_a_time(graph, *nodes.shape[1:]))
                for values in (graph.senders, graph.receivers, scene.edge_features, scene.squared_distances)
            ),
            strict=True,
        ):
            between = places.index_select(0, receivers) - places.index_select(0, senders)
            change = between.square().sum(-1, keepdim=True) - distances
            message = sender.index_select(0, senders)
            message += receiver.index_select(0, receivers)
            message += self.edge_linear(features)[:, None]
            message += self.distance_linear(change / scene.edge_length**2)
            message = self.message_linear(functional.leaky_relu_(message).flatten(0, 1))
            message = functional.leaky_relu_(message)
            scalar = self.vector_scalar(message).view_as(change)
            received.index_add_(0, receivers, message.view(len(senders), *nodes.shape[1:]))
            pulled.index_add_(0, receivers, between * (scalar / scene.edge_length))
        mean = graph.inverse_degree[:, None]
        return received * mean, (pulled * mean).clamp(-FAR, FAR)


class EGNO(TrajectoryModel):
    """The model; `predict` needs one call for the whole horizon."""

    Config = EGNOConfig
    preset_file = "egno.toml"
    config: EGNOConfig

    edge_length: Tensor  # typical, scaled units

    def __init__(self, task: Task, config: EGNOConfig) -> None:
        super().__init__(task, config)
        width = config.width
        self.horizon = task.frames - 2
        self.register_buffer("edge_length", torch.ones(()))
        self.embed = nn.Linear(task.node_features + task.collider_features + TIME_FEATURES, width)
        self.layers = nn.ModuleList(
            EquivariantLayer(width, task.edge_features, self.horizon, config.modes)
            for _ in range(config.layers)
        )

    def prepare(self, cases: Sequence[Case]) -> None:
        """Take statistics from the training data, before the first step."""
        super().prepare(cases)
        lengths = [case.body.rest_vectors[:, -1] for case in cases]
        self.edge_length.fill_(float(torch.cat(lengths).double().square().mean().sqrt()))

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]. Raises ConfigError beyond the trained horizon."""
        body, path, now = context.body, context.collider_path, context.size - 1
        if context.horizon > self.horizon:
            raise ConfigError(
                f"frame {context.size + self.horizon}: this egno predicts {self.horizon} frames after the anchor, not "
                f"{context.horizon}; ask for fewer, or train it on longer trajectories"
            )
        anchor = context.positions[-1]
        ahead = path[-1:] - path[now]
        if self.config.invariant:
            ahead = _length_only(ahead)
        features = on_collider(body, ahead)[..., : self.task.collider_features]
        graph = build_graph(self.task, body, anchor[None], path[now][None], features)

        steps = torch.arange(now + 1, now + 1 + self.horizon, device=anchor.device)
        times = time_embedding(steps, now).expand(len(graph.node_features), -1, -1)
        inputs = graph.node_features[:, None].expand(-1, self.horizon, -1)
        nodes = self.embed(torch.cat([inputs, times], dim=-1))
        mean = body_means(body, anchor)
        position = (anchor - mean[body.body_of_node]) / self.displacement_scale
        velocity = (anchor - context.positions[-2]) / self.velocity_scale
        vectors = torch.stack([position, velocity], dim=-1)[:, :, None].expand(-1, -1, self.horizon, -1)
        scene = self._scene(context, graph, position, mean, steps)
        for layer in self.layers:
            nodes, vectors = layer(nodes, vectors, scene)
        moved = vectors[..., 0].permute(2, 0, 1)[: context.horizon] - position
        return hold_fixed(context, anchor + moved * self.displacement_scale)

    def _scene(self, context: Context, graph: Graph, position: Tensor, mean: Tensor, steps: Tensor) -> Scene:
        body, path = context.body, context.collider_path
        true_path = path[steps.clamp(max=context.frames - 1)] - mean[body.body_of_collider_node]
        types, vector = self.task.edge_types, self.task.dimension + 1
        kinds, rest, world = graph.edge_features.split([types, vector, vector], dim=-1)
        if self.config.invariant:
            rest, world = (torch.cat([torch.zeros_like(v[:, :-1]), v[:, -1:]], dim=-1) for v in (rest, world))
        return Scene(
            graph=graph,
            edge_features=torch.cat([kinds, rest, world], dim=-1),
            fixed=body.fixed[:, None, None],
            anchor=position[:, None],
            collider=(true_path / self.displacement_scale).transpose(0, 1),
            squared_distances=(world[:, -1:, None] / self.displacement_scale).square(),
            edge_length=self.edge_length / self.displacement_scale,
        )


def body_means(body: Body, positions: Tensor) -> Tensor:
    """Mean position of each body's mesh nodes, shape [bodies, dim], from [nodes, dim]."""
    return torch.stack([part.mean(0) for part in positions.split(body.node_counts)])


def _length_only(vectors: Tensor) -> Tensor:
    """The length of each vector in the place of its first component, zeros for the others."""
    return torch.cat([vectors.norm(dim=-1, keepdim=True), torch.zeros_like(vectors[..., 1:])], dim=-1)


def _scalar_network(width: int) -> nn.Sequential:
    """A scalar from features; it starts small."""
    last = nn.Linear(width, 1)
    with torch.no_grad():
        last.weight *= SMALL
        last.bias.zero_()
    return nn.Sequential(nn.Linear(width, width), nn.LeakyReLU(inplace=True), last)
