"""The sheet at full load against CalculiX: another element, another theory, another code.

CalculiX expands its eight-node shell S8R into a quadratic solid with reduced integration, so it shares
neither Kirchhoff's hypothesis nor the interpolation with the benchmark's plate. Large rotations (NLGEOM),
a static step and the same dead load; its linear elastic law in Green-Lagrange strain is the same law.
"""

from pathlib import Path

import numpy as np
import pytest
from calculix import final_displacements, needs_calculix, run_calculix
from sheet_cases import CENTRES, OPPOSITE, SAME, at_recorded_nodes, case, displacements, relative_error
from skfem import Basis, ElementQuadS2, MeshQuad

from m3gn_bench.generators.sheet_deformation import LOAD_RADIUS, POISSON_RATIO, SIDE, THICKNESS
from m3gn_bench.generators.solvers.sparse import Array

CELLS_PER_SIDE = 28  # two per recorded cell

pytestmark = needs_calculix


def _shell_basis() -> Basis:
    """Eight-node quadrilaterals; 12 x 12 Gauss points because the load's disc ends inside cells."""
    ticks = np.linspace(0, SIDE, CELLS_PER_SIDE + 1)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    x, y = np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2)
    rule = np.array([x.ravel(), y.ravel()]), np.outer(weights, weights).ravel() / 4
    return Basis(MeshQuad.init_tensor(ticks, ticks), ElementQuadS2(), quadrature=rule)


def _nodal_forces(basis: Basis, forces: tuple[float, float]) -> Array:
    """Transverse nodal forces [N], work-conjugate to (1 - r^2/R^2)^2 on each disc, shape [nodes]."""
    x, y = np.asarray(basis.global_coordinates())
    nodal = np.zeros(basis.N)
    for centre, force in zip(CENTRES, forces, strict=True):
        squared = ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / LOAD_RADIUS**2
        density = np.clip(1 - squared, 0, None) ** 2 * basis.dx
        density *= force / density.sum()
        for function, dofs in zip(basis.basis, basis.element_dofs, strict=True):
            np.add.at(nodal, dofs, (np.asarray(function[0]) * density).sum(-1))
    assert nodal.sum() == pytest.approx(sum(forces), abs=1e-9)
    return nodal


def _deck(basis: Basis, youngs_modulus: float, nodal_forces: Array) -> str:
    """The input file. Corners before midsides, both anticlockwise: scikit-fem's order is CalculiX's."""
    x, y = basis.doflocs
    border = np.flatnonzero(np.isclose(np.minimum(x, y), 0) | np.isclose(np.maximum(x, y), SIDE))
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{node}, {x[node - 1]:.12g}, {y[node - 1]:.12g}, 0" for node in range(1, basis.N + 1)]
    lines += ["*ELEMENT, TYPE=S8R, ELSET=SHEET"]
    lines += [
        ", ".join(map(str, [element, *(dofs + 1)]))
        for element, dofs in enumerate(basis.element_dofs.T, start=1)
    ]
    lines += ["*NSET, NSET=BORDER", *(str(node + 1) for node in border)]
    lines += ["*MATERIAL, NAME=ELASTIC", "*ELASTIC", f"{youngs_modulus:.12g}, {POISSON_RATIO:.12g}"]
    lines += ["*SHELL SECTION, ELSET=SHEET, MATERIAL=ELASTIC", f"{THICKNESS:.12g}"]
    lines += ["*BOUNDARY", "BORDER, 1, 6"]
    lines += ["*STEP, NLGEOM, INC=200", "*STATIC", "0.1, 1, 1e-5, 0.25", "*CLOAD"]
    lines += [f"{node + 1}, 3, {nodal_forces[node]:.15g}" for node in np.flatnonzero(nodal_forces)]
    lines += ["*NODE PRINT, NSET=ALL, FREQUENCY=1000", "U", "*END STEP", ""]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("youngs_modulus", "forces"), [(30.0, SAME), (100.0, SAME), (1000.0, SAME), (100.0, OPPOSITE)]
)
def test_full_load(tmp_path: Path, youngs_modulus: float, forces: tuple[float, float]) -> None:
    """At full load the recorded nodes are displaced as in CalculiX, within 2 % (relative L2)."""
    basis = _shell_basis()
    results = run_calculix(tmp_path, _deck(basis, youngs_modulus, _nodal_forces(basis, forces)))
    theirs = at_recorded_nodes(basis.doflocs.T, final_displacements(results, basis.N))
    ours = displacements(case(youngs_modulus, forces))[-1]
    error = relative_error(ours, theirs)
    assert error < 0.02, f"off by {error:.2%}, at most {np.abs(ours - theirs).max():.3f} mm"
