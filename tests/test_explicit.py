"""The explicit solver against closed forms, conservation laws and its own energy."""

import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from conftest import box_of_tetrahedra
from matrices import stiffness_at_rest
from scipy.spatial.transform import Rotation

from m3gn_bench.generators.errors import ParameterError, SolverError
from m3gn_bench.generators.solvers import explicit_kernels
from m3gn_bench.generators.solvers.captured import Course, Start
from m3gn_bench.generators.solvers.explicit import ExplicitSolid
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Element, Motion, lame_constants

MATERIAL = {"density": 1000.0, "youngs_modulus": 2e5, "poisson_ratio": 0.4}


def cube(cells: int = 2) -> tuple[np.ndarray, np.ndarray]:
    return box_of_tetrahedra((0.3,) * 3, (cells,) * 3)


def solid(**options: Any) -> ExplicitSolid:
    """A cube of soft material."""
    return ExplicitSolid(*cube(options.pop("cells", 2)), **{**MATERIAL, **options})


def deformed(vertices: np.ndarray, amount: float = 0.1) -> np.ndarray:
    """A smooth finite deformation without symmetry."""
    x, y, z = vertices.T / 0.3
    bend = np.stack([np.sin(2 * y + z), x * z, np.cos(x) * y], axis=1)
    return vertices + 0.3 * amount * bend


@pytest.mark.parametrize("element", get_args(Element))
def test_force_is_the_energys_gradient(element: Element) -> None:
    body = solid(element=element, gravity=0.0)
    x = deformed(body.vertices)
    force = body.accelerations(x, np.zeros_like(x)) * body.masses[:, None]
    h = 1e-6
    for node, axis in [(0, 0), (5, 1), (13, 2), (20, 0), (body.nodes - 1, 1)]:
        shifted = [x.copy(), x.copy()]
        shifted[0][node, axis] += h
        shifted[1][node, axis] -= h
        slope = (body.elastic_energy(shifted[0]) - body.elastic_energy(shifted[1])) / (2 * h)
        assert force[node, axis] == pytest.approx(-slope, rel=1e-6, abs=1e-6 * np.abs(force).max())


def test_lame_constants_are_those_of_small_strain() -> None:
    """Uniaxial strain needs lambda + 2 mu, shear needs mu."""
    body = solid(gravity=0.0, element="linear")
    mu, lam = lame_constants(MATERIAL["youngs_modulus"], MATERIAL["poisson_ratio"])
    strain = 1e-5
    volume = body.volumes.sum()
    stretched = body.vertices * (1 + strain, 1, 1)
    assert body.elastic_energy(stretched) == pytest.approx((lam / 2 + mu) * strain**2 * volume, rel=1e-4)
    sheared = body.vertices.copy()
    sheared[:, 0] += strain * sheared[:, 1]
    assert body.elastic_energy(sheared) == pytest.approx(mu / 2 * strain**2 * volume, rel=1e-4)


def test_rigid_motion_costs_nothing() -> None:
    """Elasticity and viscosity are objective: a spinning body feels no force."""
    body = solid(gravity=0.0, viscosity=100.0)
    turned = Rotation.from_rotvec([0.4, -1.0, 2.0]).apply(body.vertices)
    spin = np.cross([3.0, -2.0, 5.0], turned)
    largest = np.abs(body.accelerations(turned, spin)).max()
    assert largest < 1e-9 * np.abs(body.accelerations(deformed(turned), spin)).max()


