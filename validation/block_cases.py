"""Discs pressed into blocks, on any mesh and element; the runs that several checks share."""

from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from skfem import ElementQuadS2, MeshQuad

from m3gn_bench.datasets.schema import Fidelity
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.generators.deformable_block import (
    BASE,
    CELL_ORDER,
    DAMPING,
    DENSITY,
    FACET_ORDER,
    FRAME,
    HEIGHT,
    POISSON_RATIOS,
    TRAPEZOIDS,
    YOUNGS_MODULUS,
    BlockParameters,
    DeformableBlock,
    make_block,
)
from m3gn_bench.generators.solvers.contact import BoundaryPoints, Disc, PenaltyContact
from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Setting, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array

SEED = 77  # not the dataset's


@lru_cache(maxsize=256)
def simulated(
    parameters: BlockParameters, fidelity: Fidelity = "default", plane: str = "stress"
) -> Trajectory:
    """A run of the scene."""
    return DeformableBlock(plane=plane).simulate(parameters, fidelity)  # type: ignore[arg-type]


def draw(index: int) -> BlockParameters:
    """Random parameters, in the scene's cycle of trapezoids and ratios."""
    return DeformableBlock().sample(np.random.default_rng([SEED, index]), index)


def displacements(trajectory: Trajectory) -> Array:
    """Of the recorded nodes of any scene, shape [frames, nodes, dim]."""
    return trajectory.positions.astype(np.float64) - trajectory.mesh.rest_positions


def draws_with(poisson_ratio: float, count: int) -> list[BlockParameters]:
    """Random parameters whose second ratio is this one, each with another trapezoid (of which there are nine)."""
    cycle = [draw(index) for index in range(len(TRAPEZOIDS) * len(POISSON_RATIOS))]
    return [parameters for parameters in cycle if parameters.poisson_ratios[1] == poisson_ratio][:count]


# -- a flat punch, without contact ------------------------------------------------------------------------


def punch(
    mesh_class: Any, element: object, cells: int, integration_order: int
) -> tuple[ConstrainedSolid, NDArray[np.bool_]]:
    """A square of side 200 whose base is clamped, and the middle half of whose top is held by a flat punch.

    Args:
        mesh_class: one of scikit-fem's.
        element: for that mesh.
        cells: per side, a multiple of eight.
        integration_order: of the cells.

    Returns:
        The body; which of its constrained degrees of freedom the punch moves down, shape [constrained].
    """
    ticks = np.linspace(0, 1, cells + 1)
    square = mesh_class.init_tensor(ticks, ticks)
    mesh = mesh_class((square.p - [[0.5], [0]]) * HEIGHT + [[0], [BASE]], square.t)
    solid = Solid(mesh, element, integration_order=integration_order)
    x, y = solid.nodes.T
    base = y < BASE + 1e-6
    held = (y > BASE + HEIGHT - 1e-6) & (np.abs(x) < HEIGHT / 4 + 1e-6)
    body = ConstrainedSolid(solid, solid.dofs_of(np.flatnonzero(base | held)))
    return body, np.isin(body.constrained, 2 * np.flatnonzero(held) + 1)


def punched(body: ConstrainedSolid, moves: NDArray[np.bool_], law: NeoHookean) -> Array:
    """Displacements on a 9 x 9 lattice of that square when the punch has gone down by 40; no inertia, E = 1."""
    potential = IncrementalPotential(body, law, force_floor=1e-8)
    dynamics = ImplicitDynamics(
        potential,
        ModifiedNewton(potential, tolerance=1e-8),
        density=0.0,
        prescribed=lambda time: np.where(moves, -time, 0.0),
    )
    dynamics.advance(40.0, 8, "punching")
    steps = np.linspace(0, 1, 9)
    points = np.array([((a - 0.5) * HEIGHT, BASE + b * HEIGHT) for b in steps for a in steps])
    nodes = np.linalg.norm(body.solid.nodes - points[:, None], axis=-1).argmin(1)
    return cast(Array, dynamics.displacement.reshape(-1, 2)[nodes])


