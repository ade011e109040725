"""Probabilistic dynamic movement primitives (ProDMP) in a form without growing exponentials.

A trajectory solves (paper, equation 1, with beta = alpha/4, critically damped)

    tau^2 y'' = alpha (beta (g - y) - tau y') + sum_k w_k x phi_k(x),    x = exp(-alpha_x t / tau).

In s = t / tau and with a = alpha / 2 the impulse response is s e^(-a s), hence, from position y_0 and
velocity v_0 at t = 0 and for a goal g relative to y_0,

    y(t) = y_0 + tau v_0 s e^(-a s) + g (1 - (1 + a s) e^(-a s)) + sum_k w_k Phi_k(s),
    Phi_k(s) = integral from 0 to s of (s - u) e^(-a (s - u)) x(u) phi_k(x(u)) du.

The usual form subtracts products of e^(a s) and e^(-a s), which costs float32 its digits; here every term is
bounded. Phi_k and its slope are tabulated once, in float64, and interpolated by cubic Hermite polynomials,
so positions are smooth in tau. Basis functions are scaled to a maximum of one.
"""

from functools import lru_cache

import numpy as np
import torch
from numpy.polynomial.legendre import leggauss
from torch import Tensor, nn

TAU_RANGE = (0.3, 3.0)  # paper, table of hyper-parameters
TABLE_STEP = 1 / 512


def _forcing(s: np.ndarray, functions: int, alpha_x: float) -> np.ndarray:
    """x phi_k(x) at scaled times s, shape [len(s), functions]: normalised radial functions of the phase x."""
    phase = np.exp(-alpha_x * s)[:, None]
    centres = np.exp(-alpha_x * np.linspace(0, 1, functions))
    spacing = np.diff(centres)
    widths = np.append(spacing, spacing[-1])
    # Far beyond the last centre all functions are tiny: normalise their logarithms, which never underflow.
    exponent = -0.5 * ((phase - centres) / widths) ** 2
    weights = np.exp(exponent - exponent.max(1, keepdims=True))
    return phase * weights / weights.sum(1, keepdims=True)


@lru_cache(maxsize=4)
def _tabulate(functions: int, alpha: float, alpha_x: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Phi and dPhi/ds on a uniform grid over [0, end], shape [grid, functions] each.

    With A(s) the response to a decaying impulse, A' = -a A + f and Phi' = -a Phi + A. Over one step both have
    exact solutions but for an integral over f, which five Gauss points take to round-off.
    """
    a = alpha / 2
    grid = int(np.ceil(end / TABLE_STEP)) + 1
    h = TABLE_STEP
    points, weights = leggauss(5)
    offsets, weights = h * (points + 1) / 2, h * weights / 2
    starts = np.arange(grid - 1) * h
    forcing = _forcing((starts[:, None] + offsets).ravel(), functions, alpha_x).reshape(
        grid - 1, 5, functions
    )
    remaining = h - offsets
    decay = np.exp(-a * remaining) * weights
    gain_a = np.einsum("q,nqk->nk", decay, forcing)
    gain_phi = np.einsum("q,nqk->nk", decay * remaining, forcing)
    response = np.zeros((grid, functions))
    phi = np.zeros((grid, functions))
    fade = np.exp(-a * h)
    for n in range(grid - 1):
        phi[n + 1] = fade * (phi[n] + h * response[n]) + gain_phi[n]
        response[n + 1] = fade * response[n] + gain_a[n]
    return phi, response - a * phi


class ProDMP(nn.Module):
    """Movement primitives over times in [0, 1]; the unit is a whole trajectory, or a segment (`m3gn_replan`).

    Args:
        functions: number of basis functions.
        alpha: stiffness of the attractor.
        alpha_x: decay rate of the phase.
    """

    values: Tensor
    slopes: Tensor

    def __init__(self, functions: int = 30, alpha: float = 25.0, alpha_x: float = 2.0) -> None:
        super().__init__()
        self.decay = alpha / 2
        phi, slope = _tabulate(functions, alpha, alpha_x, 1 / TAU_RANGE[0])
        scale = 1 / np.abs(phi).max(0)
        # Not saved with a model: they follow from its configuration.
        self.register_buffer("values", torch.tensor(phi * scale, dtype=torch.float32), persistent=False)
        self.register_buffer("slopes", torch.tensor(slope * scale, dtype=torch.float32), persistent=False)
        self.scale = scale

    def forward(
        self, times: Tensor, tau: Tensor, weights: Tensor, position: Tensor, velocity: Tensor
    ) -> Tensor:
        """Positions of degrees of freedom that share one tau.

        Args:
            times: in [0, 1], shape [times].
            tau: time scale in TAU_RANGE, a scalar.
            weights: of the scaled basis functions, then the goal relative to `position`,
                shape [..., functions + 1].
            position: at time 0, shape [...].
            velocity: at time 0, per unit of time, shape [...].

        Returns:
            Positions, shape [times, ...].
        """
        return position + self.movement(self.responses(times, tau), weights, velocity)

    def responses(self, times: Tensor, tau: Tensor) -> Tensor:
        """What moves with each basis function, with the goal, and with the velocity at time 0.

        Args:
            times: in [0, 1], shape [times].
            tau: time scales in TAU_RANGE, shape [...].

        Returns:
            Shape [..., times, functions + 2].
        """
        s = times / tau[..., None]
        a = self.decay
        fade = torch.exp(-a * s)
        goal = 1 - (1 + a * s) * fade
        free = tau[..., None] * s * fade
        return torch.cat([self._interpolate(s), goal[..., None], free[..., None]], dim=-1)

    def movement(self, responses: Tensor, weights: Tensor, velocity: Tensor) -> Tensor:
        """Away from the position at time 0, shape [times, ...].

        Args:
            responses: for one tau, shape [times, functions + 2].
            weights, velocity: see `forward`.
        """
        coefficients = torch.cat([weights, velocity[..., None]], dim=-1)
        with torch.autocast(coefficients.device.type, enabled=False):  # positions need float32's digits
            return torch.tensordot(responses, coefficients, dims=([1], [-1]))

    def _interpolate(self, s: Tensor) -> Tensor:
        """Basis functions at scaled times [...], shape [..., functions]."""
        place = s / TABLE_STEP
        left = place.detach().floor().long().clamp(0, len(self.values) - 2)
        u = (place - left)[..., None]
        v0, v1 = self.values[left], self.values[left + 1]
        d0, d1 = self.slopes[left] * TABLE_STEP, self.slopes[left + 1] * TABLE_STEP
        # Increments from v0 keep float32's digits where a basis function is flat.
        rise = v1 - v0
        return v0 + u * (d0 + u * (3 * rise - 2 * d0 - d1 + u * (d0 + d1 - 2 * rise)))