@pytest.mark.parametrize("element", get_args(Element))
def test_viscosity_dissipates_what_it_should_and_keeps_momentum(element: Element) -> None:
    """A homogeneous deformation F whose gradient of velocity is G loses 2 eta |sym(F^T G)|^2 per volume."""
    viscosity = 100.0
    body = solid(element=element, gravity=0.0, viscosity=viscosity)
    F, G = np.eye(3) + 0.2 * np.random.default_rng(0).uniform(-1, 1, (2, 3, 3))
    x, v = body.vertices @ F.T, body.vertices @ G.T
    rest, damped = (body.masses[:, None] * body.accelerations(x, w) for w in (np.zeros_like(v), v))
    rate = (F.T @ G + G.T @ F) / 2
    lost = 2 * viscosity * body.volumes.sum() * (rate**2).sum()
    assert ((damped - rest) * v).sum() == pytest.approx(-lost, rel=1e-9)
    assert np.abs(damped.sum(0)).max() < 1e-12 * np.abs(damped).max() * body.nodes


def test_free_fall_is_exact() -> None:
    body = solid(viscosity=100.0)
    start = Rotation.from_rotvec([1.0, 0.2, -0.5]).apply(body.vertices) + np.array([0, 0, 6.0])
    motion = body.run(start, np.zeros_like(start), frames=100, frame_time=0.01, substeps=20)
    times = 0.01 * np.arange(101)
    expected = start + np.array([0, 0, -9.81 / 2]) * times[:, None, None] ** 2
    assert np.abs(motion.positions - expected).max() < 1e-9


def test_energy_and_momentum_over_a_second() -> None:
    """Without viscosity and contact leapfrog keeps momentum and angular momentum, and almost the energy."""
    body = solid(gravity=0.0, floor=False)
    start = deformed(body.vertices, 0.05)
    velocity = np.cross([0.5, 1.0, -2.0], start) + np.array([1.0, 0.0, 0.3])
    substeps = body.substeps(0.01, 0.2)
    motion = body.run(start, velocity, frames=100, frame_time=0.01, substeps=substeps)
    energies, _ = body.monitor(motion)
    total = energies.sum(1)
    assert np.abs(total / total[0] - 1).max() < 1e-3
    exchanged = np.ptp(energies[:, 1]) / total[0]
    assert exchanged > 0.02  # so that there was something to keep
    momentum = (body.masses[:, None] * motion.velocities).sum(1)
    assert np.abs(momentum - momentum[0]).max() < 1e-5 * np.abs(momentum[0]).max()
    middle = motion.positions - motion.velocities * motion.lag
    spin = np.cross(middle, body.masses[:, None] * motion.velocities).sum(1)
    assert np.abs(spin - spin[0]).max() < 1e-3 * np.abs(spin[0]).max()


def test_the_floor_is_never_passed_and_energy_never_grows() -> None:
    body = solid(viscosity=100.0, friction=0.5)
    start = Rotation.from_rotvec([1.0, 0.2, -0.5]).apply(body.vertices)
    start[:, 2] -= start[:, 2].min()
    velocity = np.tile([2.0, 0.0, -3.0], (body.nodes, 1))
    motion = body.run(start, velocity, frames=60, frame_time=0.01, substeps=body.substeps(0.01, 0.7))
    assert motion.positions[..., 2].min() == 0.0
    energies, _ = body.monitor(motion)
    total = energies.sum(1)
    assert np.diff(total).max() < 1e-3 * total[0]
    assert total[-1] < 0.9 * total[0]


def test_sliding_stops_after_coulombs_distance() -> None:
    """A stiff block slides v^2 / (2 mu g) and then stays."""
    body = solid(youngs_modulus=2e6, viscosity=2000.0, friction=0.3)
    velocity = np.tile([1.0, 0.0, 0.0], (body.nodes, 1))
    motion = body.run(body.vertices, velocity, frames=60, frame_time=0.01, substeps=body.substeps(0.01, 0.7))
    travelled = (motion.positions[:, :, 0] - body.vertices[:, 0]) @ body.masses / body.masses.sum()
    assert travelled[-1] == pytest.approx(1 / (2 * 0.3 * 9.81), rel=0.02)
    assert np.ptp(travelled[-10:]) < 1e-4


