"""Physics that the scenes leave out, or have and go without here; each function gives a path to compare.

Nothing of this is needed to generate a dataset: `physics.py` measures with it what every term changes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from sheet_cases import at_recorded_nodes
from skfem import Basis

from m3gn_bench.generators import falling
from m3gn_bench.generators.deformable_block import (
    BASE,
    DAMPING,
    DENSITY,
    NODES_PER_SIDE,
    BlockParameters,
    DeformableBlock,
)
from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.falling import SIZE, FallFidelity, FallParameters, MixedObjects
from m3gn_bench.generators.sheet_deformation import (
    INCREMENTS,
    LOAD_RADIUS,
    THICKNESS,
    SheetDeformation,
    SheetParameters,
)
from m3gn_bench.generators.solvers.contact import BoundaryPoints, Disc
from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Response, Solid
from m3gn_bench.generators.solvers.newton import Energy, ModifiedNewton
from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.solvers.tetrahedra import Motion, TetrahedralSolid
from m3gn_bench.generators.tissue_manipulation import surface

# -- the sheet ---------------------------------------------------------------------------------------------

SHEET_DENSITY = 1e-9  # [t/mm^3], 1000 kg/m^3; with it units are mm, N, MPa and s
STANDARD_GRAVITY = 9810.0  # [mm/s^2]


def _loaded_sheet(parameters: SheetParameters) -> tuple[ClampedPlate, Array]:
    """The scene's plate and its full load over all degrees of freedom."""
    plate = SheetDeformation().plate(parameters.youngs_modulus, 1)
    load = np.zeros(plate.dofs)
    for centre, force in zip(parameters.centres, parameters.forces, strict=True):
        load += plate.disc_load(centre, LOAD_RADIUS, (0.0, 0.0, force))
    return plate, load


def _recorded(plate: ClampedPlate, states: Array) -> Array:
    return at_recorded_nodes(plate.nodes[:, :2], plate.displacements(states))


def linear_sheet(parameters: SheetParameters) -> Array:
    """Small displacements: the stiffness of the unloaded plate throughout."""
    plate, load = _loaded_sheet(parameters)
    stiffness = plate.stiffness(np.zeros(plate.assembler.unknowns))
    full = plate.assembler.factorise(stiffness).solve(load[plate.assembler.free])
    return _recorded(plate, np.linspace(0, 1, INCREMENTS + 1)[:, None] * full)


class _WithMass(Energy):
    """A plate's energy plus that of inertia within a step, `factor` / 2 |x - predicted|^2 in the mass."""

    def __init__(self, plate: ClampedPlate) -> None:
        self.plate, self.assembler = plate, plate.assembler
        # The plate's own three Gauss points would under-integrate the product of two bicubics.
        basis = Basis(plate.mesh, plate.basis.elem, intorder=6)
        values = np.array([np.asarray(function[0]) for function in basis.basis])
        scalar = SHEET_DENSITY * THICKNESS * np.einsum("aeq,beq,eq->eab", values, values, basis.dx)
        elements, functions, _ = scalar.shape
        self.matrices = np.einsum("eab,ij->eaibj", scalar, np.eye(3)).reshape(elements, 3 * functions, -1)
        self.banded = plate.assembler.matrix(self.matrices)
        dofs = plate.basis.element_dofs.T
        self.element_dofs = (3 * dofs[:, :, None] + np.arange(3)).reshape(elements, -1)
        self.factor, self.predicted = 0.0, np.zeros(plate.assembler.unknowns)

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """See Energy."""
        energy, force = self.plate.energy_and_force(x)
        offset = x - self.predicted
        local = self.plate.expand(offset)[self.element_dofs]
        inertia = self.factor * self.assembler.vector(np.einsum("eab,eb->ea", self.matrices, local))
        return energy + 0.5 * float(offset @ inertia), force + inertia

    def stiffness(self, x: Array) -> Array:
        """See Energy."""
        return self.plate.stiffness(x) + self.factor * self.banded


