"""The three-dimensional solid against closed forms, and its order of convergence to a manufactured solution.

The law is written here a second time, from its energy, with numpy's inverse and determinant; nothing of the
benchmark's own stress or tangent enters the expected values.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from skfem import ElementHexS2, MeshHex

from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.tissue_manipulation import CELL_ORDER, MATERIALS

NU = [material[0] for material in MATERIALS]
E = 10.0


def _stress(F: Array, law: NeoHookean) -> Array:
    """First Piola-Kirchhoff stress, d psi / dF of psi = mu/2 (J^(-2/3) tr C - 3) + K/8 (J^2 + J^-2 - 2).

    Shapes [..., 3, 3].
    """
    J = np.linalg.det(F)[..., None, None]
    inverse_transposed = np.linalg.inv(F).swapaxes(-1, -2)
    invariant = np.einsum("...ij,...ij->...", F, F)[..., None, None]
    deviatoric = law.shear_modulus * J ** (-2 / 3) * (F - invariant / 3 * inverse_transposed)
    return np.asarray(deviatoric + law.bulk_modulus / 4 * (J**2 - J**-2) * inverse_transposed)


def _cube(cells: int) -> Solid:
    grid = np.linspace(0, 1, cells + 1)
    return Solid(MeshHex.init_tensor(grid, grid, grid), ElementHexS2(), integration_order=CELL_ORDER)


def _equilibrium(
    solid: Solid, law: NeoHookean, constrained: NDArray[np.integer], exact: Array, load: Array | None = None
) -> Array:
    """Displacements [dofs], prescribed where constrained and found elsewhere from 0.9 of the exact ones."""
    body = ConstrainedSolid(solid, constrained)
    potential = IncrementalPotential(body, law, force_floor=1e-9 * E)
    potential.begin_step(0.0, exact[body.constrained], np.zeros(solid.dofs), 0.0)
    newton = ModifiedNewton(potential, tolerance=1e-11)
    free = body.assembler.free
    return potential.expand(
        newton.minimise(
            0.9 * exact[free], force_scale=potential.force_scale, load=None if load is None else load[free]
        )
    )


@pytest.mark.parametrize("stretch", [0.7, 1.05, 1.5])
@pytest.mark.parametrize("poisson_ratio", NU)
def test_uniaxial_stress(poisson_ratio: float, stretch: float) -> None:
    """A bar between smooth plates: lateral stretch and force are those of the homogeneous solution."""
    law = NeoHookean.from_youngs_modulus(E, poisson_ratio, "3d")

    def lateral_stress(lateral: float) -> float:
        return float(_stress(np.diag([lateral, lateral, stretch]), law)[0, 0])

    lateral = brentq(lateral_stress, 0.4, 2.0, xtol=1e-15, rtol=1e-14)
    force = _stress(np.diag([lateral, lateral, stretch]), law)[2, 2]

    solid = _cube(2)
    nodes = solid.nodes
    top, bottom = nodes[:, 2] > 1 - 1e-9, nodes[:, 2] < 1e-9
    held = np.zeros_like(nodes, dtype=bool)
    held[:, 2] = top | bottom
    held[:, :2] = nodes[:, :2] < 1e-9  # planes of symmetry
    exact = nodes * (lateral - 1, lateral - 1, stretch - 1)
    u = _equilibrium(solid, law, np.flatnonzero(held.ravel()), exact.ravel())
    assert np.abs(u.reshape(-1, 3) - exact).max() < 1e-9
    nodal = np.zeros_like(nodes)
    forces = solid.element_forces(solid.response(u, law)).reshape(*solid.element_nodes.shape, 3)
    np.add.at(nodal, solid.element_nodes, forces)
    assert nodal[top, 2].sum() == pytest.approx(force, rel=1e-9)


@pytest.mark.parametrize("poisson_ratio", NU)
def test_simple_shear(poisson_ratio: float) -> None:
    """Shear by 0.4 prescribed on the whole boundary: tractions on the top are the first column of the stress."""
    law = NeoHookean.from_youngs_modulus(E, poisson_ratio, "3d")
    F = np.eye(3)
    F[0, 2] = 0.4
    solid = _cube(2)
    outside = np.any((solid.nodes < 1e-9) | (solid.nodes > 1 - 1e-9), axis=1)
    constrained = solid.dofs_of(np.flatnonzero(outside))
    exact = (solid.nodes @ (F - np.eye(3)).T).ravel()
    u = _equilibrium(solid, law, constrained, exact)
    assert np.abs(u - exact).max() < 1e-9
    response = solid.response(u, law)
    assert np.abs(response.stress - _stress(F, law)[:, :, None]).max() < 1e-9 * E
    assert response.stress[0, 2, 0] == pytest.approx(0.4 * law.shear_modulus)  # J = 1: mu times the shear


# --- manufactured solution --------------------------------------------------------------------------------


def _exact(X: Array) -> Array:
    """Two large isochoric shears, one after the other, and a little change of volume, shape [..., 3].

    J is 0.85 to 1.13: with more of it, the body force that nu = 0.49 takes makes the equilibrium unstable.
    """
    x, y, z = np.moveaxis(X, -1, 0)
    ux = 0.1 * np.sin(np.pi * y) * np.cos(0.5 * np.pi * z)
    uz = 0.1 * np.sin(np.pi * (x + ux)) * np.cos(0.5 * np.pi * y)
    uy = 0.04 * np.sin(np.pi * (y + 0.5 * x)) * np.cos(np.pi * z)
    return np.stack([ux, uy, uz], axis=-1)


def _derivative(function: Callable[[Array], Array], X: Array, step: float) -> Array:
    """d function / dX by central differences of sixth order, with a last axis for the direction."""
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    columns = []
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        terms = [w * (function(X + k * shift) - function(X - k * shift)) for k, w in weights.items()]
        columns.append(np.sum(terms, axis=0) / step)
    return np.stack(columns, axis=-1)


def _exact_stress(X: Array, law: NeoHookean) -> Array:
    return _stress(np.eye(3) + _derivative(_exact, X, 2e-3), law)


def _body_force(X: Array, law: NeoHookean) -> Array:
    """-Div P, shape [..., 3]."""
    gradient = _derivative(lambda at: _exact_stress(at, law), X, 2e-3)  # ..., i, J, direction
    return -np.einsum("...iJJ->...i", gradient)


def _errors(cells: int, law: NeoHookean) -> tuple[float, float]:
    """Relative L2 errors of displacement and of its gradient."""
    solid = _cube(cells)
    basis = solid.basis
    X = np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)  # element, point, component
    force = _body_force(X, law) * basis.dx[..., None]
    values = np.array([np.broadcast_to(np.asarray(f[0]), basis.dx.shape) for f in basis.basis])
    nodal = np.einsum("aeq,eqi->eai", values, force)
    load = np.zeros((len(solid.nodes), 3))
    np.add.at(load, solid.element_nodes, nodal)

    outside = np.any((solid.nodes < 1e-9) | (solid.nodes > 1 - 1e-9), axis=1)
    constrained = solid.dofs_of(np.flatnonzero(outside))
    u = _equilibrium(solid, law, constrained, _exact(solid.nodes).ravel(), load.ravel())
    found = np.einsum("aeq,eai->eqi", values, u.reshape(-1, 3)[solid.element_nodes])
    exact = _exact(X)
    exact_F = np.eye(3) + _derivative(_exact, X, 2e-3)
    F = np.moveaxis(solid.deformation_gradients(u), -1, 0).reshape(*basis.dx.shape, 3, 3)

    def norm(values: Array) -> float:
        return float(np.sqrt(np.einsum("eq,eq...->...", basis.dx, values**2).sum()))

    return norm(found - exact) / norm(exact), norm(F - exact_F) / norm(exact_F - np.eye(3))


@pytest.mark.parametrize("poisson_ratio", NU)
def test_convergence_to_a_manufactured_solution(poisson_ratio: float) -> None:
    """Serendipity hexahedra: third order in the displacement, second in its gradient."""
    law = NeoHookean.from_youngs_modulus(E, poisson_ratio, "3d")
    errors = np.array([_errors(cells, law) for cells in (2, 4, 8)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders[-1] > (2.8, 1.85)).all(), f"orders {orders}, errors {errors}"
    assert (errors[-1] < (1e-3, 1e-2)).all(), f"errors {errors}"
