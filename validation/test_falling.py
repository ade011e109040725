"""The falling scenes: error in time and in space, sensitivity to rounding, and materials beyond their range."""

from dataclasses import replace

import numpy as np
import pytest

from m3gn_bench.datasets.recorded import TOLERANCE
from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.generators import falling
from m3gn_bench.generators.falling import (
    FRAME_TIME,
    SIZE,
    FallingTeddy,
    FallParameters,
    MixedObjects,
)
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.objects import load_object
from m3gn_bench.generators.solvers import explicit
from m3gn_bench.generators.solvers.tetrahedra import Element

TEDDY = FallingTeddy()
DEFAULT = TEDDY.fidelities["default"]
COURANT = DEFAULT.courant
UNDAMPED = 0.7  # of the limit of stability
IMPACT = falling.flight_frames(falling.HEIGHT)  # first frame after contact
SOON, LATER = IMPACT + 10, IMPACT + 20  # 0.1 and 0.2 s after it


def teddy(index: int = 0, **changes: float) -> FallParameters:
    """A draw of the test split with some parameters changed."""
    return replace(draw(TEDDY, "test", index, DATASET_SEED), **changes)


def positions(
    parameters: FallParameters, courant: float, parts: int = 1, element: Element = "nodal pressure"
) -> np.ndarray:
    """Recorded positions up to 0.2 s after the impact, at a discretisation of one's own."""
    level = replace(DEFAULT, parts=parts, courant=courant, element=element)
    return TEDDY.simulate_with(parameters, level, LATER + 1).positions.astype(np.float64)


def distance(one: np.ndarray, other: np.ndarray, frame: int) -> float:
    """Root mean square distance of the nodes over the object's size."""
    return float(np.sqrt(((one[frame] - other[frame]) ** 2).sum(-1).mean())) / SIZE


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3, 0.49, 0.499])
def test_convergence_in_time(poisson_ratio: float) -> None:
    """0.2 s after the impact the default step's error is below 0.05 % of the size, and falls with the step.

    First order: the floor's impulse and the viscosity's lag, not leapfrog's second order, set the rate.
    """
    parameters = teddy(youngs_modulus=1e5 if poisson_ratio == 0.499 else 3e5, poisson_ratio=poisson_ratio)
    finest = positions(parameters, 0.7 / 8)
    errors = [distance(positions(parameters, 0.7 / k), finest, LATER) for k in (1, 2, 4)]
    default = distance(positions(parameters, COURANT), finest, LATER)
    print(f"nu {poisson_ratio}: {default:.1e}; " + ", ".join(f"{error:.1e}" for error in errors))
    assert max(default, errors[0]) < 5e-4
    # A step of 1/k against 1/8 of it: first order gives the ratios 7/3 and 3.
    assert errors[0] > 1.8 * errors[1] > 1.8 * 2 * errors[2]


def test_error_in_space_exceeds_that_in_time() -> None:
    """Against quadratic tetrahedra: this, not the step, limits the default level, and cutting each tetrahedron into
    eight comes closer."""
    parameters = teddy(youngs_modulus=2e5, poisson_ratio=0.3)
    default, quadratic = positions(parameters, COURANT), positions(parameters, COURANT, element="quadratic")
    cut = positions(parameters, COURANT, parts=2)
    space, finer = (distance(x, quadratic, SOON) for x in (default, cut))
    time = distance(default, positions(parameters, COURANT / 4), SOON)
    print(f"in space {space:.1e}, in eight {finer:.1e}; in time {time:.1e}")
    assert 5 * time < space < 0.2
    assert finer < 0.75 * space


def test_rounding_is_harmless() -> None:
    """The whole drop from a height that is 1e-12 m larger, far more than what processors round differently."""
    scene = MixedObjects()
    for index in range(6):
        parameters = draw(scene, "test", index, DATASET_SEED)
        one = scene.simulate(parameters).positions.astype(np.float64)
        other = scene.simulate(replace(parameters, height=parameters.height + 1e-12)).positions
        largest = np.abs(one - other).max() / scene.scale_length
        print(f"{parameters.object}: {largest:.1e}")
        assert largest < 1e-6 < TOLERANCE / 10