def sheet_with_inertia(parameters: SheetParameters, duration: float, steps: int = 4) -> Array:
    """The load grows within `duration` [s]; BDF2 with so many steps per frame, the first backward Euler."""
    plate, load = _loaded_sheet(parameters)
    load = load[plate.assembler.free]
    body = _WithMass(plate)
    newton = ModifiedNewton(body, tolerance=1e-6)
    scale, h = float(np.linalg.norm(load)), duration / (INCREMENTS * steps)
    x = before = v = v_before = np.zeros(plate.assembler.unknowns)
    states = [x]
    for step in range(1, INCREMENTS * steps + 1):
        rate = 1 / h if step == 1 else 1.5 / h
        x_history = x if step == 1 else (4 * x - before) / 3
        v_history = v if step == 1 else (4 * v - v_before) / 3
        body.factor, body.predicted = rate**2, x_history + v_history / rate
        if step == 2:
            newton.forget()  # its matrix belongs to another rate
        applied = load * (step / (INCREMENTS * steps))
        new = newton.minimise(x + h * v, load=applied, force_scale=lambda: scale)
        before, v_before = x, v
        x, v = new, rate * (new - x_history)
        if step % steps == 0:
            states.append(x)
    return _recorded(plate, np.array(states))


def sheet_with_weight(parameters: SheetParameters) -> Array:
    """The sheet's own weight acts before the forces do."""
    plate, load = _loaded_sheet(parameters)
    weight = plate.uniform_load(-SHEET_DENSITY * STANDARD_GRAVITY * THICKNESS)[plate.assembler.free]
    load = load[plate.assembler.free]
    newton, scale = ModifiedNewton(plate, tolerance=1e-6), float(np.linalg.norm(load))
    states = [np.zeros(plate.assembler.unknowns)]
    for k in range(INCREMENTS + 1):
        guess = states[-1] if k < 3 else 2 * states[-1] - states[-2]
        applied = weight + load * (k / INCREMENTS)
        states.append(newton.minimise(guess, load=applied, force_scale=lambda: scale))
    return _recorded(plate, np.array(states[1:]))


class _Membrane(ClampedPlate):
    """A plate with next to no bending stiffness; with none at all the flat sheet would have no stiffness."""

    def __init__(self, share: float, like: ClampedPlate) -> None:
        super().__init__(
            ticks=np.unique(like.mesh.p[0]),
            thickness=like.thickness,
            youngs_modulus=like.youngs_modulus,
            poisson_ratio=like.poisson_ratio,
        )
        self._bending_law = share * self._bending_law


def sheet_without_bending(parameters: SheetParameters, share: float = 1e-3) -> Array:
    """A thousandth of the bending stiffness is left."""
    plate, load = _loaded_sheet(parameters)
    membrane = _Membrane(share, plate)
    load = load[membrane.assembler.free]
    newton, scale = ModifiedNewton(membrane, tolerance=1e-4), float(np.linalg.norm(load))
    states = [np.zeros(membrane.assembler.unknowns)]
    for k in range(1, INCREMENTS + 1):
        guess = states[-1] if k < 4 else 2 * states[-1] - states[-2]
        states.append(newton.minimise(guess, load=load * (k / INCREMENTS), force_scale=lambda: scale))
    return _recorded(membrane, np.array(states))


# -- solids at small strain ---------------------------------------------------------------------------------


class _LinearResponse(Response):
    """Hooke's law with the moduli of a law for finite strain, and no geometric nonlinearity."""

    def __init__(self, law: NeoHookean, F: Array) -> None:
        d = len(F)
        self.jacobian, self.admissible = np.ones(F.shape[-1]), True
        gradient = F - np.eye(d)[:, :, None]
        strain = (gradient + gradient.swapaxes(0, 1)) / 2
        self._lam, self._mu, self._shape = (
            law.bulk_modulus - 2 * law.shear_modulus / d,
            law.shear_modulus,
            F.shape,
        )
        self.stress = 2 * self._mu * strain
        trace = np.trace(strain)
        for i in range(d):
            self.stress[i, i] += self._lam * trace
        self.energy = 0.5 * np.einsum("ijp,ijp->p", self.stress, strain)

    def tangent(self) -> Array:
        """See Response."""
        one = np.eye(self._shape[0])
        same = np.einsum("ik,jl->ijkl", one, one) + np.einsum("il,jk->ijkl", one, one)
        hooke = self._lam * np.einsum("ij,kl->ijkl", one, one) + self._mu * same
        return np.broadcast_to(hooke[..., None], (*hooke.shape, self._shape[-1]))


