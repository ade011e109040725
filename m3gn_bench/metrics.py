"""Errors of predicted trajectories, and their confidence intervals.

All errors are mean squared errors per coordinate in scaled units, over the frames after the anchor (paper,
section 4: full-rollout MSE and per-timestep MSE).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.stats import bootstrap
from torch import Tensor

from m3gn_bench.data import Body

BOOTSTRAP_RESAMPLES = 9999


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of several trajectories at one context size.

    Attributes:
        mse: full-rollout MSE over all nodes, shape [trajectories].
        mse_free_nodes: the same over nodes that are free to move.
        per_timestep_mse: over all nodes, shape [trajectories, horizon].
    """

    mse: np.ndarray
    mse_free_nodes: np.ndarray
    per_timestep_mse: np.ndarray


def trajectory_errors(body: Body, predicted: Tensor, truth: Tensor) -> TrajectoryErrors:
    """Errors of each body from positions of shape [horizon, nodes, dim]."""
    squared = (predicted - truth).double().square().mean(-1)
    all_nodes, free_nodes, per_timestep = [], [], []
    for error, fixed in zip(
        squared.split(body.node_counts, 1), body.fixed.split(body.node_counts), strict=True
    ):
        all_nodes.append(error.mean())
        free_nodes.append(error[:, ~fixed].mean())
        per_timestep.append(error.mean(1))
    return TrajectoryErrors(
        *(torch.stack(values).cpu().numpy() for values in (all_nodes, free_nodes, per_timestep))
    )


def concatenate(parts: list[TrajectoryErrors]) -> TrajectoryErrors:
    """Errors of several batches of trajectories as one."""
    return TrajectoryErrors(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in TrajectoryErrors.__dataclass_fields__)
    )


def confidence_interval(trajectory_errors: Sequence[float]) -> tuple[float, float]:
    """95 % bootstrap interval (percentile) of the mean of per-trajectory errors, the same at every call."""
    errors = np.asarray(trajectory_errors)
    if len(errors) < 2 or np.ptp(errors) == 0:
        return float(errors.mean()), float(errors.mean())
    interval = bootstrap(
        (errors,),
        np.mean,
        n_resamples=BOOTSTRAP_RESAMPLES,
        confidence_level=0.95,
        method="percentile",
        batch=500,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def bootstrap_means(errors: Sequence[np.ndarray], *, same_runs: bool = False) -> np.ndarray:
    """Means over resampled seeds and trajectories, the same at every call.

    Percentiles of a row are a model's interval. Trajectories are drawn for all models together and seeds for each
    one, so that the difference of two rows is what one model's mean error may exceed the other's by. Of n seeds n - 1
    are drawn at a time: their mean then has the variance that the mean of n seeds has, where n draws of three would
    give two thirds of it (Rao and Wu 1988).

    Args:
        errors: of each model, shape [seeds, trajectories]; all on the same trajectories.
        same_runs: they are all of the same trained models (at several context sizes), so seeds are drawn together, too.

    Returns:
        Shape [models, BOOTSTRAP_RESAMPLES].
    """
    counts = tuple(len(row) for row in (errors[:1] if same_runs else errors))
    trajectories, seeds = _shares(errors[0].shape[1], counts)
    if same_runs:
        seeds = seeds * len(errors)
    return np.stack([((trajectories @ e.T) * s).sum(1) for s, e in zip(seeds, errors, strict=True)])


@lru_cache(maxsize=8)  # drawing takes longer than all that is done with it
def _shares(trajectories: int, seeds: tuple[int, ...]) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Of every trajectory, and of every seed of each model, in the means of all resamples."""
    rng = np.random.default_rng(0)

    def shares(items: int, drawn: int) -> np.ndarray:
        return rng.multinomial(drawn, np.full(items, 1 / items), BOOTSTRAP_RESAMPLES) / drawn

    return shares(trajectories, trajectories), tuple(shares(count, max(1, count - 1)) for count in seeds)
