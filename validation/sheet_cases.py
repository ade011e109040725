"""What the checks of the sheet share: a load case, solutions on any mesh, error norms."""

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from m3gn_bench.datasets.schema import Fidelity
from m3gn_bench.generators.sheet_deformation import (
    FORCE,
    LOAD_RADIUS,
    NODES_PER_SIDE,
    SIDE,
    SheetDeformation,
    SheetFidelity,
    SheetParameters,
)
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.quasistatic import load_path
from m3gn_bench.generators.solvers.sparse import Array

CENTRES = ((50.0, 60.0), (95.0, 85.0))  # [mm], one on a node and one amid a cell, with no symmetry
SAME = (-FORCE, -FORCE)
OPPOSITE = (FORCE, -FORCE)


def case(youngs_modulus: float, forces: tuple[float, float]) -> SheetParameters:
    """Both forces at `CENTRES`."""
    return SheetParameters(youngs_modulus=youngs_modulus, centres=CENTRES, forces=forces)


def displacements(parameters: SheetParameters, fidelity: Fidelity = "default") -> Array:
    """Displacements [mm] of the recorded nodes as the scene writes them, shape [frames, nodes, 3]."""
    return displacements_with(parameters, SheetDeformation.fidelities[fidelity])


@lru_cache
def displacements_with(parameters: SheetParameters, level: SheetFidelity) -> Array:
    """The same with a discretisation of one's own."""
    trajectory = SheetDeformation().simulate_with(parameters, level)
    return trajectory.positions.astype(np.float64) - trajectory.mesh.rest_positions


def equilibria(
    parameters: SheetParameters, *, refinement: int, tolerance: float, increments: int
) -> tuple[ClampedPlate, Array, Array]:
    """The scene's plate, its full load and its states, with a mesh and a tolerance of one's own.

    Load and states are over the free unknowns, of shapes [unknowns] and [increments + 1, unknowns].
    """
    plate = SheetDeformation().plate(parameters.youngs_modulus, refinement)
    load = np.zeros(plate.dofs)
    for centre, force in zip(parameters.centres, parameters.forces, strict=True):
        load += plate.disc_load(centre, LOAD_RADIUS, (0.0, 0.0, force))
    load = load[plate.assembler.free]
    return plate, load, load_path(ModifiedNewton(plate, tolerance=tolerance), load, increments)


def at_recorded_nodes(points: Array, values: Array) -> Array:
    """Pick from `values` [..., points, 3] those at the recorded nodes, row by row in y, as the scene does.

    Args:
        points: where the values are [mm], shape [points, 2]; every recorded node must be among them.
        values: one vector per point.
    """
    ticks = np.linspace(0, SIDE, NODES_PER_SIDE)
    recorded = np.array([(x, y) for y in ticks for x in ticks])
    distance, index = cKDTree(points).query(recorded)
    assert distance.max() < 1e-6, f"a recorded node is {distance.max():.1e} mm from the nearest point"
    return values[..., index, :]


def relative_error(values: Array, reference: Array) -> float:
    """Relative L2 difference over all nodes (and frames)."""
    return float(np.linalg.norm(values - reference) / np.linalg.norm(reference))


def worst_frame_error(values: Array, reference: Array) -> float:
    """Largest relative L2 difference of any single frame; frame 0 does not move."""
    return max(relative_error(a, b) for a, b in zip(values[1:], reference[1:], strict=True))
