"""Newton's vertex block descent: what its parameters mean, its floor, and that it repeats itself."""

import importlib.util
from typing import Any

import numpy as np
import pytest
from conftest import box_of_tetrahedra
from matrices import stiffness_at_rest
from scipy.spatial.transform import Rotation

from m3gn_bench.generators.errors import GeneratorError, SolverError
from m3gn_bench.generators.solvers.explicit import ExplicitSolid
from m3gn_bench.generators.solvers.vbd import FLOOR_SKIN, VertexBlockDescent

MATERIAL = {"density": 1000.0, "youngs_modulus": 2e5, "poisson_ratio": 0.4}
needs_newton = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="newton is not installed"
)

CUBE = box_of_tetrahedra((0.3, 0.3, 0.3), (2, 2, 2))


def solid(**options: Any) -> VertexBlockDescent:
    """A cube of soft material."""
    return VertexBlockDescent(*CUBE, **{**MATERIAL, "iterations": 10, **options})


@needs_newton
@pytest.mark.parametrize("substeps", [7, 20])
def test_free_fall(substeps: int, capfd: pytest.CaptureFixture[str]) -> None:
    """To what single precision leaves: taken from differences of positions it would be millimetres. In silence."""
    body = solid(viscosity=100.0)
    start = body.vertices + np.array([0.0, 0.0, 0.5])
    velocity = np.tile([0.5, 0.0, -0.1], (body.nodes, 1))
    motion = body.run(start, velocity, frames=30, frame_time=0.01, substeps=substeps)
    times = 0.01 * np.arange(31)[:, None, None]
    expected = start + velocity * times + np.array([0, 0, -9.81 / 2]) * times**2
    assert np.abs(motion.positions - expected).max() < 2e-4
    energies, _ = body.monitor(motion)
    total = energies.sum(1)
    assert np.abs(total / total[0] - 1).max() < 1e-3
    printed = capfd.readouterr()
    assert printed.out + printed.err == ""


@needs_newton
@pytest.mark.parametrize(("axis", "poisson_ratio"), [(0, 0.0), (0, 0.49), (2, 0.0), (2, 0.3), (2, 0.49)])
def test_small_strain_stiffness(axis: int, poisson_ratio: float) -> None:
    """A cube held by one side sags under its weight, sheared (x) or stretched (z), as E and nu say."""
    material = {**MATERIAL, "youngs_modulus": 2e6, "poisson_ratio": poisson_ratio, "floor": False}
    start = CUBE[0]
    held = np.flatnonzero(start[:, axis] == start[:, axis].max())
    exact = _sag(ExplicitSolid(*CUBE, **material, element="linear", fixed=held), held)
    body = VertexBlockDescent(*CUBE, **material, viscosity=3000.0, fixed=held, iterations=40)
    motion = body.run(start, np.zeros_like(start), frames=30, frame_time=0.01, substeps=5)
    sag = motion.positions[-1] - start
    assert np.linalg.norm(sag - exact) < 5e-3 * np.linalg.norm(exact)
    assert np.abs(motion.positions[:, held] - start[held]).max() < 1e-7


def _sag(body: ExplicitSolid, held: np.ndarray) -> np.ndarray:
    """Displacements under gravity [m], of the stiffness matrix at rest, from differences of the force."""
    free = np.setdiff1d(np.arange(3 * body.nodes), (3 * held[:, None] + np.arange(3)).ravel())
    weight = body.masses[:, None] * body.accelerations(body.vertices, np.zeros((body.nodes, 3)))
    sag = np.zeros(3 * body.nodes)
    sag[free] = np.linalg.solve(stiffness_at_rest(body)[np.ix_(free, free)], weight.ravel()[free])
    return sag.reshape(-1, 3)


@needs_newton
def test_viscosity_is_that_of_kelvin_and_voigt() -> None:
    """A heavily damped cube creeps as the explicit solver's does; half or twice the viscosity would be far off."""
    material = {**MATERIAL, "youngs_modulus": 2e4, "viscosity": 3000.0, "floor": False}
    start = CUBE[0]
    held = np.flatnonzero(start[:, 2] == start[:, 2].max())
    explicit = ExplicitSolid(*CUBE, **material, element="linear", fixed=held)
    body = VertexBlockDescent(*CUBE, **material, fixed=held, iterations=40)
    rest = np.zeros_like(start)
    exact = explicit.run(start, rest, frames=10, frame_time=0.01, substeps=explicit.substeps(0.01, 0.5))
    motion = body.run(start, rest, frames=10, frame_time=0.01, substeps=20)
    creep = exact.positions[-1] - start
    assert np.linalg.norm(motion.positions[-1] - exact.positions[-1]) < 0.02 * np.linalg.norm(creep)


@needs_newton
def test_the_floor_holds_and_energy_does_not_grow() -> None:
    body = solid(viscosity=100.0, friction=0.5)
    start = Rotation.from_rotvec([1.0, 0.2, -0.5]).apply(body.vertices)
    start[:, 2] += 0.01 - start[:, 2].min()
    velocity = np.tile([2.0, 0.0, -3.0], (body.nodes, 1))
    motion = body.run(start, velocity, frames=40, frame_time=0.01, substeps=40)
    assert -1e-4 < motion.positions[..., 2].min() < FLOOR_SKIN
    energies, ratios = body.monitor(motion)
    total = energies.sum(1)
    assert np.diff(total).max() < 1e-2 * total[0]
    assert total[-1] < 0.9 * total[0]
    assert ratios[-1].min() > 0.5


@needs_newton
def test_sliding_stops_after_coulombs_distance() -> None:
    body = solid(youngs_modulus=2e6, viscosity=2000.0, friction=0.3)
    velocity = np.tile([1.0, 0.0, 0.0], (body.nodes, 1))
    start = body.vertices + np.array([0.0, 0.0, FLOOR_SKIN])
    motion = body.run(start, velocity, frames=40, frame_time=0.01, substeps=40)
    travelled = (motion.positions[:, :, 0] - start[:, 0]) @ body.masses / body.masses.sum()
    assert travelled[-1] == pytest.approx(1 / (2 * 0.3 * 9.81), rel=0.03)


@needs_newton
def test_the_same_run_is_the_same_bit_for_bit() -> None:
    body = solid(viscosity=100.0, friction=0.5)
    again = solid(viscosity=100.0, friction=0.5)
    velocity = np.tile([0.3, 0.0, -3.0], (body.nodes, 1))
    start = Rotation.from_rotvec([1.0, 0.2, -0.5]).apply(body.vertices)
    start[:, 2] -= start[:, 2].min()
    runs = [b.run(start, velocity, frames=5, frame_time=0.01, substeps=20) for b in (body, again, body)]
    assert all(np.array_equal(runs[0].positions, run.positions) for run in runs[1:])
    assert all(np.array_equal(runs[0].velocities, run.velocities) for run in runs[1:])


@needs_newton
def test_what_is_not_finite_names_its_frame() -> None:
    body = solid()
    velocity = np.full((body.nodes, 3), 1e38)
    message = r"frame \d+: positions are not finite; 10 iterations in 5 substeps"
    with pytest.raises(SolverError, match=message):
        body.run(body.vertices, velocity, frames=20, frame_time=10.0, substeps=5)


@needs_newton
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"density": 0.0}, "density"),
        ({"viscosity": -1.0}, "viscosity"),
        ({"friction": -0.1}, "friction"),
        ({"iterations": 0}, "iterations"),
    ],
)
def test_parameters_out_of_range(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solid(**change)


def test_without_newton_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(GeneratorError, match=r"pip install 'm3gn-bench\[newton\]'"):
        solid()
