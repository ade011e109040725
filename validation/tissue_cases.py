"""What the checks of the tissue share: load cases, a march with physics that the scene leaves out, errors."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_matrix

from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.tissue_manipulation import (
    FRAME,
    MATERIALS,
    RENEWAL_INTERVAL,
    THICKNESS,
    TRANSITIONS,
    TissueFidelity,
    TissueManipulation,
    TissueParameters,
    make_slab,
)

DENSITY = 1.07e-3  # [g/mm^3], of the tissue where it is not quasi-static; with it units are mm, g and s
DAMPING = 20.0  # [1/s], mass-proportional, so without effect on a quasi-static pull
DEFAULT = TissueManipulation.fidelities["default"]
FAST = TissueManipulation.fidelities["fast"]

# One pull per material: from the left against the slab's lean, straight up, and from the right along it.
CASES = [
    TissueParameters(*material, patch=patch, angle=angle)
    for material, patch, angle in zip(MATERIALS, (4, 9, 15), (150.0, 90.0, 20.0), strict=True)
]
SEED = 4711


def draw(index: int) -> TissueParameters:
    """A draw of another seed than any dataset's."""
    return TissueManipulation().sample(np.random.default_rng([SEED, index]), index)


@lru_cache
def displacements(parameters: TissueParameters, level: TissueFidelity = DEFAULT) -> Array:
    """Displacements [mm] of the recorded vertices as the scene writes them, shape [frames, 361, 3]."""
    trajectory = TissueManipulation().simulate_with(parameters, level)
    return trajectory.positions.astype(np.float64) - trajectory.mesh.rest_positions


class _LoadedPotential(IncrementalPotential):
    """With a constant body force and stiffness-proportional (Rayleigh) damping of one backward Euler step.

    The damping's incremental potential is beta/(2 h) |u - u_before|^2_K with the tangent stiffness K at the
    step's beginning (that at rest would resist rotation, too).
    """

    def __init__(
        self,
        body: ConstrainedSolid,
        law: NeoHookean,
        *,
        acceleration: Array,
        stiffness_damping: float,
        force_floor: float,
    ) -> None:
        super().__init__(body, law, force_floor=force_floor)
        mass = np.asarray(body.nodal_mass.sum(1)).ravel()
        self.load = DENSITY * np.outer(mass, acceleration).ravel()
        self.viscosity = stiffness_damping / FRAME
        self.begin_frame(np.zeros(body.solid.dofs))

    def begin_frame(self, before: Array) -> None:
        """Set the state at the step's beginning, shape [dofs]."""
        solid = self.body.solid
        self.before = before
        matrices = self.viscosity * solid.element_stiffness(solid.response(before, self.law))
        local = solid.element_dofs
        rows, columns = np.repeat(local, local.shape[1], axis=1), np.tile(local, (1, local.shape[1]))
        self.damping = coo_matrix((matrices.ravel(), (rows.ravel(), columns.ravel()))).tocsr()
        self.banded_damping = self.assembler.matrix(matrices)

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        energy, force = super().energy_and_force(x)
        if not np.isfinite(energy):
            return energy, force
        u = self.expand(x)
        viscous = self.damping @ (u - self.before)
        energy += 0.5 * float((u - self.before) @ viscous) - float(self.load @ u)
        return energy, force + (viscous - self.load)[self.assembler.free]

    def stiffness(self, x: Array) -> Array:
        return super().stiffness(x) + self.banded_damping


def march(
    parameters: TissueParameters,
    level: TissueFidelity = DEFAULT,
    *,
    density: float = 0.0,
    acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0),
    stiffness_damping: float = 0.0,
    distance: Callable[[float], float] = lambda time: time,
    transitions: int = TRANSITIONS,
    alter: Callable[[ConstrainedSolid], ConstrainedSolid] = lambda body: body,
) -> Array:
    """Displacements of the recorded vertices [mm], shape [transitions + 1, 361, 3], with other physics.

    Args:
        parameters: the draw.
        level: the discretisation.
        density: of the inertia; 0, as in the scene, for a quasi-static pull.
        acceleration: body force per mass [mm/s^2], e.g. of gravity.
        stiffness_damping: Rayleigh's coefficient [s]; only with one step per frame.
        distance: the gripper's travel over its speed at a time [s].
        transitions: how many frames to march.
        alter: makes another body of the slab, with the same unknowns.
    """
    slab = make_slab(parameters.patch, level.cells, level.element)
    body = alter(slab.body)
    law = NeoHookean.from_youngs_modulus(parameters.youngs_modulus, parameters.poisson_ratio, "3d")
    velocity = parameters.speed * parameters.direction
    floor = 1e-9 * parameters.youngs_modulus * THICKNESS**2
    potential: IncrementalPotential
    if stiffness_damping or any(acceleration):
        assert level.steps == 1, "the damping knows one step per frame"
        potential = _LoadedPotential(
            body,
            law,
            acceleration=np.array(acceleration),
            stiffness_damping=stiffness_damping,
            force_floor=floor,
        )
    else:
        potential = IncrementalPotential(body, law, force_floor=floor)
    newton = ModifiedNewton(potential, tolerance=level.tolerance)
    dynamics = ImplicitDynamics(
        potential,
        newton,
        density=density,
        damping=DAMPING,
        prescribed=lambda time: slab.prescribed(distance(time) * velocity),
    )
    states = np.zeros((transitions + 1, slab.interpolation.shape[0], 3))
    for frame in range(1, transitions + 1):
        if isinstance(potential, _LoadedPotential):
            potential.begin_frame(dynamics.displacement)
        dynamics.advance(frame * FRAME, level.steps, f"frame {frame}")
        states[frame] = slab.interpolation @ dynamics.displacement.reshape(-1, 3)
        if frame % RENEWAL_INTERVAL == 0:  # as the scene does
            newton.forget()
    return states
