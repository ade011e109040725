"""Follow an equilibrium path while a dead load grows from zero: no inertia, no time scale."""

import numpy as np

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array

MAX_BISECTIONS = 8


def load_path(newton: ModifiedNewton, load: Array, increments: int) -> Array:
    """Equilibria under the loads k/increments * load, k = 0..increments, from the unloaded state.

    Each increment starts from a quadratic extrapolation of the last three states, which saves most of the
    factorisations. Where that fails it starts from the last state, and where that fails too the increment
    is halved, up to eight times.

    Args:
        newton: the solver, holding the body.
        load: the full load over the free unknowns [N], shape [unknowns].
        increments: number of equal load increments.

    Returns:
        Free unknowns at every load level, shape [increments + 1, unknowns].

    Raises:
        SolverError: names the increment and residual at which the path was lost.
    """
    scale = float(np.linalg.norm(load))
    states = np.zeros((increments + 1, len(load)))
    for k in range(1, increments + 1):
        try:
            states[k] = newton.minimise(
                _extrapolate(states[:k]), load=load * (k / increments), force_scale=lambda: scale
            )
        except SolverError:
            newton.forget()
            try:
                states[k] = _bisect(
                    newton, states[k - 1], load, (k - 1) / increments, k / increments, scale, MAX_BISECTIONS
                )
            except SolverError as error:
                raise SolverError(
                    f"frame {k} of {increments}: {error} at {k / increments:.0%} of the load, after "
                    f"{MAX_BISECTIONS} bisections; use a smaller load or a stiffer body"
                ) from error
    return states


def _extrapolate(states: Array) -> Array:
    if len(states) >= 4:  # the very first increment moves far more than the others: leave it out
        return 3 * states[-1] - 3 * states[-2] + states[-3]
    if len(states) == 3:
        return 2 * states[-1] - states[-2]
    return states[-1]


def _bisect(
    newton: ModifiedNewton, start: Array, load: Array, lower: float, upper: float, scale: float, depth: int
) -> Array:
    """Walk from the equilibrium `start` at load fraction `lower` to `upper`, halving where Newton fails."""
    try:
        return newton.minimise(start, load=load * upper, force_scale=lambda: scale)
    except SolverError:
        if depth == 0:
            raise
        newton.forget()
        newton.statistics.bisections += 1
        middle = 0.5 * (lower + upper)
        halfway = _bisect(newton, start, load, lower, middle, scale, depth - 1)
        return _bisect(newton, halfway, load, middle, upper, scale, depth - 1)
