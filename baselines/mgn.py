"""MeshGraphNets: predict each node's next movement, and feed the prediction back.

Pfaff et al. 2020 as configured in the M3GN paper (section 5, appendix C): current and previous movement as
node features, one-step loss, and random-walk noise on the training inputs (Sanchez-Gonzalez et al. 2020)
with labels corrected so that the true next position stays the target.
"""

from collections.abc import Iterator

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from m3gn_bench.data import Body, Case, Context
from m3gn_bench.graph import build_graph, static_node_features
from m3gn_bench.message_passing import MessagePassingNetwork
from m3gn_bench.model import Model, ModelConfig
from m3gn_bench.tasks import Task


class MeshGraphNetConfig(ModelConfig):
    """Hyper-parameters of MeshGraphNets (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)
    noise: float = Field(default=1e-2, ge=0)  # standard deviation of the last movement's noise, scaled units


class MeshGraphNet(Model):
    """The model without material information."""

    Config = MeshGraphNetConfig
    preset_file = "mgn.toml"
    config: MeshGraphNetConfig

    def __init__(self, task: Task, config: MeshGraphNetConfig) -> None:
        super().__init__(task, config)
        # Type and static features as everywhere, but the collider moves through its velocity slots.
        features = task.node_types + len(task.static_features) + 2 * task.dimension
        self.network = MessagePassingNetwork(
            features + len(task.material) * self.uses_material,
            task.edge_features,
            task.dimension,
            width=config.width,
            steps=config.message_passing_steps,
        )

    def predict(self, context: Context) -> Tensor:
        """Positions after the anchor, one network call per frame, shape [horizon, nodes, dim]."""
        return torch.stack(list(self._rollout(context)))

    def _rollout(self, context: Context) -> Iterator[Tensor]:
        position = context.positions[-1]
        movement = position - context.positions[-2]
        # With two frames no earlier movement is known; scenes start at rest.
        previous = context.positions[-2] - context.positions[max(len(context.positions) - 3, 0)]
        for _ in range(context.horizon):
            step = self._step(context.body, position, movement, previous) * self.velocity_scale
            step = torch.where(context.body.fixed[:, None], 0.0, step)
            position, movement, previous = position + step, step, movement
            yield position

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """Squared error of one noisy step from a random frame of each trajectory, free nodes only."""
        body = case.body
        moments = torch.from_numpy(rng.integers(1, case.frames - 1, len(body.node_counts))).to(
            body.fixed.device
        )
        frame = moments[body.body_of_node()]
        nodes = torch.arange(body.nodes, device=frame.device)
        before, now, after = (case.positions[frame + shift, nodes] for shift in (-1, 0, 1))
        earliest = case.positions[(frame - 2).clamp(min=0), nodes]
        # A random walk: independent draws add up to the noise of two movements, and those to positions.
        drawn = rng.standard_normal((2, *now.shape), dtype=np.float32) * (self.config.noise / 2**0.5)
        walk = torch.from_numpy(drawn).to(now.device).cumsum(0).cumsum(0) * ~body.fixed[:, None]
        before, now = before + walk[0], now + walk[1]
        target = (after - now) / self.velocity_scale
        error = self._step(body, now, now - before, before - earliest) - target
        return error[~body.fixed].square().mean()

    def _step(self, body: Body, position: Tensor, movement: Tensor, previous: Tensor) -> Tensor:
        """Next movement of every node in units of the velocity scale, shape [nodes, dim]."""
        features = [
            static_node_features(body),
            movement / self.velocity_scale,
            previous / self.velocity_scale,
        ]
        if self.uses_material:
            features.append(body.material)
        graph = build_graph(body, position[None], torch.cat(features, dim=-1)[None])
        return self.network(graph)


class MeshGraphNetWithMaterial(MeshGraphNet):
    """The model that is told the material parameters, as a node feature."""

    uses_material = True
