"""Clamped rectangular Kirchhoff-Love plates on Bogner-Fox-Schmit elements, with exact geometry.

Kinematics: the midsurface x(X, Y) = (X, Y, 0) + u(X, Y) carries the Green-Lagrange membrane strain
E_ab = (x_,a . x_,b - delta_ab) / 2 and the curvature k_ab = n . x_,ab, both work-conjugate to a
St. Venant-Kirchhoff plane-stress law (small strain, any rotation):

    W = integral of  h/2 E:C:E + h^3/24 k:C:k  dA.

No von Karman truncation, because slopes may be large; no shear, no rotational unknowns and so no locking,
because the bicubic Bogner-Fox-Schmit rectangle is C1-continuous. The linear plate is the same code: its
stiffness is that of the unloaded state.

Units are free but must be consistent; the scenes use N, mm and MPa.
"""

from functools import cached_property

import numpy as np
from skfem import Basis, ElementQuadBFS, MeshQuad

from m3gn_bench.generators.errors import ParameterError
from m3gn_bench.generators.solvers.sparse import Array, BandedAssembler

GAUSS_POINTS = 3  # per direction; four change no scene by more than its discretisation error
LOAD_GAUSS_POINTS = 12  # the load's disc is smaller than two elements


def _tensor_rule(points: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(points)
    nodes, weights = (nodes + 1) / 2, weights / 2
    return np.array(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1), np.outer(
        weights, weights
    ).ravel()


class ClampedPlate:
    """A square plate, clamped (displacement and slope zero) along its whole border.

    The unknowns are, per node, the displacement, its two slopes and its twist, each with three components.

    Args:
        ticks: coordinates of the nodes along either edge [mm], increasing from 0 to the side's length; they
            may crowd near the border, where a soft plate bends in a layer narrower than an even mesh.
        thickness: h [mm].
        youngs_modulus: E [MPa].
        poisson_ratio: nu.

    Raises:
        ParameterError: a parameter outside its physical range.
    """

    def __init__(
        self, *, ticks: Array, thickness: float, youngs_modulus: float, poisson_ratio: float
    ) -> None:
        if min(thickness, youngs_modulus) <= 0:
            raise ParameterError(
                f"thickness and youngs_modulus must be positive, not {thickness}, {youngs_modulus}"
            )
        if not -1 < poisson_ratio < 0.5:
            raise ParameterError(f"poisson_ratio must lie in (-1, 0.5), not {poisson_ratio}")
        if len(ticks) < 3 or ticks[0] != 0 or np.diff(ticks).min() <= 0:
            raise ParameterError(f"ticks must be three or more numbers that increase from 0, not {ticks}")
        self.side = float(ticks[-1])
        self.thickness = thickness
        self.youngs_modulus = youngs_modulus
        self.poisson_ratio = poisson_ratio
        self.mesh = MeshQuad.init_tensor(ticks, ticks)
        self.basis = Basis(self.mesh, ElementQuadBFS(), quadrature=_tensor_rule(GAUSS_POINTS))

        fields = [function[0] for function in self.basis.basis]
        slots = [[f.grad[0], f.grad[1], f.hess[0, 0], f.hess[1, 1], f.hess[0, 1]] for f in fields]
        derivatives = np.array(slots).transpose(2, 3, 1, 0)  # element, point, derivative, function
        self._elements, self._points, _, self._functions = derivatives.shape
        self._derivatives = np.ascontiguousarray(derivatives)
        flat = derivatives.reshape(self._elements, self._points * 5, self._functions)
        self._operator = np.ascontiguousarray(flat)
        self._operator_transposed = np.ascontiguousarray(flat.swapaxes(1, 2))
        self._weights = self.basis.dx  # element, point

        self.dofs = 3 * self.basis.N
        self._nodal_elements = self.basis.element_dofs.T
        element_dofs = (3 * self._nodal_elements[:, :, None] + np.arange(3)).reshape(self._elements, -1)
        free = np.setdiff1d(np.arange(self.dofs), self._clamped_dofs())
        self.assembler = BandedAssembler(element_dofs.astype(np.int64), free, self.dofs)

        nu = poisson_ratio
        law = youngs_modulus / (1 - nu**2) * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
        self._membrane_law = thickness * law
        self._bending_law = thickness**3 / 12 * law

    @property
    def bending_stiffness(self) -> float:
        """D = E h^3 / 12 (1 - nu^2) [N mm]."""
        return float(self._bending_law[0, 0])

    @cached_property
    def nodes(self) -> Array:
        """Rest positions [mm], shape [nodes, 3]."""
        return np.column_stack([self.mesh.p.T, np.zeros(self.mesh.p.shape[1])])

    @cached_property
    def border(self) -> np.ndarray:
        """True for nodes on the plate's edge, shape [nodes]."""
        x, y = self.mesh.p
        tolerance = 1e-9 * self.side
        return (np.minimum(x, y) < tolerance) | (np.maximum(x, y) > self.side - tolerance)

    def _clamped_dofs(self) -> np.ndarray:
        value, slope_x, slope_y, twist = self.basis.nodal_dofs
        x, y = self.mesh.p
        tolerance = 1e-9 * self.side
        vertical = (x < tolerance) | (x > self.side - tolerance)
        horizontal = (y < tolerance) | (y > self.side - tolerance)
        fixed = [3 * slope_x[self.border] + 2, 3 * slope_y[self.border] + 2, 3 * twist[self.border] + 2]
        for component in range(3):
            fixed += [3 * value[self.border] + component]
            # A displacement that vanishes along an edge has no slope along that edge either.
            fixed += [3 * slope_y[vertical] + component, 3 * slope_x[horizontal] + component]
        return np.unique(np.concatenate(fixed))

    # -- loads ---------------------------------------------------------------------------------------

    def disc_load(
        self, centre: tuple[float, float], radius: float, force: tuple[float, float, float]
    ) -> Array:
        """Dead load of the given resultant, spread as (1 - r^2/R^2)^2 over a disc.

        Args:
            centre: of the disc [mm].
            radius: R [mm].
            force: the resultant [N].

        Returns:
            Work-conjugate nodal loads over all degrees of freedom, shape [dofs].

        Raises:
            ParameterError: the disc does not lie inside the plate.
        """
        if min(centre) < radius or max(centre) > self.side - radius:
            raise ParameterError(
                f"a disc of radius {radius} at {centre} leaves the plate of side {self.side}"
            )
        corners = self.mesh.p[:, self.mesh.t]
        near = np.all(
            [
                (corners[axis].min(0) < centre[axis] + radius)
                & (corners[axis].max(0) > centre[axis] - radius)
                for axis in range(2)
            ],
            axis=0,
        )
        basis = Basis(
            self.mesh,
            self.basis.elem,
            quadrature=_tensor_rule(LOAD_GAUSS_POINTS),
            elements=np.flatnonzero(near),
        )
        x, y = basis.global_coordinates()
        squared = ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / radius**2
        density = np.clip(1 - squared, 0, None) ** 2 * basis.dx
        shares = np.zeros(self.basis.N)
        for function, dofs in zip(basis.basis, basis.element_dofs, strict=True):
            np.add.at(shares, dofs, (function[0] * density).sum(-1))
        return np.outer(shares / density.sum(), force).ravel()

    def point_load(self, point: tuple[float, float], force: tuple[float, float, float]) -> Array:
        """Concentrated force [N] at a point [mm], shape [dofs]."""
        shares = self.basis.probes(np.array(point, dtype=float)[:, None]).toarray().ravel()
        return np.outer(shares, force).ravel()

    def uniform_load(self, pressure: float) -> Array:
        """Dead pressure [MPa] along z, shape [dofs]."""
        load = np.zeros(self.basis.N)
        for function, dofs in zip(self.basis.basis, self.basis.element_dofs, strict=True):
            np.add.at(load, dofs, (function[0] * self._weights).sum(-1))
        return np.outer(load, [0, 0, pressure]).ravel()

    # -- states --------------------------------------------------------------------------------------

    def expand(self, x: Array) -> Array:
        """All degrees of freedom [..., dofs] from the free unknowns [..., unknowns]."""
        full = np.zeros((*x.shape[:-1], self.dofs))
        full[..., self.assembler.free] = x
        return full

    def displacements(self, x: Array) -> Array:
        """Nodal displacements [mm], shape [..., nodes, 3], from the free unknowns [..., unknowns]."""
        return self.nodal_values(self.expand(x))

    def nodal_values(self, full: Array) -> Array:
        """The entries of the displacement degrees of freedom, shape [..., nodes, 3], of [..., dofs]."""
        return full.reshape(*full.shape[:-1], -1, 3)[..., self.basis.nodal_dofs[0], :]

    def principal_membrane_strains(self, x: Array) -> Array:
        """Smaller and larger principal Green-Lagrange membrane strain at the Gauss points, [points, 2]."""
        x1, x2, *_ = self._surface(x)
        e11, e22, twice_e12 = _membrane(x1, x2)
        mean, radius = (e11 + e22) / 2, np.hypot(e11 - e22, twice_e12) / 2
        return np.stack([mean - radius, mean + radius], axis=-1)

    # -- energy and its derivatives --------------------------------------------------------------------

    def _surface(self, x: Array) -> tuple[Array, Array, Array, Array, Array]:
        """x_,1  x_,2  x_,11  x_,22  x_,12 of the deformed midsurface, each of shape [3, points]."""
        nodal = self.expand(x).reshape(-1, 3)[self._nodal_elements]
        slots = (self._operator @ nodal).reshape(-1, 5, 3).transpose(1, 2, 0)
        x1, x2, x11, x22, x12 = np.ascontiguousarray(slots)
        x1[0] += 1
        x2[1] += 1
        return x1, x2, x11, x22, x12

    def energy_and_force(self, x: Array) -> tuple[float, Array]:
        """Stored energy [N mm] and internal force on the free unknowns, shape [unknowns]."""
        x1, x2, x11, x22, x12 = self._surface(x)
        frame = _Frame(x1, x2, x11, x22, x12)
        strain = _membrane(x1, x2)
        tension = self._membrane_law @ strain
        moment = self._bending_law @ frame.curvature
        weights = self._weights.ravel()
        energy = 0.5 * float(((strain * tension).sum(0) + (frame.curvature * moment).sum(0)) @ weights)

        slope = -frame.slope_coefficients(moment)  # [2, points]
        gradient = np.empty((5, 3, weights.size))
        gradient[0] = tension[0] * x1 + tension[2] * x2 + slope[0] * frame.normal
        gradient[1] = tension[1] * x2 + tension[2] * x1 + slope[1] * frame.normal
        gradient[2] = moment[0] * frame.normal
        gradient[3] = moment[1] * frame.normal
        gradient[4] = 2 * moment[2] * frame.normal
        gradient *= weights
        per_element = gradient.transpose(2, 0, 1).reshape(self._elements, -1, 3)
        return energy, self.assembler.vector(self._operator_transposed @ per_element)

    def stiffness(self, x: Array) -> Array:
        """Exact second derivative of the stored energy, assembled (banded)."""
        x1, x2, x11, x22, x12 = self._surface(x)
        frame = _Frame(x1, x2, x11, x22, x12)
        tension = self._membrane_law @ _membrane(x1, x2)
        moment = self._bending_law @ frame.curvature
        points = x1.shape[1]

        # First variation of (E, k) with respect to the five derivative slots, three components each.
        variation = np.zeros((points, 6, 5, 3))
        variation[:, 0, 0] = x1.T
        variation[:, 1, 1] = x2.T
        variation[:, 2, 0] = x2.T
        variation[:, 2, 1] = x1.T
        factors = np.zeros((3, 5, points))  # d k_c = n . sum_r factors[c, r] d(slot r)
        for c, factor in enumerate((1.0, 1.0, 2.0)):
            factors[c, 0] = -factor * frame.christoffel[0][c]
            factors[c, 1] = -factor * frame.christoffel[1][c]
            factors[c, 2 + c] = factor
        variation[:, 3:] = factors.transpose(2, 0, 1)[..., None] * frame.normal.T[:, None, None, :]
        law = np.zeros((6, 6))
        law[:3, :3], law[3:, 3:] = self._membrane_law, self._bending_law
        rows = variation.reshape(points, 6, 15)
        hessian = (rows.swapaxes(1, 2) @ (law @ rows)).reshape(points, 5, 3, 5, 3)

        # Second variation of E: the initial-stress stiffness.
        for a, b, resultant in ((0, 0, 0), (1, 1, 1), (0, 1, 2), (1, 0, 2)):
            for component in range(3):
                hessian[:, a, component, b, component] += tension[resultant]

        # Second variation of k = n . x_,ab; with d n = -(n . d x_,a) a^a, twice.
        slot_moment = np.einsum("cp,crp->rp", moment, factors)
        total = (moment * frame.curvature).sum(0)
        for a, dual in enumerate(frame.dual):
            outer = np.einsum("ip,jp->pij", frame.normal, dual)
            for r in range(5):
                term = slot_moment[r][:, None, None] * outer
                hessian[:, a, :, r, :] -= term
                hessian[:, r, :, a, :] -= term.swapaxes(1, 2)
        normals = np.einsum("ip,jp->pij", frame.normal, frame.normal)
        for a in range(2):
            for b in range(2):
                hessian[:, a, :, b, :] -= (total * frame.inverse_metric[a][b])[:, None, None] * normals

        hessian *= self._weights.reshape(-1, 1, 1, 1, 1)
        n, q, f = self._elements, self._points, self._functions
        half = hessian.transpose(0, 1, 2, 4, 3).reshape(n, q, 45, 5) @ self._derivatives
        full = self._operator_transposed @ half.reshape(n, q * 5, 9 * f)
        matrices = full.reshape(n, f, 3, 3, f).transpose(0, 1, 2, 4, 3).reshape(n, 3 * f, 3 * f)
        return self.assembler.matrix(matrices)


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Array, b: Array) -> Array:
    """Cross product along the leading axis; several times faster than np.cross on this layout."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
    )


def _membrane(x1: Array, x2: Array) -> Array:
    """Green-Lagrange membrane strain (E_11, E_22, 2 E_12), shape [3, points]."""
    return np.stack([0.5 * (_dot(x1, x1) - 1), 0.5 * (_dot(x2, x2) - 1), _dot(x1, x2)])


class _Frame:
    """Normal, dual basis, Christoffel symbols and curvature of the deformed surface, per point."""

    def __init__(self, x1: Array, x2: Array, x11: Array, x22: Array, x12: Array) -> None:
        area = _cross(x1, x2)
        self.normal = area / np.sqrt(_dot(area, area))
        g11, g22, g12 = _dot(x1, x1), _dot(x2, x2), _dot(x1, x2)
        determinant = g11 * g22 - g12**2
        i11, i22, i12 = g22 / determinant, g11 / determinant, -g12 / determinant
        self.inverse_metric = ((i11, i12), (i12, i22))
        self.dual = (i11 * x1 + i12 * x2, i12 * x1 + i22 * x2)
        second = (x11, x22, x12)
        self.christoffel = tuple(tuple(_dot(dual, s) for s in second) for dual in self.dual)
        self.curvature = np.stack(
            [_dot(self.normal, x11), _dot(self.normal, x22), 2 * _dot(self.normal, x12)]
        )

    def slope_coefficients(self, moment: Array) -> Array:
        """sum_c M_c Gamma^a_c with the twist counted twice, shape [2, points]."""
        return np.stack(
            [g[0] * moment[0] + g[1] * moment[1] + 2 * g[2] * moment[2] for g in self.christoffel]
        )
