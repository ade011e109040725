"""M3GN with one part taken out or exchanged (paper, section 4, ablations).

- No context: `MeshGraphNetWithPrimitives`.
- No trajectories but steps: `M3GNStep`.
- Neural processes, whose task description is a distribution: `NeuralProcessWithPrimitives`,
  `NeuralProcessStep`.
- Another aggregation of the context: `M3GNNodeMaximum`, `M3GNTransformer`, `M3GNNodeMaximumTransformer`.
- Past movements among the simulator's inputs, or not: `M3GNWithHistory`, `M3GNWithoutHistory`,
  `MeshGraphNetWithoutHistory`.
- Noisy observations: `M3GNNoise5e4`, `M3GNNoise1e3`, `M3GNNoise1e2`.

And one of ours, which has one more part: `M3GNOnScaledVelocity`.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from m3gn_bench.baselines.mgn import MeshGraphNet, StepConfig, StepSimulator
from m3gn_bench.baselines.spacetime import temporal_encoding
from m3gn_bench.baselines.trivial import ScaledVelocity
from m3gn_bench.data import Body, Case, Context
from m3gn_bench.m3gn import (
    M3GN,
    ContextConfig,
    ContextEncoder,
    M3GNConfig,
    PrimitivesConfig,
    TrajectorySimulator,
)
from m3gn_bench.model import Model, ModelConfig, TrajectoryModel
from m3gn_bench.tasks import Task

TRANSFORMER_SIZE, TRANSFORMER_BLOCKS, TRANSFORMER_HEADS = 32, 4, 4  # paper, section 4
MINIMUM_VARIANCE = 1e-4  # of an observation of the task description, whose prior has variance 1


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


def maximum_over_nodes(latents: Tensor, body: Body) -> Tensor:
    """Element-wise maximum over all nodes of each body and its collider.

    Args:
        latents: of each node, mesh nodes first, shape [pairs, nodes + collider_nodes, latent_size].
        body: the bodies.

    Returns:
        Shape [pairs, bodies, latent_size].
    """
    mesh, collider = latents.split([body.nodes, body.collider_nodes], dim=1)
    return torch.stack(
        [
            torch.cat(parts, dim=1).amax(1)
            for parts in zip(
                mesh.split(body.node_counts, dim=1), collider.split(body.collider_counts, dim=1), strict=True
            )
        ],
        dim=1,
    )


def on_nodes(values: Tensor, body: Body) -> Tensor:
    """Values of each body [bodies, n] given to its nodes, then to its collider's."""
    return torch.cat([values[body.body_of_node], values[body.body_of_collider_node]])


class NodeMaximumEncoder(ContextEncoder):
    """One task description per trajectory: the maximum over its nodes, then over time."""

    def aggregate(
        self, latents: Tensor, pairs: Tensor, body: Body, rng: np.random.Generator | None
    ) -> Tensor:
        """The same description for all nodes of a trajectory, shape [nodes + collider_nodes, latent_size]."""
        return on_nodes(maximum_over_nodes(latents, body).amax(0), body)


class SequenceTransformer(nn.Module):
    """Reads sequences of latent vectors in their temporal order.

    A learned vector is put in front of each sequence, and what the last block makes of it is the answer. So
    every pair counts as attention has it, whatever their number, and no pair is preferred by construction.
    Linear maps lead to the transformer's own size and back. Blocks normalise before attention, which trains
    without warm-up tricks; their hidden layer is the usual four times as wide. There is no dropout: the data
    are free of noise, and prediction must repeat.

    Args:
        latent_size: length of the vectors, in and out.
    """

    def __init__(self, latent_size: int) -> None:
        super().__init__()
        self.shrink = nn.Linear(latent_size, TRANSFORMER_SIZE)
        self.question = nn.Parameter(torch.randn(TRANSFORMER_SIZE) / TRANSFORMER_SIZE**0.5)
        blocks = [
            nn.TransformerEncoderLayer(
                TRANSFORMER_SIZE,
                TRANSFORMER_HEADS,
                4 * TRANSFORMER_SIZE,
                dropout=0.0,
                batch_first=True,
                norm_first=True,
            )
            for _ in range(TRANSFORMER_BLOCKS)
        ]
        self.blocks = nn.Sequential(*blocks, nn.LayerNorm(TRANSFORMER_SIZE))
        self.expand = nn.Linear(TRANSFORMER_SIZE, latent_size)

    def forward(self, sequences: Tensor, times: Tensor) -> Tensor:
        """One vector per sequence, shape [sequences, latent_size].

        Args:
            sequences: shape [times, sequences, latent_size].
            times: frame index of each element, shape [times].
        """
        elements = self.shrink(sequences) + temporal_encoding(times, TRANSFORMER_SIZE)[:, None]
        question = self.question.expand(1, elements.shape[1], -1)
        return self.expand(self.blocks(torch.cat([question, elements]).transpose(0, 1))[:, 0])


