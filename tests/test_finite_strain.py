"""The finite-strain solid, contact and implicit dynamics, quickly; `validation/` goes deeper."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from matrices import dense
from scipy.integrate import solve_ivp
from skfem import ElementHexS2, ElementQuad1, ElementQuadS2, ElementTetP1, Mesh, MeshHex, MeshQuad, MeshTet

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.contact import BoundaryPoints, Disc, PenaltyContact
from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Response, Setting, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array

E = 10.0
MATERIALS = [-0.9, 0.0, 0.49]


def quad_mesh(cells: int = 3) -> MeshQuad:
    """The unit square, its inner nodes moved so that no cell is a rectangle."""
    mesh = MeshQuad.init_tensor(*[np.linspace(0, 1, cells + 1)] * 2)
    return skewed(mesh)


def hex_mesh(cells: int = 2) -> MeshHex:
    return skewed(MeshHex.init_tensor(*[np.linspace(0, 1, cells + 1)] * 3))


def skewed(mesh: Mesh) -> Mesh:
    p = mesh.p.copy()
    inner = np.all((p > 1e-9) & (p < 1 - 1e-9), axis=0)
    p[:, inner] += 0.06 * np.random.default_rng(0).uniform(-1, 1, (len(p), inner.sum()))
    return type(mesh)(p, mesh.t)


BODIES: dict[str, Callable[[], Solid]] = {
    "serendipity quadrilaterals": lambda: Solid(quad_mesh(), ElementQuadS2(), integration_order=3),
    "serendipity hexahedra": lambda: Solid(hex_mesh(), ElementHexS2(), integration_order=5),
    "linear tetrahedra": lambda: Solid(MeshTet.init_tensor(*[np.linspace(0, 1, 3)] * 3), ElementTetP1(),
                                       integration_order=1),
}  # fmt: skip


@pytest.fixture(params=list(BODIES))
def solid(request: pytest.FixtureRequest) -> Solid:
    return BODIES[request.param]()


def setting_of(solid: Solid) -> Setting:
    return "plane stress" if solid.dimension == 2 else "3d"


def law_for(solid: Solid, poisson_ratio: float = 0.3) -> NeoHookean:
    return NeoHookean.from_youngs_modulus(E, poisson_ratio, setting_of(solid))


def lowest(solid: Solid) -> np.ndarray:
    """Degrees of freedom of the nodes at the bottom."""
    return solid.dofs_of(np.flatnonzero(solid.nodes[:, -1] < 1e-9))


def boundary_facets(solid: Solid) -> np.ndarray:
    facets = solid.mesh.boundary_facets()
    return facets[solid.mesh.p[-1, solid.mesh.facets[:, facets]].mean(0) > 1e-6]


def potential_of(
    solid: Solid, *, poisson_ratio: float = 0.3, contact: PenaltyContact | None = None
) -> IncrementalPotential:
    body = ConstrainedSolid(solid, lowest(solid))
    return IncrementalPotential(body, law_for(solid, poisson_ratio), contact=contact, force_floor=1e-9 * E)


class Floor:
    """The half-space below 0.2, an obstacle that is flat."""

    def depth(self, points: np.ndarray, time: float) -> np.ndarray:
        return 0.2 - points[:, -1]

    def normal(self, points: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        return np.eye(points.shape[1])[-1] + 0 * points, np.zeros(len(points))


def obstacles_around(solid: Solid) -> PenaltyContact:
    """A ball that dents the top, and a floor that the sides hang below."""
    d = solid.dimension
    ball = Disc(radius=0.4, start=(0.45,) * (d - 1) + (1.3,), velocity=(0.0,) * (d - 1) + (-0.1,))
    points = BoundaryPoints(solid, boundary_facets(solid), integration_order=5)
    return PenaltyContact(points, penalty=3 * E, obstacles=[ball, Floor()])


# --- the law ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("poisson_ratio", MATERIALS)
def test_stress_and_tangent_are_derivatives(d: int, poisson_ratio: float) -> None:
    rng = np.random.default_rng(0)
    law = NeoHookean.from_youngs_modulus(E, poisson_ratio, "3d" if d == 3 else "plane strain")
    F = np.eye(d)[:, :, None] + 0.25 * rng.standard_normal((d, d, 6))
    direction = rng.standard_normal(F.shape)
    step = 1e-6
    at = Response(law, F)
    assert at.admissible
    ahead, behind = Response(law, F + step * direction), Response(law, F - step * direction)
    slope = (ahead.energy - behind.energy) / (2 * step)
    assert slope == pytest.approx(np.einsum("ijp,ijp->p", at.stress, direction), rel=1e-6, abs=1e-6 * E)
    change = (ahead.stress - behind.stress) / (2 * step)
    expected = np.einsum("ijklp,klp->ijp", at.tangent(), direction)
    assert np.abs(change - expected).max() < 1e-6 * np.abs(change).max()


@pytest.mark.parametrize("poisson_ratio", MATERIALS)
@pytest.mark.parametrize("setting", ["3d", "plane stress", "plane strain"])
def test_small_strains_obey_hooke(poisson_ratio: float, setting: Setting) -> None:
    """Uniaxial stress along x: strain 1/E (plane strain: (1 - nu^2)/E), contraction by the effective nu."""
    law = NeoHookean.from_youngs_modulus(E, poisson_ratio, setting)
    d = 3 if setting == "3d" else 2
    tangent = Response(law, np.eye(d)[:, :, None]).tangent()[..., 0]
    assert np.allclose(tangent, tangent.transpose(2, 3, 0, 1))
    normal = np.array([[tangent[i, i, k, k] for k in range(d)] for i in range(d)])
    strain = np.linalg.solve(normal, np.eye(d)[0])
    nu, plane_strain = poisson_ratio, setting == "plane strain"
    assert strain[0] == pytest.approx((1 - nu**2 if plane_strain else 1) / E)
    assert strain[1] == pytest.approx((-nu * (1 + nu) if plane_strain else -nu) / E, abs=1e-12)
    assert tangent[0, 1, 0, 1] == pytest.approx(E / (2 * (1 + nu)))


@pytest.mark.parametrize("d", [2, 3])
def test_energy_of_tiny_strains_is_exact(d: int) -> None:
    """The quadratic form of Hooke's law, where round-off of the naive formula would be a hundred times larger."""
    law = NeoHookean.from_youngs_modulus(E, 0.3, "3d" if d == 3 else "plane strain")
    H = 2.0**-24 * np.round(16 * np.random.default_rng(0).uniform(-1, 1, (d, d, 5)))
    identity = np.eye(d)[:, :, None]
    tangent = Response(law, np.repeat(identity, 5, axis=2)).tangent()
    expected = 0.5 * np.einsum("ijp,ijklp,klp->p", H, tangent, H)
    # Large rotations cost nothing, but here even small ones are of second order: allow strain cubed.
    assert Response(law, identity + H).energy == pytest.approx(expected, rel=1e-5)