def test_the_same_run_is_the_same_bit_for_bit() -> None:
    body = solid(viscosity=100.0, friction=0.5)
    again = solid(viscosity=100.0, friction=0.5)
    velocity = np.tile([0.3, 0.0, -3.0], (body.nodes, 1))
    runs = [
        b.run(b.vertices, velocity, frames=20, frame_time=0.01, substeps=40).positions
        for b in (body, again, body)
    ]
    assert all(np.array_equal(runs[0], run) for run in runs[1:])


@pytest.mark.parametrize("element", get_args(Element))
@pytest.mark.parametrize("poisson_ratio", [0.0, 0.499])
def test_highest_frequency(element: Element, poisson_ratio: float) -> None:
    """Against the eigenvalues of the dense stiffness matrix, from differences of the force."""
    body = solid(cells=1, poisson_ratio=poisson_ratio, element=element, gravity=0.0)
    stiffness, masses = stiffness_at_rest(body), np.repeat(body.masses, 3)
    largest = np.linalg.eigvals(stiffness / masses[:, None]).real.max()
    assert body.highest_frequency == pytest.approx(np.sqrt(largest), rel=2e-3)


@pytest.mark.parametrize("element", get_args(Element))
def test_highest_damping_rate(element: Element) -> None:
    """Against the eigenvalues of the matrix that takes velocities to decelerations."""
    body = solid(cells=1, element=element, gravity=0.0, viscosity=100.0)
    unit = np.eye(3 * body.nodes).reshape(-1, body.nodes, 3)
    columns = [-body.accelerations(body.vertices, velocity).ravel() for velocity in unit]
    assert body.highest_damping_rate == pytest.approx(np.linalg.eigvals(columns).real.max(), rel=2e-3)
    assert solid(cells=1, element=element).highest_damping_rate == 0


def test_highest_frequency_of_a_single_tetrahedron() -> None:
    """Nodal pressure is the cell's own, and K is small enough to write down."""
    E, nu, density = 3.0, 0.25, 2.0
    mu, lam = lame_constants(E, nu)
    gradients = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    volume, mass = 1 / 6, density / 24
    stiffness = volume * (
        lam * np.einsum("ai,bj->aibj", gradients, gradients)
        + mu * np.einsum("aj,bi->aibj", gradients, gradients)
        + mu * np.einsum("ak,bk,ij->aibj", gradients, gradients, np.eye(3))
    ).reshape(12, 12)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = ExplicitSolid(
        corners,
        np.array([[0, 1, 2, 3]], np.int32),
        density=density,
        youngs_modulus=E,
        poisson_ratio=nu,
    )
    assert body.highest_frequency == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(stiffness / mass).max()), rel=1e-5
    )


def test_highest_frequency_scales_as_a_wave_does() -> None:
    """With the speed of sound over the size."""

    def frequency(size: float, youngs_modulus: float, density: float) -> float:
        body = ExplicitSolid(
            *box_of_tetrahedra((size,) * 3, (3, 3, 3)),
            density=density,
            youngs_modulus=youngs_modulus,
            poisson_ratio=0.3,
        )
        return body.highest_frequency

    reference = frequency(1.0, 1e6, 1000.0)
    assert frequency(2.0, 1e6, 1000.0) == pytest.approx(reference / 2, rel=1e-4)
    assert frequency(1.0, 4e6, 1000.0) == pytest.approx(2 * reference, rel=1e-4)
    assert frequency(1.0, 1e6, 4000.0) == pytest.approx(reference / 2, rel=1e-4)


def several(element: Element, device: str = "cpu") -> list[ExplicitSolid]:
    """Bodies of different size and material."""
    changes: list[dict[str, Any]] = [
        {"youngs_modulus": 1e5},
        {"cells": 3, "poisson_ratio": 0.49, "density": 800.0},
        {"cells": 1, "fixed": np.array([0])},
        {"youngs_modulus": 3e5},
    ]
    shared: dict[str, Any] = {"viscosity": 100.0, "friction": 0.5, "element": element, "device": device}
    return [solid(**shared, **change) for change in changes]


