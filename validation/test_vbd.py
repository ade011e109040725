"""Newton's vertex block descent against the explicit solver on the same plain tetrahedra: stiffness, and a drop."""

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation
from skfem import MeshTet

pytest.importorskip("newton")

from m3gn_bench.generators.falling import DENSITY, FRICTION, SIZE, VISCOSITY
from m3gn_bench.generators.objects import load_object
from m3gn_bench.generators.solvers.explicit import ExplicitSolid
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, TetrahedralSolid
from m3gn_bench.generators.solvers.vbd import VertexBlockDescent

Beam = tuple[Array, np.ndarray]
BEAM_MATERIAL = {"density": 1000.0, "youngs_modulus": 1e6, "gravity": 0.0, "floor": False}
SAMPLING = 1e-3  # [s]
SAMPLES = 60  # a little more than half a period
TIP_SPEED = 0.2  # [m/s]; moves the tip by 1 % of the length, far above round-off


ATTITUDE = (0.9, -1.4, 0.6)  # of the teddy, a rotation vector
GAP = 0.01  # [m] below the falling teddy
SPEED = 3.1  # [m/s]
FRAME_TIME = 0.01  # [s]
FRAMES = 23  # it hits in the first half of frame 1; the last is 0.2 s after


@pytest.fixture(scope="module")
def beam() -> Beam:
    """A cantilever of 0.5 x 0.1 x 0.1 m, its first coordinate along it."""
    ticks = (np.linspace(0, s, n + 1) for s, n in ((0.5, 5), (0.1, 1), (0.1, 1)))
    mesh = MeshTet.init_tensor(*ticks).oriented()
    return mesh.p.T.copy(), np.ascontiguousarray(mesh.t.T, np.int32)


def _first_mode(body: ExplicitSolid, clamped: np.ndarray) -> tuple[float, Array]:
    """Angular frequency [rad/s] and shape [nodes, 3] of the lowest mode, by the dense stiffness matrix."""
    step = 1e-7
    free = np.setdiff1d(np.arange(3 * body.nodes), (3 * clamped[:, None] + np.arange(3)).ravel())
    masses = np.repeat(body.masses, 3)[free]
    columns = []
    for entry in free:
        change = np.zeros(3 * body.nodes)
        change[entry] = step
        change = change.reshape(-1, 3)
        there, back = (
            body.accelerations(body.vertices + sign * change, np.zeros_like(change)).ravel()[free]
            for sign in (1, -1)
        )
        columns.append(masses * (back - there) / (2 * step))
    stiffness = np.array(columns)
    values, shapes = eigh((stiffness + stiffness.T) / 2, np.diag(masses), subset_by_index=[0, 0])
    shape = np.zeros(3 * body.nodes)
    shape[free] = shapes[:, 0]
    return float(np.sqrt(values[0])), shape.reshape(-1, 3)


def _frequency_and_damping(body: TetrahedralSolid, shape: Array, substeps: int) -> tuple[float, float]:
    """Angular frequency [rad/s] and ratio of damping of a mode, from the motion after a blow in its shape."""
    blow = shape * (TIP_SPEED / np.abs(shape).max())
    motion = body.run(body.vertices, blow, frames=SAMPLES, frame_time=SAMPLING, substeps=substeps)
    modal = (motion.positions - body.vertices).reshape(SAMPLES + 1, -1) @ (
        body.masses[:, None] * shape
    ).ravel()
    # A damped oscillation satisfies x[n + 1] = 2 r cos(w) x[n] - r^2 x[n - 1].
    known = np.stack([modal[1:-1], modal[:-2]], axis=1)
    first, second = np.linalg.lstsq(known, modal[2:], rcond=None)[0]
    root = np.log(complex(first, np.sqrt(-4 * second - first**2)) / 2) / SAMPLING
    return root.imag, -root.real / abs(root)


