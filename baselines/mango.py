"""MaNGO: message passing in space and convolutions over time, on the whole trajectory at once.

Dahlinger et al. 2025 as the M3GN paper adapts it (section 4): its encoder of other trajectories is removed.
Instead the input is a whole trajectory that consists of the context frames and then of the anchor, repeated to
the end; what comes out for the context's frames is discarded. Each of the blocks is

    h <- h + act(conv(h)),                                        over time, 7 frames wide, per node
    e <- e + LN(act(W_e [h_sender, h_receiver, e])),
    h <- h + LN(act(W_h [h, mean of incoming e])).

Decisions where the paper and its parameter counts leave a choice:

- Nodes carry their last movement at every time, and edges how much their vector differs from the anchor's.
  Both do not change under translation, and together they are the input trajectory. With the anchor its last
  movement is repeated, too, since few blocks reach only few frames: 3 per block and direction.
- The first frame has no movement before it; it gets zero, as the convolution's padding does.
- The graph is the anchor's at all times, as in M3GN: where the body will touch is not known beforehand.
- Collider nodes carry their true path at all times, also in the vectors of contact edges, and where they will
  end seen from where they are.
- The convolution has a residual connection, without which fifteen in a row are hard to train.
- Messages are averaged, as everywhere in the paper.
- The output is the displacement from the anchor in units of its standard deviation in the training data.
"""

from collections.abc import Sequence

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from m3gn_bench.baselines.spacetime import TIME_FEATURES, SpaceTimeLinear, edges_at_a_time, time_embedding
from m3gn_bench.data import Context
from m3gn_bench.graph import Graph, build_graph, shared_node_features
from m3gn_bench.model import ModelConfig, TrajectoryModel, hold_fixed
from m3gn_bench.tasks import Task

KERNEL = 7  # frames


