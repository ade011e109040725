"""Minimise a potential energy by modified Newton: factors are reused while they still work.

The potential is Pi(x) = W(x) - f.x over the free unknowns. A factorisation costs several times more than
an evaluation, so the last one is kept until the residual falls too slowly. Every step passes an Armijo
test on the potential itself; the evaluation that gives the next residual gives the energy too, so the test
is free unless it fails.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.sparse import Array, BandedAssembler, BandedCholesky

SHORTEST_STEP = 2**-12  # of a Newton step; a line search that goes below has failed


class StoredEnergy(Protocol):
    """What Newton needs to know of an elastic body; all vectors are over the free unknowns."""

    assembler: BandedAssembler

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """Stored energy W [N mm] (infinite where the state is inadmissible) and internal force dW/dx."""
        ...

    def stiffness(self, x: Array) -> Array:
        """Second derivative of W at x, assembled (banded)."""
        ...


@dataclass
class NewtonStatistics:
    """What a solution cost; part of a trajectory's diagnostics."""

    factorisations: int = 0
    evaluations: int = 0
    shifted_factorisations: int = 0
    rejected_steps: int = 0
    bisections: int = 0


class ModifiedNewton:
    """Newton's method that keeps its factorisation between iterations and between load increments.

    Args:
        body: the stored energy.
        tolerance: converged when |internal - external force| falls below `tolerance` times |full load|.
        refactor_ratio: refactorise when an iteration reduces the residual by less than this factor.
        max_iterations: give up after so many iterations.
    """

    def __init__(
        self, body: StoredEnergy, *, tolerance: float, refactor_ratio: float = 0.3, max_iterations: int = 60
    ) -> None:
        self.body = body
        self.tolerance = tolerance
        self.refactor_ratio = refactor_ratio
        self.max_iterations = max_iterations
        self.statistics = NewtonStatistics()
        self._factor: BandedCholesky | None = None

    def forget(self) -> None:
        """Drop the kept factorisation: the next iteration makes a new one."""
        self._factor = None

    def minimise(self, x: Array, load: Array, load_scale: float) -> Array:
        """Equilibrium near the guess `x` under the dead load `load` [N], to tolerance * load_scale.

        Raises:
            SolverError: no equilibrium within the allowed iterations.
        """
        energy, force = self._evaluate(x)
        potential, residual = energy - load @ x, force - load
        norm = float(np.linalg.norm(residual))
        for iteration in range(self.max_iterations + 1):
            if norm <= self.tolerance * load_scale:
                return x
            if iteration == self.max_iterations:
                break
            fresh = self._factor is None
            if self._factor is None:
                self._factor = self._factorise(x)
            direction = -self._factor.solve(residual)
            slope = float(residual @ direction)

            length = 1.0
            # The potential is a small difference of large numbers near the minimum: allow its round-off.
            slack = 1e-12 * max(abs(energy), float(abs(potential)))
            while True:
                trial = x + length * direction
                trial_energy, force = self._evaluate(trial)
                trial_potential = trial_energy - load @ trial
                if trial_potential <= potential + 1e-4 * length * slope + slack:
                    break
                self.statistics.rejected_steps += 1
                length *= 0.5
                if length < SHORTEST_STEP:
                    if fresh:
                        raise SolverError(f"line search failed, residual {norm / load_scale:.2e} of the load")
                    break
            if length < SHORTEST_STEP:  # the old factor no longer points downhill far enough: make a new one
                self.forget()
                continue
            x, energy, potential, residual = trial, trial_energy, trial_potential, force - load
            previous, norm = norm, float(np.linalg.norm(residual))
            if norm > self.refactor_ratio * previous:
                self.forget()
        raise SolverError(
            f"no equilibrium after {self.max_iterations} iterations, residual {norm / load_scale:.2e} of the load"
        )

    def _evaluate(self, x: Array) -> tuple[float, Array]:
        self.statistics.evaluations += 1
        return self.body.energy_and_force(x)

    def _factorise(self, x: Array) -> BandedCholesky:
        self.statistics.factorisations += 1
        try:
            factor, shifts = self.body.assembler.factorise_shifted(self.body.stiffness(x))
        except LinAlgError as error:
            raise SolverError(str(error)) from error
        self.statistics.shifted_factorisations += shifts > 0
        return factor
