"""Movement primitives against a direct integration of their differential equation."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from m3gn_bench.movement_primitives import TAU_RANGE, ProDMP

FUNCTIONS, ALPHA, ALPHA_X = 30, 25.0, 2.0
TIMES = np.arange(1, 51) / 50


def forcing(phase: float) -> np.ndarray:
    """x phi_k(x), written down from the definition, without the module's safeguards."""
    centres = np.exp(-ALPHA_X * np.linspace(0, 1, FUNCTIONS))
    spacing = np.diff(centres)
    widths = np.append(spacing, spacing[-1])
    phi = np.exp(-0.5 * ((phase - centres) / widths) ** 2)
    return phase * phi / phi.sum()


def integrate(tau: float, weights: np.ndarray, goal: float, position: float, velocity: float) -> np.ndarray:
    """Solve the equation of motion itself: no closed form, no table."""

    def motion(t: float, state: np.ndarray) -> list[float]:
        y, dy = state
        force = forcing(np.exp(-ALPHA_X * t / tau)) @ weights
        return [dy, (ALPHA * (ALPHA / 4 * (goal - y) - tau * dy) + force) / tau**2]

    solution = solve_ivp(motion, (0, 1), [position, velocity], t_eval=TIMES, rtol=1e-11, atol=1e-13)
    assert solution.success
    return solution.y[0]


@pytest.fixture(scope="module")
def primitives() -> ProDMP:
    return ProDMP(FUNCTIONS, ALPHA, ALPHA_X)


@pytest.mark.parametrize("tau", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_equals_integrated_equation(primitives: ProDMP, tau: float, seed: int) -> None:
    """In float32, to 1e-5 of trajectories of order one."""
    rng = np.random.default_rng(seed)
    scaled = rng.uniform(-0.3, 0.3, FUNCTIONS)
    goal, position, velocity = rng.uniform(-1, 1, 3)
    expected = integrate(tau, scaled * primitives.scale, position + goal, position, velocity)
    found = primitives(
        torch.tensor(TIMES, dtype=torch.float32),
        torch.tensor(tau),
        torch.tensor([*scaled, goal], dtype=torch.float32),
        torch.tensor(position, dtype=torch.float32),
        torch.tensor(velocity, dtype=torch.float32),
    )
    assert found.dtype == torch.float32
    assert np.abs(found.numpy() - expected).max() < 1e-5


@pytest.mark.parametrize("tau", TAU_RANGE)
def test_finite_and_differentiable_at_the_ends_of_tau(primitives: ProDMP, tau: float) -> None:
    """Values and gradients with respect to weights, goal and tau, in float32."""
    time_scale = torch.tensor(tau, requires_grad=True)
    weights = torch.full((5, 3, FUNCTIONS + 1), 0.1, requires_grad=True)
    position, velocity = torch.zeros(5, 3), torch.ones(5, 3)
    path = primitives(torch.tensor(TIMES, dtype=torch.float32), time_scale, weights, position, velocity)
    assert path.shape == (50, 5, 3)
    path.square().sum().backward()
    assert torch.isfinite(path).all()
    for gradient in (time_scale.grad, weights.grad):
        assert gradient is not None
        assert torch.isfinite(gradient).all()
        assert gradient.abs().max() > 0


def test_gradient_in_tau_equals_difference_quotient() -> None:
    """The table is interpolated with its slopes, so the derivative in tau is that of the curve."""
    primitives = ProDMP(FUNCTIONS, ALPHA, ALPHA_X).double()
    rng = np.random.default_rng(1)
    weights = torch.tensor(rng.uniform(-0.3, 0.3, FUNCTIONS + 1))
    times = torch.tensor(TIMES)

    def total(tau: torch.Tensor) -> torch.Tensor:
        return primitives(times, tau, weights, torch.zeros(()).double(), torch.ones(()).double()).sum()

    tau = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    total(tau).backward()
    step = 1e-4
    quotient = (total(tau.detach() + step) - total(tau.detach() - step)) / (2 * step)
    assert tau.grad is not None
    assert float(tau.grad) == pytest.approx(float(quotient), rel=1e-4)


@pytest.mark.parametrize("tau", [0.3, 1.0, 3.0])
def test_starts_exactly_at_position_and_velocity(primitives: ProDMP, tau: float) -> None:
    """Whatever the weights; the velocity is the path's own derivative in time."""
    weights = torch.linspace(-1, 1, FUNCTIONS + 1)
    time = torch.zeros(1, requires_grad=True)
    path = primitives(time, torch.tensor(tau), weights, torch.tensor(0.4), torch.tensor(-2.0))
    (velocity,) = torch.autograd.grad(path.sum(), time)
    assert path[0].item() == pytest.approx(0.4, abs=1e-7)
    assert velocity[0].item() == pytest.approx(-2.0, rel=1e-6)


def test_translation_equivariant(primitives: ProDMP) -> None:
    """Moving the start moves the whole path: the goal is relative."""
    weights = torch.linspace(-0.5, 0.5, FUNCTIONS + 1)
    times, tau, velocity = torch.tensor(TIMES, dtype=torch.float32), torch.tensor(1.0), torch.tensor(0.5)
    near = primitives(times, tau, weights, torch.tensor(0.0), velocity)
    far = primitives(times, tau, weights, torch.tensor(3.0), velocity)
    assert (far - near - 3.0).abs().max() < 1e-6


def test_reaches_the_goal(primitives: ProDMP) -> None:
    """Without weights the attractor alone acts; at tau = 0.3 it has settled after the whole time."""
    weights = torch.zeros(FUNCTIONS + 1)
    weights[-1] = 1.5
    path = primitives(torch.tensor([1.0]), torch.tensor(0.3), weights, torch.tensor(0.5), torch.tensor(0.0))
    assert float(path[0]) == pytest.approx(2.0, abs=1e-5)