def hammered(law: NeoHookean, steps: int) -> Array:
    """The scene's square block after its top has been pushed down by 20 mm and back within ten frames, and two
    more frames: displacement of all degrees of freedom. Smooth in time, no contact; `steps` per frame."""
    body, moves = punch(MeshQuad, ElementQuadS2(), 8, CELL_ORDER)
    potential = IncrementalPotential(body, law, force_floor=1e-6 * YOUNGS_MODULUS * HEIGHT)

    def push(time: float) -> Array:
        return np.where(moves, -20 * np.sin(np.pi * min(time / (10 * FRAME), 1.0)) ** 4, 0.0)

    newton = ModifiedNewton(potential, tolerance=1e-9)
    dynamics = ImplicitDynamics(potential, newton, density=DENSITY, damping=DAMPING, prescribed=push)
    dynamics.advance(12 * FRAME, 12 * steps, "hammering")
    return dynamics.displacement


def pressed_by_circle(parameters: BlockParameters, steps: int) -> Array:
    """Displacement of all degrees of freedom of the scene's block after frame 24 of the first material; `steps`
    per frame from frame 12 on, eight before that."""
    block = make_block(parameters.widths, 8)
    dynamics, _ = DeformableBlock().prepare(parameters, block.body, block.contact_points, 1e-8)
    dynamics.advance(12 * FRAME, 12 * 8, "before")
    dynamics.advance(24 * FRAME, 12 * steps, "measured")
    return dynamics.displacement


# -- a disc on a half-space -------------------------------------------------------------------------------


def press_half_space(poisson_ratio: float, setting: Setting) -> tuple[float, float, Array, Array]:
    """A disc of radius 50 pressed into a block 120 wide and 60 deep, to a contact of half-width about 1.3.

    E is 1. Cells are 0.2 wide under the contact and grow by a quarter from one to the next outside it; the
    penalty is as stiff, relative to the contact's width, as the scene's is under a contact 80 mm wide.

    Returns:
        Radius; force on the disc; x of the contact points, and the pressure there.
    """
    radius, cell, core = 50.0, 0.2, 2.0
    ticks, size = list(np.arange(0, core, cell)), cell
    while ticks[-1] < 60:
        ticks.append(ticks[-1] + size)
        size *= 1.25
    half = np.array(ticks)
    mesh = MeshQuad.init_tensor(np.unique([-half, half]), np.unique(-half))
    solid = Solid(mesh, ElementQuadS2(), integration_order=3)
    bottom = solid.nodes[:, 1] < -half[-1] + 1e-9
    body = ConstrainedSolid(solid, solid.dofs_of(np.flatnonzero(bottom)))
    facets = mesh.boundary_facets()
    middles = mesh.p[:, mesh.facets[:, facets]].mean(1)
    facets = facets[(middles[1] > -1e-9) & (np.abs(middles[0]) < 2 * core)]
    disc = Disc(radius=radius, start=(0.0, radius), velocity=(0.0, -1.0))
    penalty = 300.0
    contact = PenaltyContact(BoundaryPoints(solid, facets, FACET_ORDER), penalty=penalty, obstacles=[disc])
    law = NeoHookean.from_youngs_modulus(1.0, poisson_ratio, setting)
    potential = IncrementalPotential(body, law, contact=contact, force_floor=1e-12)
    dynamics = ImplicitDynamics(potential, ModifiedNewton(potential, tolerance=1e-8), density=0.0)
    dynamics.advance(0.0858, 5, "pressing")
    points = contact.boundary.positions(dynamics.displacement).reshape(-1, 2)
    pressure = penalty * np.maximum(disc.depth(points, dynamics.time), 0)
    return radius, float(dynamics.contact_forces[0, 1]), points[:, 0], pressure