class _LinearSolid(Solid):
    """A solid at small strain."""

    def response(self, u: Array, law: NeoHookean) -> Response:
        """See Solid."""
        return _LinearResponse(law, self.deformation_gradients(u))


def linearised(body: ConstrainedSolid, integration_order: int) -> ConstrainedSolid:
    """The same body at small strain."""
    solid = _LinearSolid(body.solid.mesh, body.solid.basis.elem, integration_order=integration_order)
    return ConstrainedSolid(solid, body.constrained)


# -- the block ----------------------------------------------------------------------------------------------


class _WeightyPotential(IncrementalPotential):
    """With a dead load over all degrees of freedom."""

    load: Array

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """See IncrementalPotential."""
        energy, force = super().energy_and_force(x)
        if not np.isfinite(energy):
            return energy, force
        return energy - float(self.load @ self.expand(x)), force - self.load[self.assembler.free]


class _RubbedPotential(IncrementalPotential):
    """With Coulomb friction between the block and the circle.

    The normal force is that at the step's beginning, so the friction has a potential: mu N |slip|, made smooth
    where a point slips by less than `STICKING`.
    """

    STICKING = 0.03  # [mm]
    coefficient: float
    dynamics: ImplicitDynamics

    def begin_step(self, time: float, prescribed: Array, predicted: Array, mass_factor: float) -> None:
        """See IncrementalPotential."""
        super().begin_step(time, prescribed, predicted, mass_factor)
        self._normal_force: Array | None = None
        if not hasattr(self, "dynamics"):  # it is being made
            return
        assert self.contact is not None
        disc, before = self.contact.obstacles[0], self.dynamics.time
        assert isinstance(disc, Disc)
        boundary = self.contact.boundary
        self._start = boundary.positions(self.dynamics.displacement)
        points = self._start.reshape(-1, 2)
        depth = np.maximum(disc.depth(points, before), 0)
        self._normal_force = self.coefficient * self.contact.penalty * depth * boundary.weights.ravel()
        normal, _ = disc.normal(points, before)
        self._tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
        self._carried = disc.centre(time) - disc.centre(before)

    def _slip(self, x: Array) -> Array:
        assert self.contact is not None
        moved = (self.contact.boundary.positions(self.expand(x)) - self._start).reshape(-1, 2)
        return np.asarray(((moved - self._carried) * self._tangent).sum(1))

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """See IncrementalPotential."""
        energy, force = super().energy_and_force(x)
        if not np.isfinite(energy) or self._normal_force is None:
            return energy, force
        assert self.contact is not None
        boundary, slip = self.contact.boundary, self._slip(x)
        length = np.hypot(slip, self.STICKING)
        traction = (self._normal_force * slip / length)[:, None] * self._tangent
        nodal = boundary.values_transposed @ traction.reshape(*self._start.shape)
        rubbing = np.bincount(boundary.dofs.ravel(), nodal.ravel(), self.body.solid.dofs)
        energy += float(self._normal_force @ (length - self.STICKING))
        return energy, force + rubbing[self.assembler.free]

    def stiffness(self, x: Array) -> Array:
        """See IncrementalPotential."""
        stiffness = super().stiffness(x)
        if self._normal_force is None:
            return stiffness
        assert self.contact is not None
        boundary, slip = self.contact.boundary, self._slip(x)
        curvature = self._normal_force * self.STICKING**2 / np.hypot(slip, self.STICKING) ** 3
        weighted = (curvature[:, None] * self._tangent)[:, :, None] * self._tangent[:, None, :]
        facets, points, functions = boundary.values.shape
        weighted = weighted.reshape(facets, points, 2, 2)
        blocks = np.einsum("fpa,fpij,fpb->faibj", boundary.values, weighted, boundary.values)
        matrices = np.zeros((len(self.body.solid.element_dofs), *self.body.solid.element_dofs.shape[1:] * 2))
        local = boundary.local_dofs
        where = (boundary.elements[:, None, None], local[:, :, None], local[:, None, :])
        np.add.at(matrices, where, blocks.reshape(facets, 2 * functions, 2 * functions))
        return stiffness + self.assembler.matrix(matrices)


