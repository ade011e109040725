"""Predictions that need no learning; a model that does not beat them has learned nothing."""

from collections.abc import Sequence

import torch
from torch import Tensor

from m3gn_bench.data import Case, Context
from m3gn_bench.model import Model, ModelConfig, hold_fixed
from m3gn_bench.tasks import Task


class StandStill(Model):
    """Every node stays at the anchor."""

    def predict(self, context: Context) -> Tensor:
        """The anchor, repeated, shape [horizon, nodes, dim]."""
        return context.positions[-1].expand(context.horizon, -1, -1)


class ConstantVelocity(Model):
    """Every node goes on as it moved last."""

    def predict(self, context: Context) -> Tensor:
        """Linear extrapolation of the last two frames, shape [horizon, nodes, dim]."""
        steps = torch.arange(1, context.horizon + 1, device=context.positions.device)[:, None, None]
        return context.positions[-1] + steps * (context.positions[-1] - context.positions[-2])


class MeanTrajectory(Model):
    """Every node moves on from the anchor as it did on average over the training data.

    Only for tasks whose trajectories share one mesh.
    """

    mean: Tensor

    def __init__(self, task: Task, config: ModelConfig) -> None:
        super().__init__(task, config)
        self.register_buffer("mean", torch.zeros(task.frames, 0, task.dimension))

    def prepare(self, cases: Sequence[Case]) -> None:
        """Average the training trajectories' displacements from rest, in float64."""
        displacements = [(case.positions - case.body.rest_positions).double() for case in cases]
        self.mean = torch.stack(displacements).mean(0).float()

    def predict(self, context: Context) -> Tensor:
        """The anchor plus the mean's movement since the anchor, shape [horizon, nodes, dim]."""
        mean = self.mean.repeat(1, len(context.body.node_counts), 1)
        size = len(context.positions)
        return hold_fixed(context, context.positions[-1] + mean[size:] - mean[size - 1])

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: object) -> None:
        # The mean takes the size of the mesh that it was taken from.
        self.mean = torch.zeros_like(state_dict[f"{prefix}mean"])
        super()._load_from_state_dict(state_dict, prefix, *args)