def thrown(bodies: list[ExplicitSolid], substeps: list[int]) -> list[Motion | SolverError]:
    starts = [
        Start(body.vertices, np.tile([0.3, 0.1 * k, -3.0], (body.nodes, 1)), steps)
        for k, (body, steps) in enumerate(zip(bodies, substeps, strict=True))
    ]
    return ExplicitSolid.run_together(bodies, starts, Course(frames=20, frame_time=0.01, first_frame=6))


@pytest.mark.parametrize("element", get_args(Element))
def test_together_each_moves_as_it_does_alone(element: Element) -> None:
    """Bit for bit, whatever the others are, however many substeps they take, even if one of them diverges."""
    bodies, substeps = several(element), [70, 160, 70, 2]
    for k, (body, steps, together) in enumerate(zip(bodies, substeps, thrown(bodies, substeps), strict=True)):
        velocity = np.tile([0.3, 0.1 * k, -3.0], (body.nodes, 1))
        course: dict[str, Any] = {"frames": 20, "frame_time": 0.01, "substeps": steps, "first_frame": 6}
        if steps == 2:
            with pytest.raises(SolverError) as alone:
                body.run(body.vertices, velocity, **course)
            assert isinstance(together, SolverError)
            assert str(together) == str(alone.value)
            continue
        assert isinstance(together, Motion)
        expected = body.run(body.vertices, velocity, **course)
        assert np.array_equal(together.positions, expected.positions)
        assert np.array_equal(together.velocities, expected.velocities)
        assert together.lag == expected.lag


def test_what_is_one_number_for_all_must_be_the_same() -> None:
    with pytest.raises(ParameterError, match=r"must have one friction, not \['0.0', '0.5'\]"):
        thrown([solid(), solid(friction=0.5)], [20, 20])


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")
def test_the_kernels_compile_for_cuda(tmp_path: Path) -> None:
    """Which takes no GPU: Warp brings NVIDIA's compiler along."""
    (binary,) = wp.compile_aot_module(explicit_kernels, arch=80, use_ptx=False, module_dir=tmp_path)
    code = binary.read_bytes()
    assert code.startswith(b"\x7fELF")
    kernels = [name for name, value in vars(explicit_kernels).items() if isinstance(value, wp.Kernel)]
    assert "move" in kernels
    assert [name for name in kernels if name.encode() not in code] == []


@pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("element", get_args(Element))
def test_the_same_code_runs_on_cuda(element: Element) -> None:
    motions = [thrown(several(element, device), [70, 160, 70, 80]) for device in ("cpu", "cuda:0")]
    for on_cpu, on_cuda in zip(*motions, strict=True):
        assert isinstance(on_cpu, Motion)
        assert isinstance(on_cuda, Motion)
        assert np.abs(on_cpu.positions - on_cuda.positions).max() < 1e-9


def test_beyond_the_stable_step_the_frame_is_named() -> None:
    body = solid(youngs_modulus=1e9, viscosity=0.0)
    velocity = np.tile([0.3, 0.0, -3.0], (body.nodes, 1))
    with pytest.raises(SolverError, match=r"frame \d+: positions are not finite; 20 substeps"):
        body.run(body.vertices, velocity, frames=50, frame_time=0.01, substeps=20)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"poisson_ratio": -0.1}, "poisson_ratio"),
        ({"youngs_modulus": 0.0}, "youngs_modulus"),
        ({"density": 0.0}, "density"),
        ({"viscosity": -1.0}, "viscosity"),
        ({"friction": -0.1}, "friction"),
    ],
)
def test_parameters_out_of_range(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solid(**change)


def test_inverted_tetrahedra_are_refused() -> None:
    vertices, tetrahedra = cube()
    tetrahedra[7] = tetrahedra[7][[1, 0, 2, 3]]
    with pytest.raises(ValueError, match="tetrahedron 7"):
        ExplicitSolid(vertices, tetrahedra, **MATERIAL)
