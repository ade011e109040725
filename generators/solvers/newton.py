"""Minimise a potential energy by modified Newton: factors are reused while they still work.

The potential is Pi(x) = W(x) - f.x over the free unknowns; W is a stored energy or, in a step of implicit
dynamics, the incremental potential with inertia and contact. A factorisation costs several times more than
an evaluation, so the last one is kept until the residual falls too slowly. Every step passes an Armijo
test on the potential itself; the evaluation that gives the next residual gives the energy too, so the test
is free unless it fails.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.sparse import Array, BandedAssembler, BandedCholesky

SHORTEST_STEP = 2**-12  # of a Newton step; a line search that goes below has failed


class Energy(Protocol):
    """What Newton needs to know of a body; all vectors are over the free unknowns."""

    assembler: BandedAssembler

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """Energy W (infinite where the state is inadmissible) and internal force dW/dx."""
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
    """Newton's method that keeps its factorisation between iterations and between load increments or steps.

    Args:
        body: the energy.
        tolerance: converged when |internal - external force| falls below `tolerance` times the force scale.
        refactor_ratio: refactorise when an iteration reduces the residual by less than this factor.
        max_iterations: give up after so many iterations.
    """

    def __init__(
        self, body: Energy, *, tolerance: float, refactor_ratio: float = 0.3, max_iterations: int = 60
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

    def minimise(self, x: Array, *, force_scale: Callable[[], float], load: Array | None = None) -> Array:
        """Equilibrium near the guess `x`.

        Args:
            x: the guess, shape [unknowns].
            force_scale: the force that a residual is compared with, asked after every evaluation: the full
                load of a loaded body, or the current reaction of one whose boundary is moved.
            load: dead load over the free unknowns; none if left out.

        Raises:
            SolverError: no equilibrium within the allowed iterations, or an inadmissible guess.
        """
        energy, force = self._evaluate(x)
        potential, residual = self._loaded(x, energy, force, load)
        if not np.isfinite(potential):
            raise SolverError("the guess is inadmissible (its energy is not finite)")
        norm = float(np.linalg.norm(residual))
        scale = force_scale()
        for iteration in range(self.max_iterations + 1):
            if norm <= self.tolerance * scale:
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
            slack = 1e-12 * max(abs(energy), abs(potential))
            while True:
                trial = x + length * direction
                trial_energy, force = self._evaluate(trial)
                trial_potential, trial_residual = self._loaded(trial, trial_energy, force, load)
                if trial_potential <= potential + 1e-4 * length * slope + slack:
                    break
                self.statistics.rejected_steps += 1
                length *= 0.5
                if length < SHORTEST_STEP:
                    if fresh:
                        raise SolverError(f"line search failed, relative residual {norm / scale:.2e}")
                    break
            if length < SHORTEST_STEP:  # the old factor no longer points downhill far enough: make a new one
                self.forget()
                continue
            x, energy, potential, residual = trial, trial_energy, trial_potential, trial_residual
            previous, norm = norm, float(np.linalg.norm(residual))
            scale = force_scale()
            if norm > self.refactor_ratio * previous:
                self.forget()
        raise SolverError(
            f"no equilibrium after {self.max_iterations} iterations, relative residual {norm / scale:.2e}"
        )

    @staticmethod
    def _loaded(x: Array, energy: float, force: Array, load: Array | None) -> tuple[float, Array]:
        """Potential and residual."""
        return (energy, force) if load is None else (float(energy - load @ x), force - load)

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
