"""Large deflections: exact derivatives, indifference to rotation, convergence in mesh, steps, tolerance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sheet_cases import (
    OPPOSITE,
    SAME,
    at_recorded_nodes,
    case,
    displacements,
    displacements_with,
    equilibria,
    relative_error,
    worst_frame_error,
)

from m3gn_bench.datasets.schema import Fidelity
from m3gn_bench.generators.sheet_deformation import INCREMENTS, SheetDeformation
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.quasistatic import load_path
from m3gn_bench.generators.solvers.sparse import Array

MESH_ERROR = 0.005  # relative L2, what the scene's mesh may be off


# -- derivatives -----------------------------------------------------------------------------------------


def _unit_cell_plate() -> ClampedPlate:
    """Cells of side one: displacements, slopes and twists are of one size, so one random scale fits all."""
    return ClampedPlate(ticks=np.linspace(0, 6, 7), thickness=0.5, youngs_modulus=1.0, poisson_ratio=0.3)


def _rough_dome(plate: ClampedPlate, rng: np.random.Generator) -> Array:
    """Random and large (slopes and membrane strains about one), yet taut enough to be stable."""
    pressure = plate.uniform_load(0.3)[plate.assembler.free]
    dome = load_path(ModifiedNewton(plate, tolerance=1e-6), pressure, 4)[-1]
    return dome + 0.1 * rng.standard_normal(dome.shape)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_force_and_stiffness_are_the_energys_derivatives(seed: int) -> None:
    """Along a random direction, fourth-order differences agree to 1e-9 at a large random deformation.

    The stiffness is used through its factorisation, as Newton uses it: K^-1 d(force) must be the direction.
    """
    rng = np.random.default_rng(seed)
    plate = _unit_cell_plate()
    x = _rough_dome(plate, rng)
    direction = rng.standard_normal(x.shape)
    direction /= np.linalg.norm(direction)
    step = 3e-3
    energy, force = {}, {}
    for k in (-2, -1, 1, 2):
        energy[k], force[k] = plate.energy_and_force(x + k * step * direction)
    energy_slope = (8 * (energy[1] - energy[-1]) - (energy[2] - energy[-2])) / (12 * step)
    force_slope = (8 * (force[1] - force[-1]) - (force[2] - force[-2])) / (12 * step)

    expected = float(plate.energy_and_force(x)[1] @ direction)
    assert energy_slope == pytest.approx(expected, rel=1e-9), f"off by {energy_slope / expected - 1:.1e}"
    newton_step = plate.assembler.factorise(plate.stiffness(x)).solve(force_slope)
    error = relative_error(newton_step, direction)
    assert error < 1e-9, f"K^-1 df misses the direction by {error:.1e}"


# -- rotation --------------------------------------------------------------------------------------------


def _rotate(plate: ClampedPlate, full: Array, nodes: np.ndarray, rotation: Array) -> Array:
    """The degrees of freedom [dofs] after a rigid rotation of the deformed surface at `nodes`."""
    turned = full.reshape(-1, 3).copy()
    value, slope_x, slope_y, twist = plate.basis.nodal_dofs[:, nodes]
    for dofs, rest in ((value, plate.nodes[nodes]), (slope_x, (1, 0, 0)), (slope_y, (0, 1, 0)), (twist, 0)):
        turned[dofs] = (rest + turned[dofs]) @ rotation.T - rest
    return turned.ravel()


@pytest.mark.parametrize("amplitude", [0.0, 0.1])
def test_forces_rotate_with_the_body(amplitude: float) -> None:
    """A superposed rigid rotation of the inside rotates the forces there; without strain there are none.

    The border is clamped, so only forces on nodes that share no cell with it can be compared.
    """
    rng = np.random.default_rng(0)
    plate = _unit_cell_plate()
    rotation = Rotation.from_rotvec([0.9, -0.4, 0.6]).as_matrix()  # 66 degrees
    x, y = plate.mesh.p
    to_border = np.min([x, y, plate.side - x, plate.side - y], axis=0)
    inner = np.flatnonzero(to_border > 0.5)
    deep = np.flatnonzero(to_border > 1.5)

    full = np.zeros((plate.dofs // 3, 3))
    moving = plate.basis.nodal_dofs[:, inner]
    full[moving] = amplitude * rng.standard_normal((*moving.shape, 3))
    turned = _rotate(plate, full.ravel(), inner, rotation)

    dofs = plate.basis.nodal_dofs[:, deep].ravel()
    before, after = (
        plate.expand(plate.energy_and_force(state.ravel()[plate.assembler.free])[1]).reshape(-1, 3)[dofs]
        for state in (full, turned)
    )
    stiffness_scale = plate.youngs_modulus * plate.thickness
    error = np.abs(after - before @ rotation.T).max() / stiffness_scale
    assert error < 1e-11, f"forces differ by {error:.1e} E h"
    assert (np.abs(before).max() > 0.01 * stiffness_scale) == (amplitude > 0)


# -- convergence -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("forces", [SAME, OPPOSITE])
@pytest.mark.parametrize("youngs_modulus", [10.0, 100.0, 1000.0])
def test_scene_mesh_is_fine_enough(youngs_modulus: float, forces: tuple[float, float]) -> None:
    """The scene's mesh against all its cells halved: below 0.5 % at full load, over the path, in any frame."""
    coarse = displacements(case(youngs_modulus, forces), "default")
    fine = displacements(case(youngs_modulus, forces), "reference")
    errors = {
        "full load": relative_error(coarse[-1], fine[-1]),
        "path": relative_error(coarse, fine),
        "worst frame": worst_frame_error(coarse, fine),
    }
    assert max(errors.values()) < MESH_ERROR, f"{errors}"


