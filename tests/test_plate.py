"""The plate and its solver, quickly; `validation/` goes deeper."""

import numpy as np
import pytest
from matrices import dense

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.quasistatic import load_path


def make_plate(nodes: int = 5, thickness: float = 0.05) -> ClampedPlate:
    return ClampedPlate(
        ticks=np.linspace(0, 1, nodes), thickness=thickness, youngs_modulus=10.0, poisson_ratio=0.3
    )


def test_force_and_stiffness_are_derivatives_of_the_energy() -> None:
    plate = make_plate(4)
    rng = np.random.default_rng(0)
    state = 0.02 * rng.standard_normal(plate.assembler.unknowns)
    direction = rng.standard_normal(len(state))
    step = 1e-6

    def energy(x: np.ndarray) -> float:
        return plate.energy_and_force(x)[0]

    def force(x: np.ndarray) -> np.ndarray:
        return plate.energy_and_force(x)[1]

    slope = (energy(state + step * direction) - energy(state - step * direction)) / (2 * step)
    assert slope == pytest.approx(force(state) @ direction, rel=1e-7)
    change = (force(state + step * direction) - force(state - step * direction)) / (2 * step)
    stiffness = dense(plate.assembler, plate.stiffness(state))
    assert np.abs(stiffness @ direction - change).max() < 1e-7 * np.abs(change).max()


def test_factorisation_solves() -> None:
    plate = make_plate(4)
    matrix = plate.stiffness(np.zeros(plate.assembler.unknowns))
    right = np.random.default_rng(0).standard_normal(plate.assembler.unknowns)
    solution = plate.assembler.factorise(matrix).solve(right)
    assert np.abs(dense(plate.assembler, matrix) @ solution - right).max() < 1e-9


def test_indefinite_matrices_are_shifted_and_counted() -> None:
    plate = make_plate(4)
    matrix = plate.stiffness(np.zeros(plate.assembler.unknowns))
    _, shifts = plate.assembler.factorise_shifted(matrix)
    assert shifts == 0
    matrix[0, :3] *= -1
    _, shifts = plate.assembler.factorise_shifted(matrix)
    assert shifts > 0


def test_central_load_of_a_clamped_plate() -> None:
    """w = 0.00560 P a^2 / D (Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells)."""
    plate = make_plate(9, thickness=0.01)
    free = plate.assembler.free
    factor = plate.assembler.factorise(plate.stiffness(np.zeros(len(free))))
    probe = plate.point_load((0.5, 0.5), (0.0, 0.0, 1.0))[free]
    assert probe @ factor.solve(probe) * plate.bending_stiffness == pytest.approx(0.00560, rel=0.01)


def test_loads_have_the_given_resultant() -> None:
    plate = make_plate(9)
    for load in (
        plate.disc_load((0.3, 0.62), 0.1, (1.0, 2.0, 3.0)),
        plate.point_load((0.31, 0.7), (1.0, 2.0, 3.0)),
    ):
        assert plate.nodal_values(load).sum(0) == pytest.approx([1.0, 2.0, 3.0])
    assert plate.nodal_values(plate.uniform_load(2.0)).sum(0) == pytest.approx([0.0, 0.0, 2.0])


def test_load_path_is_path_independent() -> None:
    plate = make_plate(7)
    load = plate.disc_load((0.4, 0.6), 0.2, (0.0, 0.0, 0.05))[plate.assembler.free]
    coarse, fine = (load_path(ModifiedNewton(plate, tolerance=1e-9), load, n) for n in (5, 20))
    assert np.linalg.norm(coarse - fine[::4]) < 1e-6 * np.linalg.norm(coarse)


def test_a_lost_path_is_bisected_and_then_loud() -> None:
    """An impossible tolerance is never reached: the error names frame and residual."""
    plate = make_plate(5)
    load = plate.disc_load((0.5, 0.5), 0.3, (0.0, 0.0, 0.01))[plate.assembler.free]
    newton = ModifiedNewton(plate, tolerance=1e-30, max_iterations=3)
    with pytest.raises(SolverError, match=r"frame 1 of 2.*residual"):
        load_path(newton, load, 2)
    assert newton.statistics.bisections == 8


def test_bisection_rescues_a_large_increment() -> None:
    """With few iterations allowed a single huge increment fails at first and then succeeds in halves."""
    plate = make_plate(5)
    load = plate.disc_load((0.5, 0.5), 0.3, (0.0, 0.0, 0.5))[plate.assembler.free]
    newton = ModifiedNewton(plate, tolerance=1e-8, max_iterations=8)
    state = load_path(newton, load, 1)[-1]
    assert newton.statistics.bisections > 0
    reference = load_path(ModifiedNewton(plate, tolerance=1e-8), load, 20)[-1]
    assert np.linalg.norm(state - reference) < 1e-6 * np.linalg.norm(reference)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"youngs_modulus": 0.0}, "youngs_modulus"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"ticks": np.array([0.0, 0.5, 0.5, 1.0])}, "ticks"),
    ],
)
def test_bad_parameters_are_refused(change: dict[str, object], message: str) -> None:
    good = {"ticks": np.linspace(0, 1, 5), "thickness": 0.1, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
    with pytest.raises(ValueError, match=message):
        ClampedPlate(**{**good, **change})  # type: ignore[arg-type]


def test_a_load_beyond_the_border_is_refused() -> None:
    with pytest.raises(ValueError, match="leaves the plate"):
        make_plate().disc_load((0.05, 0.5), 0.1, (0.0, 0.0, 1.0))
