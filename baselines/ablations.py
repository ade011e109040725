"""M3GN with one part taken out or exchanged (paper, section 5, ablations)."""

import numpy as np
from torch import Tensor

from m3gn_bench.data import Context
from m3gn_bench.m3gn import PrimitivesConfig, TrajectorySimulator
from m3gn_bench.model import TrajectoryModel
from m3gn_bench.tasks import Task


class MeshGraphNetWithPrimitives(TrajectoryModel):
    """Movement primitives from the anchor alone: M3GN without context, MGN (MP) in the paper."""

    Config = PrimitivesConfig
    preset_file = "mgn_mp.toml"
    config: PrimitivesConfig

    def __init__(self, task: Task, config: PrimitivesConfig) -> None:
        super().__init__(task, config)
        self.simulator = TrajectorySimulator(task, config, latent_size=0)

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        nothing = context.positions.new_zeros(context.body.nodes + context.body.collider_nodes, 0)
        return self.simulator(context, nothing, self.velocity_scale, self.displacement_scale)
