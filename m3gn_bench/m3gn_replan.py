"""M3GN with re-planning: the horizon in segments, each a movement primitive of its own.

The paper names the limit (section 5): smooth primitives over the whole horizon blur fast motion, and plan
without looking again. Here the task description z is inferred once, from the context; then the simulator
predicts `segment` frames, looks at the graph that it predicted (with new contacts), and goes on from there.
Every segment starts at the last predicted position with the velocity of the last predicted frames, which a
primitive keeps exactly, as M3GN does at the anchor. One segment as long as the horizon is M3GN, but
for the units of time and of displacements.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from m3gn_bench.data import Case, Context
from m3gn_bench.m3gn import M3GN, M3GNConfig


class M3GNReplanConfig(M3GNConfig):
    """Hyper-parameters of M3GN with re-planning."""

    segment: int = Field(default=10, ge=1)  # transitions per segment
    # Segments trained in one step, one after the other from a true state; the gradient passes through all of
    # them, so the model learns to go on from its own predictions. None: all, from the anchor to the end.
    training_segments: int | None = Field(default=None, ge=1)


class M3GNReplan(M3GN):
    """The model; `predict` needs one call of the simulator per segment."""

    Config = M3GNReplanConfig
    preset_file = "m3gn_replan.toml"
    config: M3GNReplanConfig

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        return self._segments(context, self.encoder(context, self.velocity_scale, rng), context.horizon)

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """As M3GN's, over some segments of the horizon, relative to the data's variance within a segment."""
        lower, upper = self.task.training_context
        size = int(rng.integers(lower, upper + 1))
        latent = self.encoder(case.context(size), self.velocity_scale, rng)
        segment, horizon = self.config.segment, case.frames - size
        total = -(-horizon // segment)
        trained = (
            total if self.config.training_segments is None else min(self.config.training_segments, total)
        )
        start = size + segment * int(rng.integers(total - trained + 1))
        frames = min(trained * segment, case.frames - start)
        error = self._segments(case.context(start), latent, frames) - case.future(start)[:frames]
        return self.mean_square(error, case.body)

    def prepare(self, cases: Sequence[Case]) -> None:
        """As every model, but displacements are those within a segment."""
        super().prepare(cases)
        length = min(self.config.segment, self.task.frames - 1)
        moved = [
            (c.positions[length:] - c.positions[:-length])[:, ~c.body.fixed].numpy().ravel() for c in cases
        ]
        self.displacement_scale.fill_(float(np.concatenate(moved).std(dtype=np.float64)))

    def _segments(self, context: Context, latent: Tensor, frames: int) -> Tensor:
        """The first frames after the anchor, shape [frames, nodes, dim]."""
        positions, start = context.positions, context.size
        while len(positions) < start + frames:
            seen = replace(context, positions=positions, horizon=context.frames - len(positions))
            predicted = self.simulator(
                seen, latent, self.velocity_scale, self.displacement_scale, self.config.segment
            )
            positions = torch.cat([positions, predicted])
        return positions[start : start + frames]
