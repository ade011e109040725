"""The tissue scene: meshes, steps, stability, random draws and extremes."""

from dataclasses import replace

import numpy as np
import pytest
from physics_variants import STANDARD_GRAVITY
from sheet_cases import relative_error
from tissue_cases import CASES, DEFAULT, DENSITY, FAST, displacements, draw, march

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.tissue_manipulation import (
    FRAME,
    MATERIALS,
    PATCHES,
    TRANSITIONS,
    TissueFidelity,
    TissueManipulation,
    TissueParameters,
    asymmetry,
)

NAMES = [f"nu {case.poisson_ratio}" for case in CASES]
SCENE = TissueManipulation()
DRAWS = 36
FINE_CELLS = (12, 1, 32)

# --- the mesh ---------------------------------------------------------------------------------------------


def _static(parameters: TissueParameters, cells: tuple[int, int, int], steps: int = 10) -> Array:
    """Displacements in equilibrium after the whole pull, in so many steps, shape [361, 3]."""
    level, stride = TissueFidelity(cells, 1, 1e-5), TRANSITIONS / steps
    return march(parameters, level, transitions=steps, distance=lambda t: stride * t)[-1]


@pytest.mark.parametrize(
    ("case", "allowed"),
    list(zip(CASES, ((0.015, 0.006, 0.006), (0.014, 0.007, 0.007), (0.04, 0.015, 0.015)), strict=True)),
    ids=NAMES,
)
def test_meshes(case: TissueParameters, allowed: tuple[float, ...]) -> None:
    """Relative L2 error after the whole pull, against a mesh that agrees with 12 x 2 x 32 cells to 0.2 %."""
    fine = _static(case, FINE_CELLS)
    meshes = ((6, 1, 8), (6, 1, 16), (6, 2, 16))
    errors = [relative_error(_static(case, cells), fine) for cells in meshes]
    assert (np.array(errors) < allowed).all(), f"errors {errors}"
    assert errors[1] < 0.6 * errors[0], f"twice the rows must pay: {errors}"


# --- steps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_equilibria_do_not_depend_on_the_number_of_steps(case: TissueParameters) -> None:
    """Twice as many steps, or a tenth of them: the same states, up to what Newton's tolerance leaves open."""
    level = replace(DEFAULT, tolerance=1e-6)
    usual = displacements(case, level)
    assert relative_error(displacements(case, replace(level, steps=2)), usual) < 1e-5
    assert relative_error(_static(case, DEFAULT.cells), usual[-1]) < 1e-5


