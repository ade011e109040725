"""How close movement primitives can come at all: least-squares fits of their weights to true trajectories.

What a fit misses, no model with these primitives can predict. Models that are farther off than that want for
something else. All nodes share tau, and start with the velocity at the anchor, as in M3GN.
"""

import argparse
import json

import numpy as np
import torch
from inputs import parse_for_validation

from m3gn_bench.data import Case
from m3gn_bench.m3gn import PrimitivesConfig
from m3gn_bench.model import load_preset
from m3gn_bench.movement_primitives import ProDMP

TAUS = (0.4, 0.5, 0.7, 1.0, 1.65)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="falling_teddy")
    parser.add_argument("--preset", default="compact")
    options, task, cases = parse_for_validation(parser)

    config = load_preset("m3gn", options.preset, task).model
    assert isinstance(config, PrimitivesConfig)
    primitives = ProDMP(config.basis_functions, config.alpha, config.alpha_x)
    rows = [
        {
            "task": task.name,
            "context": context,
            "tau": tau,
            "mse": float(np.mean([fit_error(primitives, case, context, tau) for case in cases])),
        }
        for context in task.context_sizes
        for tau in TAUS
    ]
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print(f"{row['task']}, context {row['context']}, tau {row['tau']}: {row['mse'] * 1e6:.3g} x 1e-6")


def fit_error(primitives: ProDMP, case: Case, context: int, tau: float) -> float:
    """Mean square over all nodes and frames after the context of what the best weights leave."""
    unit = case.frames - 1
    times = torch.arange(1, case.frames - context + 1) / unit
    responses = primitives.responses(times, torch.tensor([tau]))[0]
    parameters = responses.shape[-1] - 1  # weights and goal; the last response is the velocity's
    no_velocity = torch.zeros(parameters, 1)
    by_weights = primitives.movement(responses, torch.eye(parameters)[:, None], no_velocity)[..., 0]
    by_velocity = primitives.movement(responses, torch.zeros(1, 1, parameters), torch.ones(1, 1))[:, 0]
    anchor = case.positions[context - 1]
    velocity = (anchor - case.positions[context - 2]) * unit
    wanted = (case.future(context) - anchor - by_velocity[..., None] * velocity).flatten(1).double()
    # Neighbouring primitives are nearly the same, so the system is badly conditioned: LAPACK's gelsd, in double.
    weights = torch.linalg.lstsq(by_weights.double(), wanted, driver="gelsd").solution
    return float((by_weights.double() @ weights - wanted).square().mean())


if __name__ == "__main__":
    main()
