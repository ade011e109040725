"""Implicit dynamics of elastic solids: every time step minimises an incremental potential.

The equation of motion with mass-proportional damping, rho (a + alpha v) = div P, discretised by the two-step
backward differentiation formula (BDF2) for steps of any size, is the stationarity condition of

    Pi(u) = W(u) + contact(u) + m/2 |u - u_predicted|^2_M,    m = rho (c^2 + alpha c),

with c = 1.5/h for equal steps h and M the consistent mass per density. So the line search of Newton's method
always has an energy to look at, and a step that cannot be taken is halved. Variable-step coefficients:
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section III.5; BDF2 is stable
while steps grow by less than 1 + sqrt(2).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.contact import ContactState, PenaltyContact
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Response, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array, BandedAssembler

MAX_BISECTIONS = 8
MAX_STEP_GROWTH = 2.0  # beyond this a backward Euler step begins a new history


class ConstrainedSolid:
    """A solid some of whose degrees of freedom are prescribed: numbering and mass of the others.

    Never changed, so many simulations may share it.

    Args:
        solid: the body.
        constrained: prescribed degrees of freedom (clamped or moved), shape [constrained].
    """

    def __init__(self, solid: Solid, constrained: NDArray[np.integer]) -> None:
        self.solid = solid
        self.constrained = np.unique(constrained)
        free = np.setdiff1d(np.arange(solid.dofs), self.constrained)
        # Sorted along its longest side a regular mesh has the narrowest band.
        by_axis = [np.argsort(np.repeat(x, solid.dimension)[free], kind="stable") for x in solid.nodes.T]
        self.assembler = BandedAssembler(solid.element_dofs, free, solid.dofs, orders=by_axis)
        self.banded_mass = self.assembler.matrix(solid.element_mass_matrices())
        nodes, functions = solid.element_nodes, solid.element_nodes.shape[1]
        rows, columns = np.repeat(nodes, functions, axis=1).ravel(), np.tile(nodes, (1, functions)).ravel()
        self.nodal_mass = csr_matrix((solid.element_masses.ravel(), (rows, columns)), (len(solid.nodes),) * 2)


class IncrementalPotential:
    """The potential of one implicit step, as Newton's method wants it (all vectors over the free unknowns).

    Args:
        body: the solid and its constraints.
        law: the material; may be exchanged between steps.
        contact: energy of contact with obstacles, if there are any.
        force_floor: added to the reaction in `force_scale`, so that a body at rest counts as at rest.
    """

    def __init__(
        self,
        body: ConstrainedSolid,
        law: NeoHookean,
        *,
        contact: PenaltyContact | None = None,
        force_floor: float,
    ) -> None:
        self.body = body
        self.law = law
        self.contact = contact
        self.force_floor = force_floor
        self.assembler = body.assembler
        self.contact_state: ContactState | None = None  # of the last evaluation
        self.min_jacobian = 1.0  # of the last evaluation
        self.reaction = np.zeros(len(body.constrained))  # of the last evaluation, on the constraints
        self._x: Array | None = None
        self._response: Response | None = None
        self.begin_step(0.0, np.zeros(len(body.constrained)), np.zeros(body.solid.dofs), 0.0)

    def begin_step(self, time: float, prescribed: Array, predicted: Array, mass_factor: float) -> None:
        """Set what the potential of a step depends on.

        Args:
            time: the step's end.
            prescribed: displacement of the constrained degrees of freedom then, shape [constrained].
            predicted: u_predicted, shape [dofs].
            mass_factor: m; 0 for a quasi-static step.
        """
        self.time = time
        self._prescribed = prescribed
        self._predicted = predicted
        self._mass_factor = mass_factor
        self._x = None

    def expand(self, x: Array) -> Array:
        """The displacement of all degrees of freedom [dofs]."""
        u = np.empty(self.body.solid.dofs)
        u[self.assembler.free] = x
        u[self.body.constrained] = self._prescribed
        return u

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """Pi (infinite where a Gauss point is inverted) and its derivative."""
        solid = self.body.solid
        u = self.expand(x)
        response = solid.response(u, self.law)
        self._x, self._response = x, response
        self.min_jacobian = float(response.jacobian.min())
        if not response.admissible:
            return np.inf, np.zeros_like(x)
        energy = solid.energy(response)
        force = self.assembler.full_vector(solid.element_forces(response))
        if self.contact is not None:
            self.contact_state = self.contact.evaluate(u, self.time)
            energy += self.contact_state.energy
            if self.contact_state.force is not None:
                force += self.contact_state.force
        if self._mass_factor:
            offset = u - self._predicted
            inertia = self._mass_factor * (self.body.nodal_mass @ offset.reshape(-1, solid.dimension)).ravel()
            energy += 0.5 * float(offset @ inertia)
            force += inertia
        self.reaction = force[self.body.constrained]
        return energy, force[self.assembler.free]

    def stiffness(self, x: Array) -> Array:
        """Second derivative of Pi, assembled (banded)."""
        if self._x is not x:
            self.energy_and_force(x)
        assert self._response is not None
        matrices = self.body.solid.element_stiffness(self._response)
        if self.contact is not None and self.contact_state is not None:
            self.contact.add_stiffness(self.contact_state, matrices)
        stiffness = self.assembler.matrix(matrices)
        if self._mass_factor:
            stiffness += self._mass_factor * self.body.banded_mass
        return stiffness

    def force_scale(self) -> float:
        """Norm of the reaction at the constraints, plus the floor."""
        return float(np.linalg.norm(self.reaction)) + self.force_floor


@dataclass(frozen=True)
class _Motion:
    """Displacement and velocity of all degrees of freedom at a time."""

    time: float
    displacement: Array
    velocity: Array


class ImplicitDynamics:
    """March a solid through time, from rest.

    Args:
        potential: the body, its material and its obstacles.
        newton: the minimiser of that same potential.
        density: rho; 0 makes every step an equilibrium (quasi-static).
        damping: alpha [1 / time], mass-proportional.
        prescribed: displacement of the constrained degrees of freedom at a time, shape [constrained]; left
            out, they are clamped.

    Attributes:
        time: reached.
        displacement: of all degrees of freedom then, shape [dofs].
        contact_forces: of the body on each obstacle then.
        min_jacobian: smallest J at a Gauss point in any step so far.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        newton: ModifiedNewton,
        *,
        density: float,
        damping: float = 0.0,
        prescribed: Callable[[float], Array] | None = None,
    ) -> None:
        if density < 0 or damping < 0:
            raise ValueError(f"density and damping must not be negative, not {density}, {damping}")
        self.potential = potential
        self.newton = newton
        self.density = density
        self.damping = damping
        clamped = np.zeros(len(potential.body.constrained))
        self._prescribed = prescribed or (lambda time: clamped)
        at_rest = np.zeros(potential.body.solid.dofs)
        self._now = _Motion(0.0, at_rest, at_rest)
        self._before: _Motion | None = None
        self._factored_step = 0.0  # size of the step for which the kept factorisation was made
        self.min_jacobian = 1.0

    @property
    def time(self) -> float:
        """Reached."""
        return self._now.time

    @property
    def displacement(self) -> Array:
        """Shape [dofs]."""
        return self._now.displacement

    @property
    def contact_forces(self) -> Array:
        """Of the body on each obstacle at the end of the last step, shape [obstacles, d]."""
        state = self.potential.contact_state
        if state is None:
            raise ValueError("no contact, or no step yet")
        return state.resultants

    def restart(self) -> None:
        """Begin a new history: call it where material or load jump. The next step is backward Euler."""
        self._before = None
        self.newton.forget()

    def advance(self, end: float, steps: int, label: str) -> None:
        """March to the time `end` in equal steps, each of which is halved where Newton's method fails.

        Args:
            end: later than `time`.
            steps: at least 1.
            label: what to call this interval in an error, e.g. "frame 3 of 50".

        Raises:
            SolverError: a step failed even after eight bisections; names the interval, its time, the smallest
                J and the residual.
        """
        start = self.time
        ends = [start + (end - start) * (k + 1) / steps for k in range(steps)]
        for target in ends:
            pending = [(target, 0)]
            while pending:
                until, depth = pending[-1]
                try:
                    self._step(until)
                except SolverError as error:
                    self.newton.forget()
                    if depth == MAX_BISECTIONS:
                        raise SolverError(
                            f"{label}: the step from time {self.time:.6g} to {until:.6g} fails after "
                            f"{MAX_BISECTIONS} bisections: {error}, smallest J {self.potential.min_jacobian:.3g}; move "
                            "what deforms the body less far, or more slowly"
                        ) from error
                    self.newton.statistics.bisections += 1
                    pending[-1] = (until, depth + 1)
                    pending.append((0.5 * (self.time + until), depth + 1))
                else:
                    pending.pop()

    def _step(self, end: float) -> None:
        """One step: from the extrapolated motion or, where that guess fails, from the present state."""
        now, potential = self._now, self.potential
        h = end - now.time
        if abs(h - self._factored_step) > 1e-6 * h:
            self.newton.forget()
            self._factored_step = h
        rate, position, velocity = self._history(h)
        mass_factor = self.density * rate * (rate + self.damping)
        predicted = position
        if mass_factor:
            predicted = position + self.density * rate / mass_factor * velocity
        potential.begin_step(end, self._prescribed(end), predicted, mass_factor)

        free = potential.assembler.free
        try:
            x = self.newton.minimise(self._guess(h)[free], force_scale=potential.force_scale)
        except SolverError:
            self.newton.forget()
            x = self.newton.minimise(now.displacement[free], force_scale=potential.force_scale)
        u = potential.expand(x)
        self._before, self._now = now, _Motion(end, u, rate * (u - position))
        self.min_jacobian = min(self.min_jacobian, potential.min_jacobian)

    def _history(self, h: float) -> tuple[float, Array, Array]:
        """The formula d/dt y = rate (y_new - history(y)): its rate and the histories of u and v."""
        now, before = self._now, self._before
        growth = h / (now.time - before.time) if before is not None else np.inf
        if before is None or growth > MAX_STEP_GROWTH * (1 + 1e-6):
            return 1 / h, now.displacement, now.velocity
        new, last, older = (1 + 2 * growth) / (1 + growth), 1 + growth, growth**2 / (1 + growth)
        return (
            new / h,
            (last * now.displacement - older * before.displacement) / new,
            (last * now.velocity - older * before.velocity) / new,
        )

    def _guess(self, h: float) -> Array:
        """Displacement after a further step h at the present velocity and acceleration."""
        now, before = self._now, self._before
        guess = now.displacement + h * now.velocity
        if before is not None:
            guess = guess + 0.5 * h**2 / (now.time - before.time) * (now.velocity - before.velocity)
        return guess
