"""M3GN: infer the material from a few frames, then predict every node's whole trajectory at once.

Paper, section 3. A context network reads every pair of consecutive context frames (graph at t, movement to
t + 1) and gives each node a latent vector per pair; their element-wise maximum over time is the node's task
description z. A second network reads the anchor graph and z and gives each node the weights and goal of a
movement primitive, whose time scale tau is shared by all nodes of a trajectory.
"""

import math
import zlib
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from m3gn_bench.data import Body, Context
from m3gn_bench.graph import build_graph, on_collider, on_mesh
from m3gn_bench.message_passing import MessagePassingNetwork
from m3gn_bench.model import ModelConfig, TrajectoryModel, hold_fixed
from m3gn_bench.movement_primitives import TAU_RANGE, ProDMP
from m3gn_bench.tasks import Task


class ContextConfig(ModelConfig):
    """Hyper-parameters of the context network (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)
    # Of the context network, where it needs fewer than the simulator; None: as many.
    context_message_passing_steps: int | None = Field(default=None, ge=1)
    latent_size: int = Field(default=64, ge=1)  # of the task description z
    # Context pairs encoded per training step: the last one and others at random, at most so many together; all of
    # them when predicting. The maximum over time does not mind missing pairs, and encoding all would take most of
    # a step's time.
    max_training_context_pairs: int | None = Field(default=None, ge=1)
    # Standard deviation of noise on the frames that the context network reads, scaled units, in training and
    # prediction (paper, appendix: robustness to noisy observations). The anchor itself stays exact.
    context_noise: float = Field(default=0.0, ge=0)


class PrimitivesConfig(ModelConfig):
    """Hyper-parameters of the trajectory simulator (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)
    basis_functions: int = Field(default=30, ge=2)
    alpha: float = Field(default=25.0, gt=0)
    alpha_x: float = Field(default=2.0, gt=0)
    # Where tau starts before training. It hardly moves from there; least-squares fits of Sheet Deformation
    # need weights ten times smaller, and are a hundred times closer, at 0.7 than at 1.65.
    initial_tau: float = Field(default=1.65, gt=TAU_RANGE[0], lt=TAU_RANGE[1])
    # The last movement as a node feature; None: as the published parameter counts have it for the task.
    history: bool | None = None


class M3GNConfig(ContextConfig, PrimitivesConfig):
    """Hyper-parameters of M3GN (defaults: the paper's)."""


class ContextEncoder(nn.Module):
    """Gives each node a task description z from the frames before the anchor (paper, equation 4)."""

    outputs_per_latent: ClassVar[int] = 1

    def __init__(self, task: Task, config: ContextConfig) -> None:
        super().__init__()
        self.task = task
        self.config = config
        self.network = MessagePassingNetwork(
            task.node_features + task.collider_features + task.dimension,
            task.edge_features,
            self.outputs_per_latent * config.latent_size,
            width=config.width,
            steps=config.context_message_passing_steps or config.message_passing_steps,
        )

    def forward(self, context: Context, velocity_scale: Tensor, rng: np.random.Generator | None) -> Tensor:
        """The task description, shape [nodes + collider_nodes, latent_size].

        Args:
            context: the frames.
            velocity_scale: unit of the movements.
            rng: chooses context pairs in training; None when predicting, which reads all pairs.
        """
        pairs = self.choose_pairs(context.size, rng).to(context.positions.device)
        return self.aggregate(self.encode(context, pairs, velocity_scale), pairs, context.body, rng)

    def choose_pairs(self, size: int, rng: np.random.Generator | None) -> Tensor:
        """The frames t whose pair (t, t + 1) is read, counted from 0."""
        last = size - 2
        if rng is None or self.config.max_training_context_pairs is None:
            return torch.arange(last + 1)
        others = rng.permutation(last)[: self.pairs_to_read(self.config.max_training_context_pairs, rng) - 1]
        return torch.from_numpy(np.append(np.sort(others), last))

    def pairs_to_read(self, most: int, rng: np.random.Generator) -> int:
        """How many, drawn anew for every step: descriptions by few pairs and by more are to be of one kind."""
        return int(rng.integers(1, most + 1))

    def encode(self, context: Context, pairs: Tensor, velocity_scale: Tensor) -> Tensor:
        """What the network says of every pair, shape [pairs, nodes + collider_nodes, outputs]."""
        body, path = context.body, context.collider_path
        frames = self._observed(context)
        positions, collider = frames[pairs], path[pairs]
        movement = on_mesh(body, (frames[pairs + 1] - positions) / velocity_scale)
        features = [movement]
        if self.task.has_collider:
            features.insert(0, on_collider(body, path[-1] - collider))
        graph = build_graph(self.task, body, positions, collider, torch.cat(features, dim=-1))
        return self.network(graph).unflatten(0, (len(pairs), -1))

    def aggregate(
        self, latents: Tensor, pairs: Tensor, body: Body, rng: np.random.Generator | None
    ) -> Tensor:
        """One description per node from those of all pairs: the element-wise maximum over time."""
        return latents.amax(0)

    def _observed(self, context: Context) -> Tensor:
        """The context's frames, noisy if so configured, the same whenever a trajectory is seen again."""
        if not self.config.context_noise:
            return context.positions
        parts = []
        frames_of_bodies = context.positions.split(context.body.node_counts, dim=1)
        for key, frames in zip(context.keys, frames_of_bodies, strict=True):
            seed = zlib.crc32(key.encode())
            noise = np.random.default_rng(seed).standard_normal(frames.shape, dtype=np.float32)
            parts.append(frames + self.config.context_noise * torch.from_numpy(noise).to(frames.device))
        observed = torch.cat(parts, dim=1)
        return torch.where(context.body.fixed[:, None], context.positions, observed)