@dataclass(frozen=True)
class AlteredBlock(DeformableBlock):
    """The scene with other physics.

    Attributes:
        alter: what to change once all is prepared.
        weight: acceleration of gravity [mm/s^2].
        friction: Coulomb's coefficient of the circle.
        linear: whether strains count as small.
    """

    alter: Callable[[ImplicitDynamics], None] = field(default=lambda dynamics: None)
    weight: float = 0.0
    friction: float = 0.0
    linear: bool = False

    def prepare(
        self,
        parameters: BlockParameters,
        body: ConstrainedSolid,
        contact_points: BoundaryPoints,
        tolerance: float,
    ) -> tuple[ImplicitDynamics, Disc]:
        """See DeformableBlock."""
        if self.linear:
            body = linearised(body, integration_order=3)
        dynamics, disc = super().prepare(parameters, body, contact_points, tolerance)
        if self.weight or self.friction:
            usual, kind = dynamics.potential, _WeightyPotential if self.weight else _RubbedPotential
            potential = kind(body, usual.law, contact=usual.contact, force_floor=usual.force_floor)
            newton = ModifiedNewton(potential, tolerance=tolerance)
            dynamics = ImplicitDynamics(potential, newton, density=DENSITY, damping=DAMPING)
            if isinstance(potential, _WeightyPotential):
                mass = np.asarray(body.nodal_mass.sum(1)).ravel()
                potential.load = np.outer(mass, [0.0, -DENSITY * self.weight]).ravel()
            else:
                potential.coefficient, potential.dynamics = self.friction, dynamics
        self.alter(dynamics)
        return dynamics, disc


def without_inertia(dynamics: ImplicitDynamics) -> None:
    """Every frame an equilibrium, so without damping too."""
    dynamics.density = dynamics.damping = 0.0


def without_damping(dynamics: ImplicitDynamics) -> None:
    """Inertia alone."""
    dynamics.damping = 0.0


@dataclass(frozen=True)
class Floor:
    """The half-space below a height along the last axis."""

    height: float

    def depth(self, points: Array, time: float) -> Array:
        """See Obstacle."""
        return self.height - points[:, -1]

    def normal(self, points: Array, time: float) -> tuple[Array, Array]:
        """See Obstacle."""
        normal = np.zeros_like(points)
        normal[:, -1] = 1
        return normal, np.zeros(len(points))


def with_ground(dynamics: ImplicitDynamics) -> None:
    """The block's sides may touch the ground on which its base stands."""
    contact = dynamics.potential.contact
    assert contact is not None
    contact.obstacles = (*contact.obstacles, Floor(BASE))


# -- polygons -----------------------------------------------------------------------------------------------


def crosses_itself(polygon: Array) -> bool:
    """Whether two edges of a closed polygon [vertices, 2] that are no neighbours intersect."""
    a, b = polygon, np.roll(polygon, -1, axis=0)

    def side(p: Array, q: Array, r: Array) -> Array:
        return np.sign(
            (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1])
            - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        )

    i, j = np.triu_indices(len(a), 2)
    apart = (side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0) & (
        side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0
    )
    return bool(apart.any())


def block_outline(positions: Array) -> Array:
    """The rim of the recorded lattice [..., 81, 2] as a closed polygon, shape [..., 32, 2]."""
    lattice = np.arange(NODES_PER_SIDE**2).reshape(NODES_PER_SIDE, -1)
    rim = np.concatenate([lattice[0, :-1], lattice[:-1, -1], lattice[-1, :0:-1], lattice[:0:-1, 0]])
    return positions[..., rim, :]


