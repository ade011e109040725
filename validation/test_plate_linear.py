"""The unloaded plate's stiffness against handbook coefficients of the clamped square plate."""

import numpy as np
import pytest
from skfem import Basis, BilinearForm

from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.sparse import Array

SIDE = 140.0
CENTRE = (SIDE / 2, SIDE / 2)

# Timoshenko & Woinowsky-Krieger, Theory of Plates and Shells, 2nd ed., section 44, tables 37 and 35.
POINT_LOAD_COEFFICIENT = 0.00560  # w D / (P a^2) at the centre, under a central force P
UNIFORM_LOAD_COEFFICIENT = 0.00126  # w D / (q a^4) at the centre, under a pressure q

# Converged Ritz value of omega a^2 sqrt(rho h / D). Leissa, J. Sound Vib. 31 (1973), prints the upper bound
# 35.992 that 36 beam functions give.
FREQUENCY_COEFFICIENT = 35.985

# A plate that locks in shear is orders of magnitude too stiff at the second, and right at the first.
THICKNESSES = (SIDE / 100, SIDE / 10_000)


def _plate(nodes_per_side: int, thickness: float = SIDE / 100) -> ClampedPlate:
    return ClampedPlate(
        ticks=np.linspace(0, SIDE, nodes_per_side),
        thickness=thickness,
        youngs_modulus=100.0,
        poisson_ratio=0.3,
    )


def _linear_solution(plate: ClampedPlate, load: Array) -> Array:
    """Answer of the unloaded plate's stiffness to a load, both over the free unknowns."""
    return plate.assembler.factorise(plate.stiffness(np.zeros(plate.assembler.unknowns))).solve(load)


def _unit_centre_force(plate: ClampedPlate) -> Array:
    """A unit force at the centre; times a state, it gives the centre's deflection too."""
    return plate.point_load(CENTRE, (0.0, 0.0, 1.0))[plate.assembler.free]


@pytest.mark.parametrize("thickness", THICKNESSES)
def test_central_force(thickness: float) -> None:
    """The deflection under a central force is Timoshenko's within 0.5 %, however thin the plate."""
    plate = _plate(15, thickness)
    force = _unit_centre_force(plate)
    deflection = float(force @ _linear_solution(plate, force))
    coefficient = deflection * plate.bending_stiffness / SIDE**2
    assert coefficient == pytest.approx(POINT_LOAD_COEFFICIENT, rel=0.005), (
        f"w D / (P a^2) = {coefficient:.6f}"
    )


@pytest.mark.parametrize("thickness", THICKNESSES)
def test_uniform_load(thickness: float) -> None:
    """The centre's deflection under pressure is Timoshenko's within 1 %, however thin the plate."""
    plate = _plate(15, thickness)
    solution = _linear_solution(plate, plate.uniform_load(1.0)[plate.assembler.free])
    coefficient = float(_unit_centre_force(plate) @ solution) * plate.bending_stiffness / SIDE**4
    assert coefficient == pytest.approx(UNIFORM_LOAD_COEFFICIENT, rel=0.01), (
        f"w D / (q a^4) = {coefficient:.6f}"
    )


def _work_of_pressure(nodes_per_side: int) -> float:
    """Work of a unit pressure, twice the stored energy."""
    plate = _plate(nodes_per_side)
    load = plate.uniform_load(1.0)[plate.assembler.free]
    return float(load @ _linear_solution(plate, load))


def test_energy_converges_with_fourth_order() -> None:
    """Halving the cells divides the energy's error by 16: bicubics make it h^(2 (3 + 1 - 2)).

    Strang & Fix, An Analysis of the Finite Element Method, section 3.1: 2 (k - m) with k = 4 and m = 2.
    The clamped plate's solution is smooth enough up to the corners.
    """
    fine = _work_of_pressure(49)
    errors = np.array([abs(_work_of_pressure(nodes) - fine) / fine for nodes in (5, 9, 17)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert orders.min() > 3.5, f"errors {errors}, orders {orders}"


def test_first_frequency() -> None:
    """With a consistent mass matrix (rho h = 1) the lowest frequency is the tabulated one within 0.1 %."""
    plate = _plate(15)
    # The plate's own three Gauss points would under-integrate the product of two bicubics.
    basis = Basis(plate.mesh, plate.basis.elem, intorder=6)
    scalar_mass = BilinearForm(lambda u, v, _: u * v).assemble(basis)
    deflection_of = np.arange(2, plate.dofs, 3)  # the third component of every degree of freedom

    def inertia(x: Array) -> Array:
        load = np.zeros(plate.dofs)
        load[deflection_of] = scalar_mass @ plate.expand(x)[deflection_of]
        return load[plate.assembler.free]

    # Inverse iteration: the second frequency is twice the first, so the error falls by 16 a step.
    factor = plate.assembler.factorise(plate.stiffness(np.zeros(plate.assembler.unknowns)))
    mode = factor.solve(plate.uniform_load(1.0)[plate.assembler.free])
    for _ in range(10):
        force = inertia(mode)
        mode = factor.solve(force)
        squared_frequency = float(mode @ force) / float(mode @ inertia(mode))
    coefficient = np.sqrt(squared_frequency / plate.bending_stiffness) * SIDE**2
    assert coefficient == pytest.approx(FREQUENCY_COEFFICIENT, rel=1e-3), f"coefficient {coefficient:.4f}"