class TrajectorySimulator(nn.Module):
    """Predicts all nodes' trajectories as movement primitives from one graph (paper, equation 5)."""

    def __init__(self, task: Task, config: PrimitivesConfig, latent_size: int) -> None:
        super().__init__()
        self.task = task
        self.history = task.m3gn_history if config.history is None else config.history
        self.network = MessagePassingNetwork(
            task.node_features + task.collider_features + latent_size + self.history * task.dimension,
            task.edge_features,
            task.dimension * (config.basis_functions + 1) + 1,
            width=config.width,
            steps=config.message_passing_steps,
        )
        lower, upper = TAU_RANGE
        place = (config.initial_tau - lower) / (upper - lower)
        with torch.no_grad():
            self.network.readout.bias[0] = math.log(place / (1 - place))
        self.primitives = ProDMP(config.basis_functions, config.alpha, config.alpha_x)

    def forward(
        self,
        context: Context,
        latent: Tensor,
        velocity_scale: Tensor,
        displacement_scale: Tensor,
        segment: int | None = None,
        from_rest: bool = False,
    ) -> Tensor:
        """Positions of mesh nodes after the anchor, shape [min(segment, horizon), nodes, dim].

        Args:
            context: its last two frames are the anchor and the one before.
            latent: task description, shape [nodes + collider_nodes, latent_size].
            velocity_scale, displacement_scale: units of movements and of the predicted weights.
            segment: transitions to predict, which are then the primitives' unit of time; None: all that are
                left, in units of the whole trajectory, whatever the anchor.
            from_rest: start the primitives with no velocity, not with the anchor's.
        """
        body, path, now = context.body, context.collider_path, context.size - 1
        unit = context.frames - 1 if segment is None else segment
        steps = min(unit, context.horizon)
        anchor = context.positions[-1]
        velocity = anchor - context.positions[-2]
        features = [latent[None]]
        if self.task.has_collider:
            features.insert(0, on_collider(body, path[now + steps][None] - path[now]))
        if self.history:
            collider_velocity = path[now] - path[now - 1]
            features.append(torch.cat([velocity, collider_velocity])[None] / velocity_scale)
        graph = build_graph(self.task, body, anchor[None], path[now][None], torch.cat(features, dim=-1))
        outputs = self.network(graph)[: body.nodes]
        weights = outputs[:, 1:].unflatten(1, (self.task.dimension, -1)) * displacement_scale

        times = (torch.arange(1, steps + 1, device=anchor.device) / unit).to(anchor.dtype)
        lower, upper = TAU_RANGE
        logits = torch.stack([of_body.mean() for of_body in outputs[:, 0].split(body.node_counts)])
        responses = self.primitives.responses(times, lower + (upper - lower) * torch.sigmoid(logits))
        initial = torch.zeros_like(velocity) if from_rest else velocity * unit
        parts = (values.split(body.node_counts) for values in (weights, initial))
        movements = [self.primitives.movement(*of_body) for of_body in zip(responses, *parts, strict=True)]
        return hold_fixed(context, anchor + torch.cat(movements, dim=1))


class M3GN(TrajectoryModel):
    """The model; `predict` needs one call of the simulator for the whole horizon."""

    Config = M3GNConfig
    preset_file = "m3gn.toml"
    config: M3GNConfig
    encoder_class: ClassVar[type[ContextEncoder]] = ContextEncoder
    from_rest: ClassVar[bool] = False

    def __init__(self, task: Task, config: M3GNConfig) -> None:
        super().__init__(task, config)
        self.encoder = self.encoder_class(task, config)
        self.simulator = TrajectorySimulator(task, config, config.latent_size)

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        latent = self.encoder(context, self.velocity_scale, rng)
        return self.simulator(
            context, latent, self.velocity_scale, self.displacement_scale, from_rest=self.from_rest
        )
