"""The tissue at rest under a pull against CalculiX, another finite-element code.

CalculiX gets the same twenty-node hexahedra with full integration (C3D20), so that what differs is the code
and the volumetric law: its neo-Hookean energy is mu/2 (I1 J^(-2/3) - 3) + K/2 (J - 1)^2, and that agrees with
the benchmark's K/8 (J^2 + J^-2 - 2) to second order in J - 1. At nu = 0.49 volume hardly changes and the
whole pull can be compared. The two other materials are compared where strains are small, and there the
difference must shrink in proportion to the pull, as that of the two laws does.
"""

from pathlib import Path

import numpy as np
import pytest
from calculix import final_displacements, needs_calculix, run_calculix
from sheet_cases import relative_error
from tissue_cases import CASES

from m3gn_bench.generators.solvers.dynamics import ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.tissue_manipulation import Slab, TissueParameters, make_slab

CELLS = (6, 1, 16)

# Nodes of a C3D20 in CalculiX's order, on the cube [-1, 1]^3: corners, then edges below, above and upright.
_CORNERS = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
_EDGES = [(0, -1), (1, 0), (0, 1), (-1, 0)]
C3D20 = np.array(
    [(*c, -1) for c in _CORNERS]
    + [(*c, 1) for c in _CORNERS]
    + [(*e, -1) for e in _EDGES]
    + [(*e, 1) for e in _EDGES]
    + [(*c, 0) for c in _CORNERS]
)

pytestmark = needs_calculix


def _ours(parameters: TissueParameters, distance: float) -> tuple[Slab, Array, Array]:
    """The slab, its displacements [nodes, 3] in equilibrium and the gripper's force [uN]."""
    slab = make_slab(parameters.patch, CELLS)
    law = NeoHookean.from_youngs_modulus(parameters.youngs_modulus, parameters.poisson_ratio, "3d")
    potential = IncrementalPotential(slab.body, law, force_floor=1e-9 * parameters.youngs_modulus)
    dynamics = ImplicitDynamics(
        potential,
        ModifiedNewton(potential, tolerance=1e-9),
        density=0.0,
        prescribed=lambda load: slab.prescribed(load * distance * parameters.direction),
    )
    dynamics.advance(1.0, 25, "the pull")
    return slab, dynamics.displacement.reshape(-1, 3), slab.gripper_force(potential.reaction)


def _elements(slab: Slab) -> Array:
    """Nodes of every hexahedron in CalculiX's order, shape [elements, 20]."""
    solid = slab.body.solid
    elements = []
    for nodes in solid.element_nodes:
        x, y, z = solid.nodes[nodes].T
        local = np.empty((20, 3))
        local[:, 1] = np.sign(np.round(y - 0.5 * (y.min() + y.max()), 9))
        local[:, 2] = np.sign(np.round(z - 0.5 * (z.min() + z.max()), 9))
        for level in (-1, 0, 1):  # the outline bends: left and right are those of a height
            there = local[:, 2] == level
            middle = 0.5 * (x[there].min() + x[there].max())
            local[there, 0] = np.sign(np.round(x[there] - middle, 9))
        matches = (local[None] == C3D20[:, None]).all(-1)
        assert (matches.sum(1) == 1).all()
        elements.append(nodes[matches.argmax(1)])
    return np.array(elements)


def _deck(slab: Slab, parameters: TissueParameters, distance: float) -> str:
    """The input file."""
    solid = slab.body.solid
    law = NeoHookean.from_youngs_modulus(parameters.youngs_modulus, parameters.poisson_ratio, "3d")
    held = np.unique(slab.body.constrained[slab.gripped] // 3) + 1
    foot = np.setdiff1d(slab.body.constrained // 3, held - 1) + 1
    dx, _, dz = distance * parameters.direction
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{n}, {x:.12g}, {y:.12g}, {z:.12g}" for n, (x, y, z) in enumerate(solid.nodes, start=1)]
    lines += ["*ELEMENT, TYPE=C3D20, ELSET=TISSUE"]
    for element, nodes in enumerate(_elements(slab) + 1, start=1):
        numbers = [str(n) for n in (element, *nodes)]
        lines += [", ".join(numbers[:11]) + ",", ", ".join(numbers[11:])]
    lines += ["*NSET, NSET=FOOT", *(str(n) for n in foot), "*NSET, NSET=GRIPPER", *(str(n) for n in held)]
    lines += ["*MATERIAL, NAME=TISSUE", "*HYPERELASTIC, NEO HOOKE"]
    lines += [f"{law.shear_modulus / 2:.12g}, {2 / law.bulk_modulus:.12g}"]
    lines += ["*SOLID SECTION, ELSET=TISSUE, MATERIAL=TISSUE", "*BOUNDARY", "FOOT, 1, 3"]
    lines += ["*STEP, NLGEOM, INC=200", "*STATIC", "0.1, 1, 1e-5, 0.2", "*BOUNDARY"]
    lines += [f"GRIPPER, 1, 1, {dx:.12g}", "GRIPPER, 2, 2, 0", f"GRIPPER, 3, 3, {dz:.12g}"]
    lines += ["*NODE PRINT, NSET=ALL, FREQUENCY=1000", "U"]
    lines += ["*NODE PRINT, NSET=GRIPPER, FREQUENCY=1000, TOTALS=ONLY", "RF", "*END STEP", ""]
    return "\n".join(lines)


def _theirs(results: str, nodes: int) -> tuple[Array, Array]:
    """Displacements [nodes, 3] at the end of the step, and the total force on the gripper's nodes."""
    force = results[results.rindex("total force") :].splitlines()[2].split()
    return final_displacements(results, nodes), np.array(force, dtype=float)


def _differences(folder: Path, case: int, distance: float) -> tuple[float, float]:
    """Relative differences of the displacements of all nodes (L2) and of the gripper's force."""
    parameters = CASES[case]
    slab, ours, force = _ours(parameters, distance)
    theirs, their_force = _theirs(run_calculix(folder, _deck(slab, parameters, distance)), len(ours))
    return relative_error(ours, theirs), relative_error(force, their_force)


def test_whole_pull_of_nearly_incompressible_tissue(tmp_path: Path) -> None:
    """25 mm, nu = 0.49."""
    displacement, force = _differences(tmp_path, 2, 25.0)
    assert displacement < 1e-3, f"displacements are off by {displacement:.2%}"
    assert force < 2e-3, f"the gripper's force is off by {force:.2%}"


@pytest.mark.parametrize(("case", "distance"), [(0, 0.2), (1, 1.0)], ids=["nu -0.9", "nu 0"])
def test_small_pulls_of_compressible_tissue(tmp_path: Path, case: int, distance: float) -> None:
    """Within 1 %, and half the pull halves the difference."""
    far = _differences(tmp_path, case, distance)
    near = _differences(tmp_path, case, distance / 2)
    assert max(far) < 0.01, f"displacements and force are off by {far}"
    assert near == pytest.approx((far[0] / 2, far[1] / 2), rel=0.1)
