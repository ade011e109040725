"""The scene where it is hardest, on random draws, repeated, and mirrored."""

from dataclasses import replace

import numpy as np
import pytest
from sheet_cases import OPPOSITE, SAME, displacements, displacements_with, relative_error

from m3gn_bench.generators.generate import DATASET_SEED
from m3gn_bench.generators.sheet_deformation import (
    FORCE,
    LOAD_MARGIN,
    MIN_PRINCIPAL_STRAIN,
    NODES_PER_SIDE,
    SIDE,
    YOUNGS_MODULI,
    SheetDeformation,
    SheetParameters,
)
from m3gn_bench.generators.solvers.sparse import Array

Centres = tuple[tuple[float, float], tuple[float, float]]

MIDDLE = SIDE / 2
LOW, HIGH = LOAD_MARGIN, SIDE - LOAD_MARGIN
EXTREMES: dict[str, tuple[Centres, tuple[float, float]]] = {
    "both at the centre": (((MIDDLE, MIDDLE), (MIDDLE, MIDDLE)), SAME),
    "both in a corner": (((LOW, LOW), (LOW, LOW)), SAME),
    "opposite corners": (((LOW, LOW), (HIGH, HIGH)), OPPOSITE),
    "side by side, 5 mm": (((MIDDLE - 2.5, MIDDLE), (MIDDLE + 2.5, MIDDLE)), OPPOSITE),
    "side by side, 20 mm": (((MIDDLE - 10, MIDDLE), (MIDDLE + 10, MIDDLE)), OPPOSITE),
    "side by side in a corner, 20 mm": (((LOW, LOW), (LOW + 20, LOW)), OPPOSITE),
}
SEED = DATASET_SEED + 1
DRAWS = 2 * len(YOUNGS_MODULI)  # every modulus twice

# Symmetries are those of the equilibria, so these are solved well; a path may drift by ten times the tolerance.
WELL_SOLVED = replace(SheetDeformation.fidelities["default"], tolerance=1e-6)
SOLVER_ERROR = 10 * WELL_SOLVED.tolerance


def _draw(index: int) -> SheetParameters:
    return SheetDeformation().sample(np.random.default_rng([SEED, index]), index)


def _assert_valid(parameters: SheetParameters) -> None:
    """Simulated without bisecting an increment, accepted by the scene's own checks, stable material."""
    scene = SheetDeformation()
    trajectory = scene.simulate(parameters)
    problems = scene.check(trajectory)
    assert not problems, f"{parameters}: {problems}"
    assert trajectory.diagnostics["bisections"] == 0, f"{parameters}: Newton needed smaller increments"
    strain = trajectory.diagnostics["min_principal_strain"]
    assert strain > MIN_PRINCIPAL_STRAIN, f"{parameters}: principal strain {strain:.3f}"


@pytest.mark.parametrize("youngs_modulus", [min(YOUNGS_MODULI), max(YOUNGS_MODULI)])
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_draws_are_valid(name: str, youngs_modulus: float) -> None:
    """Coincident forces, forces at the margin, opposite forces side by side: none is rejected."""
    centres, forces = EXTREMES[name]
    _assert_valid(SheetParameters(youngs_modulus=youngs_modulus, centres=centres, forces=forces))


@pytest.mark.parametrize("index", range(DRAWS))
def test_random_draws_are_valid(index: int) -> None:
    """Draws of another seed than the dataset's: none is rejected."""
    _assert_valid(_draw(index))


def test_cancelling_forces_leave_the_sheet_at_rest() -> None:
    """Opposite forces at one place are no load: no motion, not even round-off."""
    cancelling = SheetParameters(youngs_modulus=10.0, centres=((61.3, 83.9), (61.3, 83.9)), forces=OPPOSITE)
    assert not displacements(cancelling).any()


def test_same_parameters_give_the_same_bytes() -> None:
    """Nothing but the parameters enters a trajectory."""
    scene = SheetDeformation()
    parameters = _draw(0)
    first, second = scene.simulate(parameters), scene.simulate(parameters)
    assert first.positions.tobytes() == second.positions.tobytes()
    assert first.content_hash() == second.content_hash()


# -- where the default mesh stops being enough ------------------------------------------------------------


def test_local_buckling_on_a_finer_mesh_is_rejected() -> None:
    """The softest sheet with forces near its border: smooth on the default mesh, a snap on the finer one.

    The card states this limit; here both halves of the statement hold, and `check` catches the snap.
    """
    parameters = SheetParameters(
        youngs_modulus=10.0, centres=((22.0, 70.0), (110.0, 118.0)), forces=(FORCE, FORCE)
    )
    scene = SheetDeformation()
    assert scene.check(scene.simulate(parameters, "default")) == []
    problems = scene.check(scene.simulate(parameters, "reference"))
    assert any("the sheet snaps" in problem for problem in problems), problems
    frame = 46  # the snap comes two increments later
    coarse, fine = (displacements(parameters, fidelity)[frame] for fidelity in ("default", "reference"))
    error = relative_error(coarse, fine)
    assert error < 0.005, f"{error:.2%} before the snap"


# -- symmetries of the physics ---------------------------------------------------------------------------


def _asymmetric(youngs_modulus: float) -> SheetParameters:
    return SheetParameters(
        youngs_modulus=youngs_modulus, centres=((43.7, 61.2), (95.1, 85.3)), forces=OPPOSITE
    )


def _as_grid(parameters: SheetParameters) -> Array:
    """Displacements on the recorded grid, shape [frames, y, x, 3]."""
    return displacements_with(parameters, WELL_SOLVED).reshape(-1, NODES_PER_SIDE, NODES_PER_SIDE, 3)


@pytest.mark.parametrize("youngs_modulus", [10.0, 1000.0])
def test_mirrored_forces_mirror_the_displacement(youngs_modulus: float) -> None:
    """In the plane x = side/2 and in the diagonal x = y, up to the solver's tolerance."""
    parameters = _asymmetric(youngs_modulus)
    (x0, y0), (x1, y1) = parameters.centres
    original = _as_grid(parameters)

    mirrored = _as_grid(
        SheetParameters(youngs_modulus, centres=((SIDE - x0, y0), (SIDE - x1, y1)), forces=parameters.forces)
    )
    error = relative_error(mirrored[:, :, ::-1] * (-1, 1, 1), original)
    assert error < SOLVER_ERROR, f"mirrored in x: off by {error:.1e}"

    transposed = _as_grid(
        SheetParameters(youngs_modulus, centres=((y0, x0), (y1, x1)), forces=parameters.forces)
    )
    error = relative_error(transposed.swapaxes(1, 2)[..., [1, 0, 2]], original)
    assert error < SOLVER_ERROR, f"mirrored in the diagonal: off by {error:.1e}"


@pytest.mark.parametrize("youngs_modulus", [10.0, 1000.0])
def test_reversed_forces_reverse_the_deflection(youngs_modulus: float) -> None:
    """w changes its sign and nothing else changes, to the bit: rounding knows no sign."""
    parameters = _asymmetric(youngs_modulus)
    first, second = parameters.forces
    reverse = SheetParameters(youngs_modulus, centres=parameters.centres, forces=(-first, -second))
    assert np.array_equal(displacements(reverse) * (1, 1, -1), displacements(parameters))
