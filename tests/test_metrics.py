"""Errors by hand, and intervals against another implementation and known variances."""

import numpy as np
import pytest
from model_cases import make_case

from m3gn_bench.data import join
from m3gn_bench.metrics import bootstrap_means, confidence_interval, trajectory_errors


def test_errors_of_two_bodies() -> None:
    """One coordinate of one node of the second body is off by 2, in the last of three frames."""
    case = join([make_case("sheet_deformation", 0), make_case("sheet_deformation", 3, size=5)])
    first, second = case.body.node_counts
    truth = case.positions[-3:]
    predicted = truth.clone()
    free = first + int((~case.body.fixed[first:]).nonzero()[0])
    predicted[-1, free, 0] += 2
    errors = trajectory_errors(case.body, predicted, truth)
    assert errors.mse == pytest.approx([0, 4 / (3 * second * 3)])
    assert errors.mse_free_nodes[1] == pytest.approx(4 / (3 * int((~case.body.fixed[first:]).sum()) * 3))
    assert errors.per_timestep_mse == pytest.approx(np.array([[0, 0, 0], [0, 0, 4 / (second * 3)]]))


def test_one_seed_is_the_bootstrap_over_trajectories() -> None:
    errors = np.random.default_rng(0).exponential(size=60)
    found = np.percentile(bootstrap_means([errors[None]])[0], [2.5, 97.5])
    low, high = confidence_interval(errors)
    assert found == pytest.approx([low, high], abs=0.02 * (high - low))


def test_variances_of_seeds_and_trajectories_add_up() -> None:
    rng = np.random.default_rng(1)
    seeds, trajectories = rng.normal(size=(5, 1)), rng.normal(size=(1, 80))
    means = bootstrap_means([10 + seeds + trajectories])[0]
    assert means.mean() == pytest.approx(10 + seeds.mean() + trajectories.mean(), abs=0.02)
    assert means.var() == pytest.approx(seeds.var(ddof=1) / 5 + trajectories.var() / 80, rel=0.05)


def test_models_are_compared_on_the_same_trajectories() -> None:
    """Hard trajectories are hard for both: the difference is far more certain than either mean."""
    errors = np.random.default_rng(2).exponential(size=(1, 40))
    first, second = bootstrap_means([errors, errors + 0.01])
    assert second - first == pytest.approx(0.01)
    assert np.array_equal(bootstrap_means([errors])[0], first)
