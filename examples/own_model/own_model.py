"""Every node goes on as it moved last, and slows down at a rate that a small network reads off its speed."""

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from m3gn_bench.data import Context
from m3gn_bench.model import ModelConfig, TrajectoryModel, hold_fixed
from m3gn_bench.tasks import Task


class DampedVelocityConfig(ModelConfig):
    width: int = Field(default=16, ge=1)


class DampedVelocity(TrajectoryModel):
    Config = DampedVelocityConfig
    config: DampedVelocityConfig

    def __init__(self, task: Task, config: DampedVelocityConfig) -> None:
        super().__init__(task, config)
        self.rate = nn.Sequential(nn.Linear(1, config.width), nn.Tanh(), nn.Linear(config.width, 1))

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """The sum of v e^(-r) + v e^(-2r) + ..., per node; shape [horizon, nodes, dim]."""
        velocity = context.positions[-1] - context.positions[-2]
        speed = velocity.norm(dim=-1, keepdim=True) / self.velocity_scale
        rate = nn.functional.softplus(self.rate(speed))
        steps = torch.arange(1, context.horizon + 1, device=velocity.device)[:, None, None]
        return hold_fixed(context, context.positions[-1] + velocity * torch.exp(-rate * steps).cumsum(0))
