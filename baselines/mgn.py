"""MeshGraphNets: predict each node's next movement, and feed the prediction back.

Pfaff et al. 2020 as configured in the M3GN paper (section 4, appendix C): current and previous movement as
node features, one-step loss, and random-walk noise on the training inputs (Sanchez-Gonzalez et al. 2020)
with labels corrected so that the true next position stays the target. The collider's path is known: its nodes
carry the movement that comes and the one before.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from m3gn_bench.data import Body, Case, Context
from m3gn_bench.errors import ConfigError
from m3gn_bench.graph import build_graph
from m3gn_bench.message_passing import MessagePassingNetwork
from m3gn_bench.model import Model, ModelConfig
from m3gn_bench.tasks import Task


class StepConfig(ModelConfig):
    """Hyper-parameters of the step-wise simulator (defaults: the paper's)."""

    width: int = Field(default=128, ge=1)
    message_passing_steps: int = Field(default=15, ge=1)
    noise: float = Field(default=1e-2, ge=0)  # standard deviation of the last movement's noise, scaled units
    history: int = Field(default=2, ge=0, le=2)  # movements among the node features: the last, the one before


@dataclass(frozen=True, eq=False)
class State:
    """What a step starts from; mesh [moments, nodes, dim], collider [moments, collider_nodes, dim].

    Attributes:
        position: of mesh nodes now.
        movements: of mesh nodes, the last one and the one before.
        collider: positions of collider nodes now.
        collider_movements: of collider nodes, the coming one and the last one.
    """

    position: Tensor
    movements: tuple[Tensor, Tensor]
    collider: Tensor
    collider_movements: tuple[Tensor, Tensor]


class StepSimulator(nn.Module):
    """Predicts the next movement of every node from the present graph."""

    def __init__(self, task: Task, config: StepConfig, extra_features: int = 0) -> None:
        super().__init__()
        self.task = task
        self.config = config
        self.network = MessagePassingNetwork(
            task.node_features + config.history * task.dimension + extra_features,
            task.edge_features,
            task.dimension,
            width=config.width,
            steps=config.message_passing_steps,
        )

    def forward(
        self, body: Body, state: State, velocity_scale: Tensor, extra: Tensor | None = None
    ) -> Tensor:
        """Next movements in units of `velocity_scale`, shape [moments, nodes, dim].

        Args:
            body: the bodies.
            state: where everything is, at one or several moments.
            velocity_scale: unit of movements.
            extra: further features of each node, shape [nodes + collider_nodes, extra_features].
        """
        moments = len(state.position)
        features = [
            torch.cat([mesh, collider], dim=1) / velocity_scale
            for mesh, collider in zip(state.movements, state.collider_movements, strict=True)
        ][: self.config.history]
        if extra is not None:
            features.append(extra.expand(moments, -1, -1))
        added = torch.cat(features, dim=-1) if features else None
        graph = build_graph(self.task, body, state.position, state.collider, added)
        return self.network(graph).unflatten(0, (moments, -1))[:, : body.nodes]

    def rollout(self, context: Context, velocity_scale: Tensor, extra: Tensor | None = None) -> Tensor:
        """Positions after the anchor, one step after the other, shape [horizon, nodes, dim]."""
        frames, path, body = context.positions, context.collider_path, context.body
        position = frames[-1]
        # With two frames no earlier movement is known: zero, as for such moments in training.
        movements = position - frames[-2], frames[-2] - frames[max(context.size - 3, 0)]
        predicted = []
        for now in range(context.size - 1, context.frames - 1):
            state = State(
                position[None],
                (movements[0][None], movements[1][None]),
                path[now][None],
                (path[now + 1 : now + 2] - path[now], path[now : now + 1] - path[now - 1]),
            )
            step = self(body, state, velocity_scale, extra)[0] * velocity_scale
            step = torch.where(body.fixed[:, None], 0.0, step)
            position, movements = position + step, (step, movements[0])
            predicted.append(position)
        return torch.stack(predicted)

    def loss(
        self,
        case: Case,
        moments: Tensor,
        velocity_scale: Tensor,
        rng: np.random.Generator,
        extra: Tensor | None = None,
    ) -> Tensor:
        """Squared error of one noisy step from each of some moments, free nodes only.

        Args:
            case: the trajectories.
            moments: frame of each body from which the step starts, at least 1, shape [moments, bodies].
            velocity_scale: unit of movements.
            rng: draws the noise.
            extra: further features of each node, shape [nodes + collider_nodes, extra_features].
        """
        body = case.body
        frame, collider_frame = moments[:, body.body_of_node], moments[:, body.body_of_collider_node]
        nodes = torch.arange(body.nodes, device=frame.device)
        collider_nodes = torch.arange(body.collider_nodes, device=frame.device)
        before, now, after = (case.positions[frame + shift, nodes] for shift in (-1, 0, 1))
        earliest = case.positions[(frame - 2).clamp(min=0), nodes]
        path = [case.collider_path[collider_frame + shift, collider_nodes] for shift in (-1, 0, 1)]
        # A random walk: independent draws add up to the noise of two movements, and those to positions.
        drawn = body.drawn_per_node(
            lambda count: rng.standard_normal((2, len(moments), count, now.shape[-1]), dtype=np.float32)
        ) * (self.config.noise / 2**0.5)
        walk = torch.from_numpy(drawn).to(now.device).cumsum(0).cumsum(0) * ~body.fixed[:, None]
        before, now = before + walk[0], now + walk[1]
        state = State(now, (now - before, before - earliest), path[1], (path[2] - path[1], path[1] - path[0]))
        error = self(body, state, velocity_scale, extra) - (after - now) / velocity_scale
        return error[:, ~body.fixed].square().mean()


class MeshGraphNet(Model):
    """The model without material information."""

    Config = StepConfig
    preset_file = "mgn.toml"
    uses_material: ClassVar[bool] = False
    config: StepConfig

    def __init__(self, task: Task, config: StepConfig) -> None:
        super().__init__(task, config)
        if self.uses_material and not task.material:
            raise ConfigError(
                "this model is told the material, which the data do not tell; take another model"
            )
        self.simulator = StepSimulator(task, config, len(task.material) * self.uses_material)

    def predict(self, context: Context) -> Tensor:
        """Positions after the anchor, one network call per frame, shape [horizon, nodes, dim]."""
        return self.simulator.rollout(context, self.velocity_scale, self._material(context.body))

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """Squared error of one noisy step from a random frame of each trajectory, free nodes only."""
        drawn = case.body.drawn_per_body(lambda count: rng.integers(1, case.frames - 1, (1, count)))
        moments = torch.from_numpy(drawn).to(case.positions.device)
        return self.simulator.loss(case, moments, self.velocity_scale, rng, self._material(case.body))

    def _material(self, body: Body) -> Tensor | None:
        """The material of each node's body, collider nodes included."""
        if not self.uses_material:
            return None
        return torch.cat([body.material[body.body_of_node], body.material[body.body_of_collider_node]])


class MeshGraphNetWithMaterial(MeshGraphNet):
    """The model that is told the material parameters, as node features."""

    uses_material = True