@pytest.mark.parametrize(
    ("iterations", "allowed"), [(1, (0.8, 0.5, 0.2, 0.05)), (2, (0.6, 0.2, 0.02, 0.005))]
)
def test_stiffness_converges_with_substeps(beam: Beam, iterations: int, allowed: tuple[float, ...]) -> None:
    """Of the first bending mode, nu 0.49. Too few sweeps over the nodes leave it too soft."""
    clamped = np.flatnonzero(beam[0][:, 0] == 0)
    options = {**BEAM_MATERIAL, "poisson_ratio": 0.49, "fixed": clamped}
    explicit = ExplicitSolid(*beam, **options, element="linear")
    exact, shape = _first_mode(explicit, clamped)
    reference, _ = _frequency_and_damping(explicit, shape, explicit.substeps(SAMPLING, 0.3))
    assert reference == pytest.approx(exact, rel=2e-3)
    body = VertexBlockDescent(*beam, **options, iterations=iterations)
    errors = []
    for substeps in (1, 2, 4, 8):
        frequency, _ = _frequency_and_damping(body, shape, substeps)
        errors.append(abs((frequency / reference) ** 2 - 1))
    print(f"stiffness of the first bending mode, {iterations} iterations: off by {np.round(errors, 4)}")
    assert (np.diff(errors) < 0).all()
    assert (np.array(errors) < allowed).all()


@pytest.mark.parametrize("poisson_ratio", [0.3, 0.49])
def test_it_damps_as_implicit_euler(beam: Beam, poisson_ratio: float) -> None:
    """A ratio of omega dt / 2 where the steps are solved: an error in time that no sweep takes away."""
    clamped = np.flatnonzero(beam[0][:, 0] == 0)
    options = {**BEAM_MATERIAL, "poisson_ratio": poisson_ratio, "fixed": clamped}
    exact, shape = _first_mode(ExplicitSolid(*beam, **options, element="linear"), clamped)
    body = VertexBlockDescent(*beam, **options, iterations=20)
    for substeps in (1, 2):
        frequency, damping = _frequency_and_damping(body, shape, substeps)
        assert frequency == pytest.approx(exact, rel=5e-3)
        assert damping == pytest.approx(exact * SAMPLING / substeps / 2, rel=0.05)


@pytest.mark.parametrize(
    ("youngs_modulus", "poisson_ratio", "settings", "allowed"),
    [
        (3e5, 0.49, [(2, 20), (2, 40), (5, 40), (5, 80)], 0.015),
        (1e6, 0.499, [(2, 40), (2, 80), (2, 160)], 0.05),
    ],
)
def test_drop_converges(
    youngs_modulus: float, poisson_ratio: float, settings: list[tuple[int, int]], allowed: float
) -> None:
    """The teddy's surface 0.2 s after the impact, against the explicit solver at half its stable step."""
    teddy = load_object("teddy")
    start = Rotation.from_rotvec(ATTITUDE).apply(SIZE * teddy.vertices)
    start[:, 2] += GAP - start[:, 2].min()
    velocity = np.tile([0.0, 0.0, -SPEED], (len(start), 1))
    options = {
        "density": DENSITY,
        "youngs_modulus": youngs_modulus,
        "poisson_ratio": poisson_ratio,
        "viscosity": VISCOSITY,
        "friction": FRICTION,
    }

    def drop(body: ExplicitSolid | VertexBlockDescent, substeps: int) -> Motion:
        return body.run(start, velocity, frames=FRAMES, frame_time=FRAME_TIME, substeps=substeps)

    explicit = ExplicitSolid(start, teddy.tetrahedra, **options, element="linear")
    reference = drop(explicit, explicit.substeps(FRAME_TIME, 0.5))
    errors = []
    for iterations, substeps in settings:
        motion = drop(VertexBlockDescent(start, teddy.tetrahedra, **options, iterations=iterations), substeps)
        away = (motion.positions[-1] - reference.positions[-1])[: teddy.surface_nodes]
        errors.append(float(np.sqrt((away**2).sum(1).mean()) / SIZE))
        assert motion.positions[..., 2].min() > -1e-3
    print(f"drop at E {youngs_modulus:g}, nu {poisson_ratio}: {list(zip(settings, errors, strict=True))}")
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < allowed