def test_reference_mesh_at_the_softest_sheet() -> None:
    """At E = 10 MPa a taut sheet bends within 2 mm of its clamp; the extra line of nodes resolves that.

    Against cells of a third: the scene's mesh within 0.5 %, `reference` within 0.1 %.
    """
    parameters = case(10.0, SAME)
    plate, _, states = equilibria(parameters, refinement=3, tolerance=1e-8, increments=2)
    finest = at_recorded_nodes(plate.mesh.p.T, plate.displacements(states[-1]))
    for fidelity, allowed in (("reference", 0.001), ("default", MESH_ERROR)):
        error = relative_error(displacements(parameters, fidelity)[-1], finest)
        assert error < allowed, f"{fidelity} is off by {error:.2%}"


@pytest.mark.parametrize("youngs_modulus", [10.0, 1000.0])
def test_load_increments_leave_no_trace(youngs_modulus: float) -> None:
    """100 increments instead of 50 give the same states, up to what the tolerance leaves undetermined.

    Two states with residuals below tol |f| differ by at most 2 tol |f| / lambda_min(K), to first order.
    """
    tolerance = 1e-6
    parameters = case(youngs_modulus, SAME)
    plate, load, states = equilibria(parameters, refinement=1, tolerance=tolerance, increments=INCREMENTS)
    _, _, halved = equilibria(parameters, refinement=1, tolerance=tolerance, increments=2 * INCREMENTS)
    for k in range(1, INCREMENTS + 1):
        bound = 2 * tolerance * float(np.linalg.norm(load)) / _smallest_eigenvalue(plate, states[k])
        difference = float(np.linalg.norm(states[k] - halved[2 * k]))
        assert difference < bound, (
            f"frame {k}: differ by {difference:.1e}, the tolerance explains {bound:.1e}"
        )
    error = relative_error(plate.displacements(halved[::2]), plate.displacements(states))
    assert error < 1e-5, f"the paths differ by {error:.1e}"


def _smallest_eigenvalue(plate: ClampedPlate, x: Array) -> float:
    """Of the stiffness at x, by inverse iteration from a bending state."""
    factor = plate.assembler.factorise(plate.stiffness(x))
    vector = plate.uniform_load(1.0)[plate.assembler.free]
    for _ in range(20):
        vector = factor.solve(vector / np.linalg.norm(vector))
    return 1 / float(np.linalg.norm(vector))


@pytest.mark.parametrize(("fidelity", "allowed"), [("fast", 1e-3), ("default", 1e-4)])
@pytest.mark.parametrize("youngs_modulus", [10.0, 100.0, 1000.0])
def test_newtons_tolerance_is_small_enough(youngs_modulus: float, fidelity: Fidelity, allowed: float) -> None:
    """`fast` is within 0.1 % of tightly converged states on its mesh, `default` within 0.01 %.

    So what `default` leaves undone is less than half of the smallest error that its mesh makes (0.02 %); a tenth of
    that takes a fifth more time (dataset version 1.0).
    """
    parameters = case(youngs_modulus, SAME)
    tight = displacements_with(parameters, replace(SheetDeformation.fidelities[fidelity], tolerance=1e-9))
    error = relative_error(displacements(parameters, fidelity), tight)
    assert error < allowed, f"{fidelity} is off by {error:.1e}"
