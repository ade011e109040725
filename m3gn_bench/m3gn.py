"""M3GN: infer the material from a few frames, then predict every node's whole trajectory at once.

Paper, section 4. A context network reads every pair of consecutive context frames (graph at t, movement to
t + 1) and gives each node a latent vector per pair; their element-wise maximum over time is the node's task
description z. A second network reads the anchor graph and z and gives each node the weights and goal of a
movement primitive, whose time scale tau is shared by all nodes of a trajectory.
"""

import math

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from m3gn_bench.data import Case, Context
from m3gn_bench.graph import build_graph, static_node_features
from m3gn_bench.message_passing import MessagePassingNetwork
from m3gn_bench.model import Model, ModelConfig, hold_fixed
from m3gn_bench.movement_primitives import TAU_RANGE, ProDMP
from m3gn_bench.tasks import Task


class M3GNConfig(ModelConfig):
    """Hyper-parameters of M3GN (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)
    latent_size: int = Field(default=64, ge=1)  # of the task description z
    basis_functions: int = Field(default=30, ge=2)
    alpha: float = Field(default=25.0, gt=0)
    alpha_x: float = Field(default=2.0, gt=0)
    # Where tau starts before training. It hardly moves from there; least-squares fits of Sheet Deformation
    # need weights ten times smaller, and are a hundred times closer, at 0.7 than at 1.65.
    initial_tau: float = Field(default=1.65, gt=TAU_RANGE[0], lt=TAU_RANGE[1])
    # Context pairs encoded per training step: the last one and some others at random; all of them when
    # predicting. The maximum over time does not mind missing pairs, and encoding all would take most of a
    # step's time.
    training_context_pairs: int | None = Field(default=None, ge=1)


class M3GN(Model):
    """The model; `predict` needs one call for the whole horizon."""

    Config = M3GNConfig
    preset_file = "m3gn.toml"
    config: M3GNConfig

    def __init__(self, task: Task, config: M3GNConfig) -> None:
        super().__init__(task, config)
        size = {"width": config.width, "steps": config.message_passing_steps}
        dimension, features = task.dimension, task.node_features
        self.context_network = MessagePassingNetwork(
            features + dimension, task.edge_features, config.latent_size, **size
        )
        self.simulator = MessagePassingNetwork(
            features + config.latent_size + task.m3gn_history * dimension,
            task.edge_features,
            dimension * (config.basis_functions + 1) + 1,
            **size,
        )
        lower, upper = TAU_RANGE
        place = (config.initial_tau - lower) / (upper - lower)
        with torch.no_grad():
            self.simulator.readout.bias[0] = math.log(place / (1 - place))
        self.primitives = ProDMP(config.basis_functions, config.alpha, config.alpha_x)

    def predict(self, context: Context) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        pairs = torch.arange(len(context.positions) - 1, device=context.positions.device)
        return hold_fixed(context, self._generate(context, self.encode(context, pairs)))

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """Mean squared error of free nodes after a random anchor, relative to the data's variance."""
        lower, upper = self.task.training_context
        context = case.context(int(rng.integers(lower, upper + 1)))
        last = len(context.positions) - 2
        others = rng.permutation(last)
        if self.config.training_context_pairs is not None:
            others = others[: self.config.training_context_pairs - 1]
        pairs = np.append(others, last)
        latent = self.encode(context, torch.from_numpy(pairs).to(case.positions.device))
        error = self._generate(context, latent) - case.future(len(context.positions))
        return (error[:, ~case.body.fixed] / self.displacement_scale).square().mean()

    def encode(self, context: Context, pairs: Tensor) -> Tensor:
        """The task description z [nodes, latent_size] from frames (t, t + 1) for every t in `pairs`."""
        positions = context.positions[pairs]
        movement = (context.positions[pairs + 1] - positions) / self.velocity_scale
        static = static_node_features(context.body).expand(len(pairs), -1, -1)
        graph = build_graph(context.body, positions, torch.cat([static, movement], dim=-1))
        latent = self.context_network(graph).unflatten(0, (len(pairs), context.body.nodes))
        return latent.amax(0)

    def _generate(self, context: Context, latent: Tensor) -> Tensor:
        """Trajectories of all nodes from the anchor and the task description."""
        anchor = context.positions[-1]
        velocity = anchor - context.positions[-2]
        features = [static_node_features(context.body), latent]
        if self.task.m3gn_history:
            features.append(velocity / self.velocity_scale)
        graph = build_graph(context.body, anchor[None], torch.cat(features, dim=-1)[None])
        outputs = self.simulator(graph)
        weights = outputs[:, 1:].unflatten(1, (self.task.dimension, -1)) * self.displacement_scale

        # Time runs in whole trajectories of `frames - 1` transitions, whatever the anchor.
        transitions = context.frames - 1
        steps = torch.arange(1, context.horizon + 1, device=anchor.device)
        times = (steps / transitions).to(anchor.dtype)
        lower, upper = TAU_RANGE
        counts = context.body.node_counts
        trajectories = []
        for logit, w, y, v in zip(
            outputs[:, 0].split(counts),
            weights.split(counts),
            anchor.split(counts),
            velocity.split(counts),
            strict=True,
        ):
            tau = lower + (upper - lower) * torch.sigmoid(logit.mean())
            trajectories.append(self.primitives(times, tau, w, y, v * transitions))
        return torch.cat(trajectories, dim=1)
