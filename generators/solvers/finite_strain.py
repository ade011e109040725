"""Elastic solids at finite strain, in two or three dimensions, on any scalar scikit-fem element.

Total Lagrangian: unknown is the displacement u(X), the deformation gradient is F = I + du/dX, and everything
follows from a stored energy per reference volume. The law is a decoupled neo-Hookean one,

    psi = mu/2 (J^(-2/d) I1 - d) + K/8 (J^2 + J^-2 - 2),    J = det F,  I1 = F:F,  d = 2 or 3,

whose volumetric part is infinite at J = 0 and of equal weight for compression and expansion. Split this way
(not with Lame's lambda) it stays stable for auxetic materials, lambda < 0, and log-free it resists deep
indentation. Source of the split: J. C. Simo and R. L. Taylor, Quasi-incompressible finite elasticity in
principal stretches, Comput. Methods Appl. Mech. Eng. 85 (1991); of the volumetric part: the even-power member
of the family of S. Doll and K. Schweizerhof, J. Appl. Mech. 67 (2000).

Units are free but must be consistent. In two dimensions energies and forces are per unit thickness.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from skfem import Basis, Mesh
from skfem.element import Element

from m3gn_bench.generators.errors import ParameterError
from m3gn_bench.generators.solvers.sparse import Array

Setting = Literal["3d", "plane stress", "plane strain"]


@dataclass(frozen=True)
class NeoHookean:
    """The decoupled neo-Hookean law.

    Attributes:
        shear_modulus: mu.
        bulk_modulus: K; in two dimensions the planar one, pressure over relative change of area.
    """

    shear_modulus: float
    bulk_modulus: float

    @classmethod
    def from_youngs_modulus(cls, youngs_modulus: float, poisson_ratio: float, setting: Setting) -> Self:
        """The law that has the given E and nu at small strain.

        Args:
            youngs_modulus: E.
            poisson_ratio: nu, of the three-dimensional material.
            setting: "3d", or for two-dimensional solids "plane stress" or "plane strain".

        Raises:
            ParameterError: a modulus outside its physical range.
        """
        E, nu = youngs_modulus, poisson_ratio
        if E <= 0:
            raise ParameterError(f"youngs_modulus must be positive, not {E}")
        if not -1 < nu < 0.5:
            raise ParameterError(f"poisson_ratio must lie in (-1, 0.5), not {nu}")
        bulk = {
            "3d": E / (3 * (1 - 2 * nu)),
            "plane stress": E / (2 * (1 - nu)),
            "plane strain": E / (2 * (1 + nu) * (1 - 2 * nu)),
        }
        return cls(shear_modulus=E / (2 * (1 + nu)), bulk_modulus=bulk[setting])


class Response:
    """The law at given deformation gradients: energy, stress, and on demand the tangent.

    Args:
        law: the material.
        F: deformation gradients, shape [d, d, points].

    Attributes:
        jacobian: J, shape [points].
        admissible: J > 0 everywhere. Where it is not, energy is infinite and nothing else is defined.
        energy: psi, shape [points].
        stress: first Piola-Kirchhoff stress P = d psi / d F, shape [d, d, points].
    """

    def __init__(self, law: NeoHookean, F: Array) -> None:
        d = len(F)
        self._law, self._F = law, F
        self.jacobian, cofactor = _determinant_and_cofactor(F)
        self.admissible = bool(self.jacobian.min() > 0)  # False for NaN, too
        if not self.admissible:
            return
        J = self.jacobian
        self._isochoric = law.shear_modulus * J ** (-2 / d)
        self._invariant = np.einsum("ijp,ijp->p", F, F)
        square, inverse_square = J**2, J**-2
        # J^2 + J^-2 - 2 = (J - 1/J)^2, without its cancellation
        self.energy = 0.5 * law.shear_modulus * _distortion(F, J) + law.bulk_modulus / 8 * (J - 1 / J) ** 2
        self._F_inverse_transposed = cofactor / J
        # P = a F + b F^-T: the factor b, and how it changes with ln J through the volumetric part.
        self._spherical = law.bulk_modulus / 4 * (square - inverse_square) - self._isochoric * (
            self._invariant / d
        )
        self._volumetric_stiffness = law.bulk_modulus / 2 * (square + inverse_square)
        self.stress = self._isochoric * F + self._spherical * self._F_inverse_transposed

    def tangent(self) -> Array:
        """d P_iJ / d F_kL, shape [d, d, d, d, points] in the order i, J, k, L."""
        F, G = self._F, self._F_inverse_transposed
        d = len(F)
        scaled = (2 / d) * self._isochoric * F
        spherical = (2 / d**2 * self._isochoric * self._invariant + self._volumetric_stiffness) * G - scaled
        tangent = G[:, :, None, None] * spherical
        tangent -= scaled[:, :, None, None] * G
        # d(F^-T)_iJ / dF_kL = -(F^-T)_iL (F^-T)_kJ
        transposed = np.ascontiguousarray(G.swapaxes(0, 1))
        tangent -= (self._spherical * G)[:, None, None, :] * transposed[None, :, :, None]
        for i in range(d):
            for j in range(d):
                tangent[i, j, i, j] += self._isochoric
        return tangent


def _determinant_and_cofactor(F: Array) -> tuple[Array, Array]:
    """det F and cof F = det F F^-T, of shape [points] and [d, d, points]."""
    cofactor = np.empty_like(F)
    if len(F) == 2:
        cofactor[0, 0], cofactor[0, 1] = F[1, 1], -F[1, 0]
        cofactor[1, 0], cofactor[1, 1] = -F[0, 1], F[0, 0]
    else:
        for i in range(3):
            a, b = F[(i + 1) % 3], F[(i + 2) % 3]
            for j in range(3):
                k, m = (j + 1) % 3, (j + 2) % 3
                cofactor[i, j] = a[k] * b[m] - a[m] * b[k]
    return np.einsum("jp,jp->p", F[0], cofactor[0]), cofactor


def _distortion(F: Array, J: Array) -> Array:
    """J^(-2/d) F:F - d, shape [points], to many digits even near the identity.

    There it is quadratic in H = F - I; if the terms of lower order were left to cancel by themselves, round-off
    would hide from a line search whether a small step lowers the energy.
    """
    if len(F) == 2:
        return ((F[0, 0] - F[1, 1]) ** 2 + (F[0, 1] + F[1, 0]) ** 2) / J
    H = F - np.eye(3)[:, :, None]
    trace = H[0, 0] + H[1, 1] + H[2, 2]
    minors = 0.5 * (trace**2 - np.einsum("ijp,jip->p", H, H))
    change = trace + minors + _determinant_and_cofactor(H)[0]  # J - 1
    shrinkage = np.expm1(-2 / 3 * np.log1p(change))  # J^(-2/3) - 1
    return (1 + shrinkage) * (2 * trace + np.einsum("ijp,ijp->p", H, H)) + 3 * shrinkage


class Solid:
    """A body that is deformed: basis gradients, integration weights, element forces and stiffness.

    Degree of freedom d * n + i is component i of node n; nodes are those of the scalar element (corners, and
    edge, face and inner nodes where it has them). A solid is never changed, so many simulations may share it.

    Args:
        mesh: at rest.
        element: any scalar Lagrange-like element for that mesh.
        integration_order: polynomial degree that the Gauss rule integrates exactly.

    Attributes:
        dimension: d, 2 or 3.
        nodes: rest positions, shape [nodes, d].
        dofs: d times the number of nodes.
        element_nodes: shape [elements, functions].
        element_dofs: shape [elements, d * functions], node by node.
        mesh, basis: the scikit-fem objects.
    """

    def __init__(self, mesh: Mesh, element: Element, *, integration_order: int) -> None:
        self.mesh = mesh
        self.basis = Basis(mesh, element, intorder=integration_order)
        self.dimension = d = int(mesh.dim())
        self.nodes: Array = np.ascontiguousarray(self.basis.doflocs.T)
        self.dofs = d * len(self.nodes)
        self.element_nodes: NDArray[np.int64] = self.basis.element_dofs.T.astype(np.int64)
        self._elements, self._functions = self.element_nodes.shape
        self.element_dofs = (d * self.element_nodes[:, :, None] + np.arange(d)).reshape(self._elements, -1)

        gradients = np.array(
            [function[0].grad for function in self.basis.basis]
        )  # function, J, element, point
        self._gradients = np.ascontiguousarray(gradients.transpose(2, 3, 1, 0))  # element, point, J, function
        self._points = self._gradients.shape[1]
        flat = self._gradients.reshape(self._elements, self._points * d, self._functions)
        self._operator = flat  # a view
        self._operator_transposed = np.ascontiguousarray(flat.swapaxes(1, 2))
        self._weights = np.ascontiguousarray(self.basis.dx).ravel()  # element and point

    @cached_property
    def volume(self) -> float:
        """At rest; in two dimensions the area."""
        return float(self._weights.sum())

    def dofs_of(self, nodes: NDArray[np.integer]) -> NDArray[np.int64]:
        """All degrees of freedom of these nodes, node by node, shape [d * nodes]."""
        d = self.dimension
        return (d * np.asarray(nodes, dtype=np.int64)[:, None] + np.arange(d)).ravel()

    @cached_property
    def element_masses(self) -> Array:
        """Consistent mass per density, scalar (the same for every component), [elements, functions, functions]."""
        values = np.array([np.asarray(function[0]) for function in self.basis.basis])
        values = np.broadcast_to(values, (self._functions, self._elements, self._points))
        weights = self._weights.reshape(self._elements, self._points)
        return np.asarray(np.einsum("aeq,beq,eq->eab", values, values, weights))

    def deformation_gradients(self, u: Array) -> Array:
        """F at the Gauss points, shape [d, d, elements * points], of the displacement u, shape [dofs]."""
        d = self.dimension
        nodal = u.reshape(-1, d)[self.element_nodes]
        gradients = (self._operator @ nodal).reshape(-1, d, d)  # element and point, J, i
        F = np.ascontiguousarray(gradients.transpose(2, 1, 0))
        for i in range(d):
            F[i, i] += 1
        return F

    def response(self, u: Array, law: NeoHookean) -> Response:
        """The law at the Gauss points under the displacement u, shape [dofs]."""
        return Response(law, self.deformation_gradients(u))

    def energy(self, response: Response) -> float:
        """Stored energy; infinite where a Gauss point is inverted."""
        return float(response.energy @ self._weights) if response.admissible else np.inf

    def element_forces(self, response: Response) -> Array:
        """Derivative of the energy, shape [elements, d * functions]."""
        d = self.dimension
        weighted = (response.stress * self._weights).transpose(2, 1, 0)  # element and point, J, i
        weighted = weighted.reshape(self._elements, self._points * d, d)
        return (self._operator_transposed @ weighted).reshape(self._elements, -1)

    def element_stiffness(self, response: Response) -> Array:
        """Second derivative of the energy, shape [elements, d * functions, d * functions]."""
        d, n, q, f = self.dimension, self._elements, self._points, self._functions
        tangent = (response.tangent() * self._weights).transpose(4, 1, 0, 2, 3)  # point, J, i, k, L
        half = tangent.reshape(n, q, d**3, d) @ self._gradients  # element, point, (J i k), function b
        full = self._operator_transposed @ half.reshape(n, q * d, d * d * f)  # element, a, (i k b)
        return full.reshape(n, f, d, d, f).transpose(0, 1, 2, 4, 3).reshape(n, d * f, d * f)

    def element_mass_matrices(self) -> Array:
        """Consistent mass per density of all components, shape [elements, d * functions, d * functions]."""
        d, f = self.dimension, self._functions
        return np.einsum("eab,ij->eaibj", self.element_masses, np.eye(d)).reshape(-1, d * f, d * f)