class TransformerEncoder(ContextEncoder):
    """A transformer per node reads the sequence of the node's latent vectors."""

    def __init__(self, task: Task, config: ContextConfig) -> None:
        super().__init__(task, config)
        self.transformer = SequenceTransformer(config.latent_size)

    def aggregate(
        self, latents: Tensor, pairs: Tensor, body: Body, rng: np.random.Generator | None
    ) -> Tensor:
        """One description per node, shape [nodes + collider_nodes, latent_size]; nodes are the batch."""
        return self.transformer(latents, pairs)


class NodeMaximumTransformerEncoder(TransformerEncoder):
    """A transformer reads one sequence per trajectory, of the maximum over its nodes."""

    def aggregate(
        self, latents: Tensor, pairs: Tensor, body: Body, rng: np.random.Generator | None
    ) -> Tensor:
        """The same description for all nodes of a trajectory, shape [nodes + collider_nodes, latent_size]."""
        return on_nodes(self.transformer(maximum_over_nodes(latents, body), pairs), body)


def bayesian_aggregation(observations: Tensor, variances: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Posterior of z with prior N(0, 1) after independent Gaussian observations of it.

    The product of Gaussians adds their precisions and precision-weighted means (Volpp et al. 2021, equation
    8, here for mean 0 and variance 1 of the prior):

        variance = 1 / (1 + sum_k w_k / variance_k),    mean = variance sum_k w_k r_k / variance_k.

    Args:
        observations, variances: r_k and its variance, shape [observations, ...].
        weights: how many observations of that kind each one stands for, shape [observations].

    Returns:
        Mean and variance, shape [...] each.
    """
    precisions = weights.reshape(-1, *[1] * (observations.dim() - 1)) / variances
    variance = 1 / (1 + precisions.sum(0))
    return variance * (precisions * observations).sum(0), variance


class BayesianEncoder(ContextEncoder):
    """The task description is a diagonal Gaussian, sampled in training; prediction takes its mean.

    Each pair gives a node an observation of z and its variance. Training may read only the last pair and a
    random choice of the others, and a posterior of so few observations would be wider than the one that
    prediction gets. So each of the chosen others counts as often as there are others per chosen one, which
    estimates the sums over all pairs without bias: the posterior is as narrow in training as in prediction,
    for the cost of the pairs that are read.
    """

    outputs_per_latent = 2

    def pairs_to_read(self, most: int, rng: np.random.Generator) -> int:
        """Always as many: the last pair alone says nothing of a sum over all."""
        return most

    def aggregate(
        self, latents: Tensor, pairs: Tensor, body: Body, rng: np.random.Generator | None
    ) -> Tensor:
        """A sample of z (its mean when predicting), shape [nodes + collider_nodes, latent_size]."""
        # Sums of precisions in float32 at least, whatever precision the network works in.
        precise = torch.promote_types(latents.dtype, torch.float32)
        observations, spread = latents.to(precise).chunk(2, dim=-1)
        variances = functional.softplus(spread) + MINIMUM_VARIANCE
        mean, variance = bayesian_aggregation(observations, variances, pair_weights(pairs))
        if rng is None:
            return mean

        def draw(count: int) -> np.ndarray:
            return rng.standard_normal((count, mean.shape[1]), dtype=np.float32)

        drawn = np.concatenate([body.drawn_per_node(draw), body.drawn_per_collider_node(draw)])
        return mean + variance.sqrt() * torch.from_numpy(drawn).to(mean.device)


def pair_weights(pairs: Tensor) -> Tensor:
    """How many context pairs each one that was read stands for, shape [pairs].

    Args:
        pairs: their frames, as `ContextEncoder.choose_pairs` gives them: the last pair is always read, and
            stands for itself, unless it is the only one.
    """
    read, present = len(pairs), int(pairs[-1]) + 1
    if read == 1:
        return torch.full((1,), float(present), device=pairs.device)
    weights = torch.full((read,), (present - 1) / (read - 1), device=pairs.device)
    weights[-1] = 1
    return weights


class M3GNNodeMaximum(M3GN):
    """Max node aggregation, max context aggregation: all nodes of a trajectory share one z."""

    encoder_class = NodeMaximumEncoder


class M3GNTransformer(M3GN):
    """No node aggregation, transformer context aggregation."""

    encoder_class = TransformerEncoder


class M3GNNodeMaximumTransformer(M3GN):
    """Max node aggregation, then transformer context aggregation: all nodes of a trajectory share one z."""

    encoder_class = NodeMaximumTransformerEncoder


class NeuralProcessWithPrimitives(M3GN):
    """NP (MP): M3GN with a latent distribution instead of a deterministic z.

    The loss is that of one sample of z per step, a Monte Carlo estimate of the expected log-likelihood with
    the paper's unit variance of the output.
    """

    encoder_class = BayesianEncoder


class StepWithContextConfig(ContextConfig, StepConfig):
    """Hyper-parameters of a context network and a step-wise simulator (defaults: the paper's)."""

    moments_per_step: int = Field(default=4, ge=1)  # of each trajectory, per training step


class M3GNStep(Model):
    """M3GN (Step-based): the context network's z as a node feature of MeshGraphNets.

    Trained by the error of single noisy steps from random frames, the anchor's or later ones; predicts by
    feeding its predictions back, with the z of the context.
    """

    Config = StepWithContextConfig
    preset_file = "m3gn_step.toml"
    config: StepWithContextConfig
    encoder_class: ClassVar[type[ContextEncoder]] = ContextEncoder

    def __init__(self, task: Task, config: StepWithContextConfig) -> None:
        super().__init__(task, config)
        self.encoder = self.encoder_class(task, config)
        self.simulator = StepSimulator(task, config, config.latent_size)

    def predict(self, context: Context) -> Tensor:
        """Positions after the anchor, one simulator call per frame, shape [horizon, nodes, dim]."""
        latent = self.encoder(context, self.velocity_scale, None)
        return self.simulator.rollout(context, self.velocity_scale, latent)

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """Squared error of noisy steps from random frames at or after a random anchor, free nodes only."""
        lower, upper = self.task.training_context
        context = case.context(int(rng.integers(lower, upper + 1)))
        latent = self.encoder(context, self.velocity_scale, rng)
        drawn = case.body.drawn_per_body(
            lambda count: rng.integers(
                context.size - 1, case.frames - 1, (self.config.moments_per_step, count)
            )
        )
        moments = torch.from_numpy(drawn).to(case.positions.device)
        return self.simulator.loss(case, moments, self.velocity_scale, rng, latent)


class NeuralProcessStep(M3GNStep):
    """NP (Step-based): the step-wise simulator with a latent distribution instead of a deterministic z."""

    encoder_class = BayesianEncoder


class M3GNWithHistory(M3GN):
    """M3GN with the last movement as a node feature of the simulator: history length 1, on every task."""

    variant: ClassVar[dict[str, Any]] = {"history": True}


class M3GNWithoutHistory(M3GN):
    """M3GN without past movements among the simulator's features: history length 0, on every task."""

    variant: ClassVar[dict[str, Any]] = {"history": False}


class M3GNOnScaledVelocity(M3GN):
    """M3GN predicts what `scaled_velocity` leaves; shows what is hard for it and what is not (not in the paper)."""

    from_rest = True  # `scaled_velocity` goes on as nodes moved last

    def __init__(self, task: Task, config: M3GNConfig) -> None:
        super().__init__(task, config)
        self.base = ScaledVelocity(task, ModelConfig())

    def prepare(self, cases: Sequence[Case]) -> None:
        """Take statistics from the training data, before the first step."""
        super().prepare(cases)
        self.base.prepare(cases)

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        return self.base.predict(context) + (super().generate(context, rng) - context.positions[-1])


class MeshGraphNetWithoutHistory(MeshGraphNet):
    """MGN that sees positions alone: history length 0 on every task."""

    variant: ClassVar[dict[str, Any]] = {"history": 0}


class M3GNNoise5e4(M3GN):
    """M3GN whose context is observed with noise, sigma = 0.0005."""

    variant: ClassVar[dict[str, Any]] = {"context_noise": 5e-4}


class M3GNNoise1e3(M3GN):
    """M3GN whose context is observed with noise, sigma = 0.001."""

    variant: ClassVar[dict[str, Any]] = {"context_noise": 1e-3}


class M3GNNoise1e2(M3GN):
    """M3GN whose context is observed with noise, sigma = 0.01."""

    variant: ClassVar[dict[str, Any]] = {"context_noise": 1e-2}