def tissue_outline(positions: Array) -> Array:
    """The rim of the wall's front face [..., 361, 3] as a closed polygon in the plane of the wall."""
    recorded = surface()
    across, y, z = recorded.coordinates.T
    front = np.isclose(y, y.min())
    rim: list[int] = []
    for there, key in (
        (np.isclose(across, 0), z),
        (np.isclose(z, z.max()), across),
        (np.isclose(across, 1), -z),
        (np.isclose(z, 0), -across),
    ):
        side = np.flatnonzero(front & there)
        rim += side[np.argsort(key[side])][:-1].tolist()
    return positions[..., rim, :][..., [0, 2]]


# -- falling bodies -----------------------------------------------------------------------------------------

IMPACT = falling.flight_frames(falling.HEIGHT)  # the first frame after contact
COMPARED = slice(IMPACT + 1, IMPACT + 21)  # from then until 0.2 s after the impact
RINGING = slice(IMPACT + 48, IMPACT + 53)  # about 0.5 s after it


class Fall(NamedTuple):
    """What is compared of a drop.

    Attributes:
        path: of the recorded nodes within `COMPARED` [m], shape [frames, nodes, 3].
        vibration: energy of deformation and of motion relative to a rigid body, mean over `RINGING`, over the
            energy before the impact.
    """

    path: Array
    vibration: float


def fall(
    parameters: FallParameters,
    level: FallFidelity,
    *,
    friction: float = falling.FRICTION,
    viscosity: float = falling.VISCOSITY,
    pushed_apart: bool = False,
) -> Fall:
    """The scene's drop until half a second after the impact, with all nodes looked at.

    Args:
        parameters: the draw.
        level: the discretisation.
        friction: Coulomb's coefficient.
        viscosity: [Pa s].
        pushed_apart: whether to take nodes out of other parts of the body, which self contact would keep out.
    """
    scene = MixedObjects()
    body = scene.body(parameters.object)
    recorded = body.surface_nodes
    with patch.object(falling, "FRICTION", friction), patch.object(falling, "VISCOSITY", viscosity):
        solid, substeps = scene._solid(body, parameters, level)
    (outcome,) = falling.land([solid], parameters.height, RINGING.stop, [substeps])
    if isinstance(outcome, SolverError):
        raise outcome
    motion, _ = outcome
    energies, _ = solid.monitor(motion)
    total, first = energies.sum(1), IMPACT - 1
    ringing = range(RINGING.start - first, RINGING.stop - first)
    vibration = [energies[k, 0] + energies[k, 1] - _rigid_energy(solid, motion, k) for k in ringing]
    compared = motion.positions[COMPARED.start - first : COMPARED.stop - first]
    if pushed_apart:
        compared = np.stack([_apart(x, solid, recorded) for x in compared])
    return Fall(path=compared[:, :recorded], vibration=float(np.mean(vibration) / total[0]))


def _apart(positions: Array, solid: TetrahedralSolid, recorded: int) -> Array:
    """Every surface node that is inside another part moved to that part's nearest surface node, thus far enough."""
    result, rest = positions.copy(), solid.vertices[:recorded]
    for node in np.flatnonzero(falling.self_penetrating(positions, solid, recorded)):
        elsewhere = np.flatnonzero(np.linalg.norm(rest - rest[node], axis=1) > 0.1 * SIZE)
        offsets = positions[elsewhere] - positions[node]
        result[node] += offsets[np.linalg.norm(offsets, axis=1).argmin()]
    return result


def _rigid_energy(solid: TetrahedralSolid, motion: Motion, frame: int) -> float:
    """Kinetic energy [J] of the rigid body that has the same momentum and angular momentum."""
    m, x, v = solid.masses[:, None], motion.positions[frame], motion.velocities[frame]
    total = solid.masses.sum()
    velocity, r = (m * v).sum(0) / total, x - (m * x).sum(0) / total
    spin = (m * np.cross(r, v)).sum(0)
    inertia = np.eye(3) * (m * r * r).sum() - (m * r).T @ r
    return float(total * velocity @ velocity + spin @ np.linalg.solve(inertia, spin)) / 2