def test_inversion_is_infinite_energy(solid: Solid) -> None:
    mirrored = -2.5 * solid.nodes[:, 0]
    u = np.zeros_like(solid.nodes)
    u[:, 0] = mirrored
    response = solid.response(u.ravel(), law_for(solid))
    assert not response.admissible
    assert solid.energy(response) == np.inf


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0.0, 0.3), "youngs_modulus"), ((1.0, 0.5), "poisson_ratio"), ((1.0, -1.0), "poisson_ratio")],
)
def test_bad_moduli_are_refused(arguments: tuple[float, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NeoHookean.from_youngs_modulus(*arguments, "3d")


# --- the solid --------------------------------------------------------------------------------------------


def rotation(d: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((d, d)))
    q[:, 0] *= np.sign(np.linalg.det(q))
    return q


def test_rigid_motion_costs_nothing(solid: Solid) -> None:
    u = (solid.nodes @ rotation(solid.dimension).T + 0.7 - solid.nodes).ravel()
    response = solid.response(u, law_for(solid))
    assert abs(solid.energy(response)) < 1e-12 * E
    assert np.abs(solid.element_forces(response)).max() < 1e-12 * E


def test_forces_turn_with_the_body(solid: Solid) -> None:
    law, turn = law_for(solid), rotation(solid.dimension)
    u = 0.01 * np.random.default_rng(1).standard_normal(solid.nodes.shape)
    forces = solid.element_forces(solid.response(u.ravel(), law))
    turned = solid.element_forces(solid.response(((solid.nodes + u) @ turn.T - solid.nodes).ravel(), law))
    expected = forces.reshape(-1, solid.dimension) @ turn.T
    assert np.abs(turned.reshape(-1, solid.dimension) - expected).max() < 1e-12 * E


def test_mass_and_volume(solid: Solid) -> None:
    assert solid.volume == pytest.approx(1)
    matrices = solid.element_mass_matrices()
    assert matrices.sum() == pytest.approx(solid.dimension)  # each component carries the whole mass
    assert np.allclose(matrices, matrices.swapaxes(1, 2))
    assert ConstrainedSolid(solid, lowest(solid)).nodal_mass.sum() == pytest.approx(1)


def test_patch(solid: Solid) -> None:
    """A large homogeneous strain prescribed on the boundary is found inside, whatever the cells' shapes."""
    d = solid.dimension
    stretch = np.eye(d) + 0.2 * np.random.default_rng(2).uniform(-1, 1, (d, d))
    exact = solid.nodes @ (stretch - np.eye(d)).T
    outside = np.any((solid.nodes < 1e-9) | (solid.nodes > 1 - 1e-9), axis=1)
    assert not outside.all()
    body = ConstrainedSolid(solid, solid.dofs_of(np.flatnonzero(outside)))
    potential = IncrementalPotential(body, law_for(solid), force_floor=1e-9 * E)
    potential.begin_step(0.0, exact.ravel()[body.constrained], np.zeros(solid.dofs), 0.0)
    newton = ModifiedNewton(potential, tolerance=1e-10)
    guess = exact.ravel()[body.assembler.free] * 0.9
    found = potential.expand(newton.minimise(guess, force_scale=potential.force_scale))
    assert np.abs(found - exact.ravel()).max() < 1e-8


# --- the incremental potential ----------------------------------------------------------------------------


@pytest.mark.parametrize("poisson_ratio", MATERIALS)
def test_force_and_stiffness_are_derivatives(solid: Solid, poisson_ratio: float) -> None:
    """With contact on a ball and a floor, and inertia, at a deformed state."""
    rng = np.random.default_rng(4)
    potential = potential_of(solid, poisson_ratio=poisson_ratio, contact=obstacles_around(solid))
    prescribed = 0.02 * rng.standard_normal(len(potential.body.constrained))
    potential.begin_step(0.5, prescribed, 0.1 * rng.standard_normal(solid.dofs), 7.0)
    x = 0.02 * rng.standard_normal(potential.assembler.unknowns)
    direction = rng.standard_normal(len(x))
    step = 1e-6
    (ahead, force_ahead), (behind, force_behind) = (
        potential.energy_and_force(x + sign * step * direction) for sign in (1, -1)
    )
    energy, force = potential.energy_and_force(x)
    state = potential.contact_state
    assert np.isfinite(energy)
    assert state is not None
    assert len(state.touches) == 2  # both obstacles are touched
    assert (ahead - behind) / (2 * step) == pytest.approx(force @ direction, rel=1e-6)
    change = (force_ahead - force_behind) / (2 * step)
    product = dense(potential.assembler, potential.stiffness(x)) @ direction
    assert np.abs(product - change).max() < 1e-6 * np.abs(change).max()


def test_contact_pushes_as_hard_as_it_is_pushed(solid: Solid) -> None:
    contact = obstacles_around(solid)
    state = contact.evaluate(np.zeros(solid.dofs), 0.0)
    assert state.force is not None
    on_body = state.force.reshape(-1, solid.dimension).sum(0)  # derivative of the energy: minus the force
    assert on_body == pytest.approx(state.resultants.sum(0))
    assert state.resultants[0, -1] > 0  # the ball above is pushed up


# --- time -------------------------------------------------------------------------------------------------


DENSITY, DAMPING = 1.0, 0.3


def shaken() -> ImplicitDynamics:
    """One element whose base is shaken sideways, by 0.05 sin^2(pi t), and which follows as an oscillator."""
    potential = potential_of(Solid(MeshQuad(), ElementQuad1(), integration_order=3))
    sideways = potential.body.constrained % 2 == 0
    return ImplicitDynamics(
        potential,
        ModifiedNewton(potential, tolerance=1e-10),
        density=DENSITY,
        damping=DAMPING,
        prescribed=lambda time: np.where(sideways, 0.05 * np.sin(np.pi * time) ** 2, 0.0),
    )


@pytest.mark.parametrize("changing", [False, True])
def test_time_integration_is_of_second_order(changing: bool) -> None:
    """Also where steps halve and double again and again."""

    def end(refinement: int) -> Array:
        dynamics = shaken()
        for k in range(10):
            steps = refinement * (1 + k % 2) if changing else 2 * refinement
            dynamics.advance(0.2 * (k + 1), steps, f"frame {k}")
        assert dynamics.time == pytest.approx(2)
        return dynamics.displacement

    ends = [end(refinement) for refinement in (8, 16, 32, 64)]
    assert np.abs(ends[-1]).max() > 1e-2  # it does swing
    errors = [np.linalg.norm(a - b) for a, b in pairwise(ends)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 1.85) & (orders < 2.15)).all(), orders


def test_time_integration_solves_the_equation_of_motion() -> None:
    """The end is that of a Runge-Kutta method on rho M (a + alpha v) + f(u) = 0, with the base's movement by hand."""
    dynamics = shaken()
    body, law = dynamics.potential.body, dynamics.potential.law
    solid, constrained = body.solid, body.constrained
    (order,) = solid.element_dofs
    mass, free = np.zeros((solid.dofs,) * 2), np.setdiff1d(np.arange(solid.dofs), constrained)
    mass[np.ix_(order, order)] = DENSITY * solid.element_mass_matrices()[0]
    sideways = constrained[constrained % 2 == 0]

    def whole(time: float, state: Array) -> tuple[Array, Array]:
        u, v = np.zeros((2, solid.dofs))
        u[free], v[free] = np.split(state, 2)
        u[sideways], v[sideways] = 0.05 * np.sin(np.pi * time) ** 2, 0.05 * np.pi * np.sin(2 * np.pi * time)
        return u, v

    def rate(time: float, state: Array) -> Array:
        u, v = whole(time, state)
        force, base = np.zeros((2, solid.dofs))
        force[order] = solid.element_forces(solid.response(u, law))[0]
        base[sideways] = 0.1 * np.pi**2 * np.cos(2 * np.pi * time)
        pull = mass @ (base + DAMPING * v) + force
        return np.concatenate([v[free], np.linalg.solve(mass[np.ix_(free, free)], -pull[free])])

    exact = solve_ivp(rate, (0.0, 2.0), np.zeros(2 * len(free)), rtol=1e-8, atol=1e-10)
    expected, _ = whole(2.0, exact.y[:, -1])
    for k in range(10):
        dynamics.advance(0.2 * (k + 1), 64, f"frame {k}")
    assert np.abs(dynamics.displacement - expected).max() < 2e-3 * np.abs(expected).max()


def pressed(rate: float, max_iterations: int, tolerance: float = 1e-8) -> ImplicitDynamics:
    """A block whose top is pushed down by `rate` per unit of time."""
    solid = Solid(quad_mesh(4), ElementQuadS2(), integration_order=3)
    top = solid.dofs_of(np.flatnonzero(solid.nodes[:, 1] > 1 - 1e-9))
    body = ConstrainedSolid(solid, np.concatenate([lowest(solid), top]))
    potential = IncrementalPotential(body, law_for(solid, 0.49), force_floor=1e-9 * E)
    moves = np.isin(body.constrained, top[1::2])
    return ImplicitDynamics(
        potential,
        ModifiedNewton(potential, tolerance=tolerance, max_iterations=max_iterations),
        density=0.0,
        prescribed=lambda time: np.where(moves, -rate * time, 0.0),
    )


def test_bisection_rescues_a_huge_step() -> None:
    """Moving the top down by more than a cell at once turns cells over; in parts it works."""
    huge = pressed(rate=0.4, max_iterations=25)
    huge.advance(1.0, 1, "frame 1 of 1")
    assert huge.newton.statistics.bisections > 0
    careful = pressed(rate=0.4, max_iterations=25)
    careful.advance(1.0, 64, "frame 1 of 1")
    assert careful.newton.statistics.bisections == 0
    assert huge.time == careful.time == 1.0
    assert np.abs(huge.displacement - careful.displacement).max() < 1e-6
    assert 0 < huge.min_jacobian < 1


def test_a_lost_step_names_interval_jacobian_and_residual() -> None:
    dynamics = pressed(rate=0.5, max_iterations=2, tolerance=1e-30)
    with pytest.raises(SolverError, match=r"frame 1 of 3: the step.*8 bisections.*residual.*smallest J \d"):
        dynamics.advance(1.0, 1, "frame 1 of 3")
    assert dynamics.newton.statistics.bisections == 8


def test_a_body_at_rest_stays_at_rest(solid: Solid) -> None:
    potential = potential_of(solid)
    newton = ModifiedNewton(potential, tolerance=1e-6)
    dynamics = ImplicitDynamics(potential, newton, density=1.0)
    dynamics.advance(1.0, 3, "frame 1 of 1")
    assert not dynamics.displacement.any()
    assert newton.statistics.factorisations == 0


def test_negative_density_is_refused(solid: Solid) -> None:
    potential = potential_of(solid)
    with pytest.raises(ValueError, match="density"):
        ImplicitDynamics(potential, ModifiedNewton(potential, tolerance=1e-6), density=-1.0)