class MaNGOConfig(ModelConfig):
    """Hyper-parameters of MaNGO (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)


class TemporalConvolution(nn.Module):
    """A convolution over time, the same for every item, padded with zeros to keep the length; then LeakyReLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(width, width, KERNEL, padding=KERNEL // 2)

    def forward(self, features: Tensor) -> Tensor:
        """Features [items, times, width] to the same shape."""
        # Seen as pictures of one row whose channels lie together, they need no reordering on a CPU.
        pictures = features.transpose(1, 2)[:, :, None]
        weight = self.conv.weight[:, :, None]
        out = functional.conv2d(pictures, weight, self.conv.bias, padding=(0, KERNEL // 2))
        return functional.leaky_relu_(out)[:, :, 0].transpose(1, 2)


class SpaceTimeBlock(nn.Module):
    """One convolution over time and one exchange of messages; all features have the same width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.convolution = TemporalConvolution(width)
        self.edge_linear = nn.Linear(width, width)
        self.sender_linear = nn.Linear(width, width, bias=False)
        self.receiver_linear = nn.Linear(width, width, bias=False)
        self.edge_norm = nn.LayerNorm(width)
        self.node_linear = nn.Linear(width, width)
        self.message_linear = nn.Linear(width, width, bias=False)
        self.node_norm = nn.LayerNorm(width)

    def forward(self, nodes: Tensor, edges: Sequence[Tensor], graph: Graph) -> tuple[Tensor, list[Tensor]]:
        """Update nodes [nodes, times, width], and edges in parts of shape [edges, times, width]."""
        # In place where autograd allows it: on a CPU this is bound by memory, not by arithmetic. It does so at
        # a cost for views, hence the flattened inputs of linear layers.
        nodes = nodes + self.convolution(nodes)
        sender, receiver = self.sender_linear(nodes), self.receiver_linear(nodes)
        size = len(edges[0])
        updated = []
        summed = torch.zeros_like(nodes)
        for part, senders, receivers in zip(
            edges, graph.senders.split(size), graph.receivers.split(size), strict=True
        ):
            message = self.edge_linear(part.flatten(0, 1))
            message += sender.index_select(0, senders).flatten(0, 1)
            message += receiver.index_select(0, receivers).flatten(0, 1)
            change = self.edge_norm(functional.leaky_relu_(message))
            change += part.flatten(0, 1)
            updated.append(change.view_as(part))
            # Under autocast on CUDA, edges are float32 after the norm, and nodes need not be.
            summed.index_add_(0, receivers, updated[-1].to(summed.dtype))
        update = self.node_linear(nodes.flatten(0, 1))
        update += self.message_linear((summed * graph.inverse_degree[:, None]).flatten(0, 1))
        update = self.node_norm(functional.leaky_relu_(update))
        update += nodes.flatten(0, 1)
        return update.view_as(nodes), updated


class MaNGO(TrajectoryModel):
    """The model; `predict` needs one call for the whole trajectory."""

    Config = MaNGOConfig
    preset_file = "mango.toml"
    config: MaNGOConfig

    def __init__(self, task: Task, config: MaNGOConfig) -> None:
        super().__init__(task, config)
        width, dimension = config.width, task.dimension
        inputs = task.node_features + task.collider_features + dimension + TIME_FEATURES
        self.embed_nodes = nn.Linear(inputs, width)
        self.embed_edges = SpaceTimeLinear(task.edge_features, dimension, TIME_FEATURES, width)
        self.blocks = nn.ModuleList(SpaceTimeBlock(width) for _ in range(config.message_passing_steps))
        self.hidden = nn.Linear(width, width)
        self.readout = nn.Linear(width, dimension)

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        body, path, size = context.body, context.collider_path, context.size
        anchor = context.positions[-1]
        graph = build_graph(self.task, body, anchor[None], path[size - 1][None])
        frames = torch.arange(context.frames, device=anchor.device)
        times = time_embedding(frames, size - 1).to(anchor.dtype)
        nodes = self.embed_nodes(self._node_inputs(context, times))
        some = edges_at_a_time(graph, context.frames, self.config.width)
        parts = graph.edge_features.split(some), self._edge_inputs(context, graph).split(some)
        edges = [self.embed_edges(static, moving, times) for static, moving in zip(*parts, strict=True)]
        for block in self.blocks:
            nodes, edges = block(nodes, edges, graph)
        outputs = self.readout(functional.relu(self.hidden(nodes[: body.nodes, size:])))
        return hold_fixed(context, anchor + outputs.transpose(0, 1) * self.displacement_scale)

    def _node_inputs(self, context: Context, times: Tensor) -> Tensor:
        """Features of every node at every time, shape [nodes + collider_nodes, frames, inputs]."""
        body, path, size = context.body, context.collider_path, context.size
        trajectory = _input_trajectory(context)
        movement = trajectory.diff(dim=0, prepend=trajectory[:1])
        movement[size:, : body.nodes] = movement[size - 1, : body.nodes]
        features = [shared_node_features(self.task, body, trajectory[:, : body.nodes])]
        if self.task.has_collider:
            ahead = torch.zeros_like(trajectory)
            ahead[:, body.nodes :] = path[-1] - path
            features.append(ahead)
        features += [movement / self.velocity_scale, times[:, None].expand(-1, trajectory.shape[1], -1)]
        return torch.cat(features, dim=-1).transpose(0, 1).contiguous()

    def _edge_inputs(self, context: Context, graph: Graph) -> Tensor:
        """Each edge's vector at every time minus the one at the anchor, shape [edges, frames, dim]."""
        trajectory = _input_trajectory(context)
        moved = ((trajectory - trajectory[context.size - 1]) / self.displacement_scale).transpose(0, 1)
        return moved[graph.senders] - moved[graph.receivers]


def _input_trajectory(context: Context) -> Tensor:
    """The context and the anchor repeated, with the collider's path, [frames, nodes + collider_nodes, dim]."""
    repeated = context.positions[-1].expand(context.horizon, -1, -1)
    return torch.cat([torch.cat([context.positions, repeated]), context.collider_path], dim=1)