def test_dynamics_are_of_second_order_in_time() -> None:
    """With inertia, which the scene leaves out: tissue so soft that the step resolves its waves, and a gripper
    that starts smoothly."""
    case, frames = replace(CASES[2], youngs_modulus=300.0), 20
    duration = frames * FRAME

    def distance(at: float) -> float:
        return 0.5 * duration * (at / duration) ** 3

    states = {
        steps: march(
            case,
            TissueFidelity((6, 1, 8), steps, 1e-7),
            density=DENSITY,
            distance=distance,
            transitions=frames,
        )
        for steps in (1, 2, 4, 16)
    }
    errors = np.array([np.linalg.norm(states[steps] - states[16]) for steps in (1, 2, 4)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders > 1.85).all(), f"orders {orders}, errors {errors}"


def test_solver_tolerance_does_not_matter() -> None:
    """What Newton leaves open is far less than what the mesh does."""
    for level, allowed in ((DEFAULT, 1e-5), (FAST, 5e-4)):
        tight = displacements(CASES[0], replace(level, tolerance=1e-8))
        assert relative_error(displacements(CASES[0], level), tight) < allowed


# --- stability --------------------------------------------------------------------------------------------


def _amplification(parameters: TissueParameters) -> float:
    """How much further a small force across the wall moves it during the pull than without a pull."""
    level = replace(FAST, tolerance=1e-6)
    sideways = (0.0, 1e-2 * STANDARD_GRAVITY, 0.0)
    pulled, still = (
        march(replace(parameters, speed=speed), level, acceleration=sideways)
        for speed in (parameters.speed, 0.0)
    )
    return float(asymmetry(pulled).max() / asymmetry(still).max())


WORST_PULLS = ((0, 0.0), (PATCHES - 1, 180.0))  # across the wall: they compress one side of it


@pytest.mark.parametrize(("patch", "angle"), WORST_PULLS)
@pytest.mark.parametrize("material", MATERIALS, ids=NAMES)
def test_worst_pulls_are_stable(material: tuple[float, float], patch: int, angle: float) -> None:
    """The equilibrium stays a minimum of energy."""
    assert SCENE.check(SCENE.simulate(TissueParameters(*material, patch=patch, angle=angle))) == []


def test_disturbances_grow_in_pushes_only() -> None:
    """At nu = 0, where they grow most: by a factor of 16 in the worst pull, of 1000 in a push."""
    for patch, angle in WORST_PULLS:
        assert _amplification(TissueParameters(*MATERIALS[1], patch=patch, angle=angle)) < 20
    assert _amplification(TissueParameters(*MATERIALS[1], patch=9, angle=-90.0)) > 300


@pytest.mark.parametrize("material", MATERIALS, ids=NAMES)
def test_pushes_are_rejected(material: tuple[float, float]) -> None:
    """What disturbs the wall would decide where it goes: here it is round-off, so the wall has left its plane."""
    push = TissueParameters(*material, patch=9, angle=-90.0)
    assert any("buckles out of its plane" in problem for problem in SCENE.check(SCENE.simulate(push)))


# --- draws ------------------------------------------------------------------------------------------------


def test_random_draws_are_valid() -> None:
    """None rejected, none bisected, and symmetric to round-off."""
    asymmetries, jacobians = [], []
    for index in range(DRAWS):
        parameters = draw(index)
        trajectory = SCENE.simulate(parameters)
        problems = SCENE.check(trajectory)
        assert not problems, f"{parameters}: {problems}"
        assert trajectory.diagnostics["bisections"] == 0
        scaled = (trajectory.positions - np.array(SCENE.scale_centre)) / SCENE.scale_length
        assert np.abs(scaled).max() <= 1
        asymmetries.append(trajectory.diagnostics["max_asymmetry_mm"])
        jacobians.append(trajectory.diagnostics["min_jacobian"])
    assert max(asymmetries) < 1e-9, f"{max(asymmetries):.1e} mm: the solver amplifies round-off"
    assert min(jacobians) > 0.3


EXTREMES = {
    "nu 0.4999": (0.4999, 30e3, 25.0),
    "nu -0.95": (-0.95, 10e3, 25.0),
    **{f"nu {nu}, a tenth of E": (nu, 0.1 * E, 25.0) for nu, E in MATERIALS},
    **{f"nu {nu}, ten times E": (nu, 10 * E, 25.0) for nu, E in MATERIALS},
    **{f"nu {nu}, twice the pull": (nu, E, 50.0) for nu, E in MATERIALS},
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_are_valid(name: str) -> None:
    """Beyond the scene's range all checks pass, too."""
    nu, E, speed = EXTREMES[name]
    trajectory = SCENE.simulate(TissueParameters(nu, E, patch=2, angle=25.0, speed=speed))
    assert SCENE.check(trajectory) == []
    assert trajectory.diagnostics["bisections"] == 0


@pytest.mark.parametrize(
    ("name", "allowed"),
    [("nu 0.0, twice the pull", 0.015), ("nu 0.49, twice the pull", 0.04), ("nu -0.95", 0.01)],
)
def test_extremes_are_right(name: str, allowed: float) -> None:
    """After the whole pull, against the fine mesh."""
    nu, E, speed = EXTREMES[name]
    parameters = TissueParameters(nu, E, patch=2, angle=25.0, speed=speed)
    coarse, fine = (_static(parameters, cells, steps=20) for cells in (DEFAULT.cells, FINE_CELLS))
    assert relative_error(coarse, fine) < allowed


def test_nearly_incompressible_tissue_does_not_lock() -> None:
    """At nu = 0.4999 the scene's mesh is as good as at 0.49, not worse by a factor of fifty as K is."""
    parameters = TissueParameters(0.4999, 30e3, patch=2, angle=25.0)
    coarse, fine = (_static(parameters, cells, steps=20) for cells in (DEFAULT.cells, (6, 1, 32)))
    assert relative_error(coarse, fine) < 0.02


@pytest.mark.parametrize("material", MATERIALS, ids=NAMES)
def test_the_impossible_is_an_error(material: tuple[float, float]) -> None:
    """A pull to a hundred times the wall's height within one frame: which frame fails, how, and why."""
    pull = TissueParameters(*material, patch=9, angle=-45.0, speed=1e6)
    with pytest.raises(SolverError, match=rf"frame 1 of {TRANSITIONS}: .*bisections.*smallest J"):
        SCENE.simulate(pull, "fast")