@pytest.mark.parametrize(("youngs_modulus", "poisson_ratio"), [(3e5, 0.3), (1e6, 0.49)])
def test_energy_of_a_free_teddy(youngs_modulus: float, poisson_ratio: float) -> None:
    """No viscosity, no contact, half of the energy exchanged: leapfrog keeps it up to a bounded oscillation.

    That goes with the square of the step. Without viscosity the default step (0.85 of the limit) is too long for the
    stiffer of the two: stretched cells ask for a shorter one, and it diverges, which is seen and said.
    """
    body = load_object("teddy")
    solid = explicit.ExplicitSolid(
        SIZE * body.vertices,
        body.tetrahedra,
        density=falling.DENSITY,
        youngs_modulus=youngs_modulus,
        poisson_ratio=poisson_ratio,
        gravity=0.0,
        floor=False,
    )
    x, y, z = solid.vertices.T
    start = solid.vertices + 0.05 * np.stack([np.sin(4 * y + 2 * z), 4 * x * z, np.cos(3 * x) * y], axis=1)
    spin = np.cross([0.5, 1.0, -2.0], start) + np.array([1.0, 0.0, 0.3])
    lost = {}
    for courant in (UNDAMPED, UNDAMPED / 4):
        substeps = solid.substeps(FRAME_TIME, courant)
        motion = solid.run(start, spin, frames=100, frame_time=FRAME_TIME, substeps=substeps)
        energies, _ = solid.monitor(motion)
        total = energies.sum(1)
        lost[courant] = np.abs(total / total[0] - 1).max()
        momentum = (solid.masses[:, None] * motion.velocities).sum(1)
        assert np.abs(momentum - momentum[0]).max() < 1e-5 * np.abs(momentum[0]).max()
        print(
            f"E {youngs_modulus:g}, nu {poisson_ratio}, courant {courant}, {substeps} steps: {lost[courant]:.1e}"
        )
        assert np.ptp(energies[:, 1]) > 0.1 * total[0]
    assert lost[UNDAMPED / 4] < 1e-3
    assert lost[UNDAMPED] < 5e-3


EXTREMES = {
    "softest, compressible": {"youngs_modulus": 1e5, "poisson_ratio": 0.0},
    "softest, incompressible": {"youngs_modulus": 1e5, "poisson_ratio": 0.499},
    "stiffest, compressible": {"youngs_modulus": 1e6, "poisson_ratio": 0.0},
    "beyond: nu 0.4999": {"youngs_modulus": 2e5, "poisson_ratio": 0.4999},
    "beyond: E / 10": {"youngs_modulus": 1e4, "poisson_ratio": 0.3},
    "beyond: E / 100": {"youngs_modulus": 1e3, "poisson_ratio": 0.3},
    "beyond: E x 10": {"youngs_modulus": 1e7, "poisson_ratio": 0.3},
    "beyond: from 2 m": {"height": 2.0, "youngs_modulus": 3e5, "poisson_ratio": 0.3},
    "beyond: from rest on the floor": {"height": 0.0, "youngs_modulus": 3e5, "poisson_ratio": 0.3},
}


def test_auxetic_material_is_refused() -> None:
    """This law would let it collapse: at J = 0 its energy is below that at rest."""
    with pytest.raises(ValueError, match="poisson_ratio"):
        TEDDY.simulate(teddy(poisson_ratio=-0.9))


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes(name: str) -> None:
    """Valid, or refused by a check that says why; never anything that is not finite."""
    parameters = teddy(**EXTREMES[name])
    trajectory = TEDDY.simulate(parameters)
    problems = TEDDY.check(trajectory)
    print(f"{name}: {problems or 'valid'} {trajectory.diagnostics}")
    assert np.isfinite(trajectory.positions).all()
    assert trajectory.positions[..., 2].min() >= 0
    if name != "beyond: E / 100":  # so soft that it does not carry its own weight: parts stay inside out
        assert problems == []
    else:
        assert problems
        assert "inverted at the end" in problems[0]


def test_flat_on_an_edge_and_upside_down() -> None:
    """Degenerate placements: the cone flat on its base, on an edge of it, on its tip."""
    half = np.sqrt(0.5)
    for quaternion in ((0, 0, 0, 1), (np.sin(0.2), 0, 0, np.cos(0.2)), (1, 0, 0, 0), (half, 0, 0, half)):
        parameters = FallParameters("traffic_cone", tuple(map(float, quaternion)), 2e5, 0.45)
        trajectory = MixedObjects().simulate(parameters)
        assert MixedObjects().check(trajectory) == []


def test_random_drops_are_valid() -> None:
    """Nothing is rejected among the first draws of all objects."""
    scene = MixedObjects()
    for index in range(18):
        trajectory = scene.simulate(draw(scene, "train", index, DATASET_SEED))
        assert scene.check(trajectory) == []
        assert len(trajectory.positions) * FRAME_TIME == pytest.approx(2.01)


@pytest.mark.parametrize(
    ("term", "smallest_effect"), [("FRICTION", 0.05), ("VISCOSITY", 0.005), ("nodal pressure", 0.005)]
)
def test_every_term_matters(monkeypatch: pytest.MonkeyPatch, term: str, smallest_effect: float) -> None:
    """Switched off, each changes the motion by far more than the step does (5e-4 at most, see above)."""
    parameters, level = teddy(2), DEFAULT
    usual = positions(parameters, DEFAULT.courant)
    if term == "nodal pressure":
        level = replace(level, element="linear")
    else:
        monkeypatch.setattr(falling, term, 0.0)
    without = TEDDY.simulate_with(parameters, level, LATER + 1).positions.astype(np.float64)
    effect = distance(without, usual, LATER)
    print(f"without {term.lower()}: {effect:.1e}")
    assert effect > smallest_effect
