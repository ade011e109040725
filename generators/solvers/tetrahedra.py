"""Soft solids on tetrahedra: mesh, mass, stable neo-Hookean energy; whoever moves them builds on this.

The energy is that of Smith, de Goes and Kim (Stable Neo-Hookean Flesh Simulation, 2018),

    W = mu/2 (|F|^2 - 3) - mu (J - 1) + mu/2 (J - 1)^2 + lambda/2 (J - 1)^2,

written so that its linearisation at rest has exactly the Lame constants mu and lambda. It stays finite where an
element inverts. Where lambda >> mu linear tetrahedra lock; the elements differ in how the last term is taken:

- "linear": of the one J of a linear tetrahedron. Locks.
- "nodal pressure": linear tetrahedra, of the volume ratio averaged over each node (average nodal pressure: Bonet
  and Burton, 1998).
- "quadratic": tetrahedra with a node on each edge and four Gauss points, of the volume ratio of the whole
  tetrahedron (mean dilatation: Nagtegaal, Parks and Rice, 1974). Mass is lumped in proportion to the consistent
  mass matrix's diagonal (Hinton, Rock and Zienkiewicz, 1976).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Required, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.generators.errors import ParameterError

Array = NDArray[np.float64]
Element = Literal["linear", "nodal pressure", "quadratic"]

EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])  # corners of a tetrahedron's edges
NEAR, FAR = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20  # barycentric coordinates of Gauss points


def _quadratic_gradients() -> Array:
    """Gradients of the ten shape functions at the four Gauss points of the unit tetrahedron, shape [4, 10, 3]."""
    weights = np.where(np.eye(4, dtype=bool), NEAR, FAR)[:, :, None]  # [point, corner, 1]
    slopes = np.concatenate([-np.ones((1, 3)), np.eye(3)])  # of the barycentric coordinates
    first, second = EDGES.T
    corners = (4 * weights - 1) * slopes
    edges = 4 * (weights[:, first] * slopes[second] + weights[:, second] * slopes[first])
    return np.concatenate([corners, edges], axis=1)


QUADRATIC_GRADIENTS = _quadratic_gradients()
QUADRATIC_MASSES = np.array(4 * [1 / 36] + 6 * [4 / 27])  # shares of a tetrahedron's mass


def lame_constants(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """mu and lambda [Pa] of an isotropic solid. Raises ParameterError outside E > 0, 0 <= nu < 0.5.

    With nu < 0 this energy is lower at J = 0 than at rest, so an auxetic body would collapse.
    """
    if not (youngs_modulus > 0 and 0 <= poisson_ratio < 0.5):
        raise ParameterError(
            f"youngs_modulus must be positive and poisson_ratio in [0, 0.5), not {youngs_modulus}, {poisson_ratio}"
        )
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    return mu, 2 * mu * poisson_ratio / (1 - 2 * poisson_ratio)


@dataclass(frozen=True)
class Motion:
    """What a solver returns.

    Attributes:
        positions: of all nodes [m], shape [frames, nodes, 3].
        velocities: [m/s], shape [frames, nodes, 3].
        lag: by how much the velocities are earlier than the positions [s].
    """

    positions: Array
    velocities: Array
    lag: float


class SolidOptions(TypedDict, total=False):
    """What every solver takes; see `TetrahedralSolid`."""

    density: Required[float]
    youngs_modulus: Required[float]
    poisson_ratio: Required[float]
    viscosity: float
    friction: float
    gravity: float
    floor: bool
    fixed: NDArray[np.integer] | None


class TetrahedralSolid:
    """A soft solid on tetrahedra, and the rigid floor z = 0 that it may fall on.

    Args:
        vertices: stress-free positions of the corners [m], shape [corners, 3].
        tetrahedra: their indices, positively oriented, shape [cells, 4].
        density: [kg/m^3].
        youngs_modulus: [Pa].
        poisson_ratio: nu in [0, 0.5).
        viscosity: eta [Pa s].
        friction: Coulomb's coefficient of the floor.
        gravity: [m/s^2].
        floor: whether there is one.
        fixed: nodes that do not move.
        element: see the module.

    Attributes:
        vertices: stress-free positions of all nodes, shape [nodes, 3]; the corners first, then those on edges.
        element_nodes: of each cell, shape [cells, 4 or 10].

    Raises:
        ParameterError: a parameter out of its physical range, no such element, or a tetrahedron without volume.
    """

    def __init__(
        self,
        vertices: Array,
        tetrahedra: NDArray[np.int32],
        *,
        density: float,
        youngs_modulus: float,
        poisson_ratio: float,
        viscosity: float = 0.0,
        friction: float = 0.0,
        gravity: float = 9.81,
        floor: bool = True,
        fixed: NDArray[np.integer] | None = None,
        element: Element,
    ) -> None:
        if element not in get_args(Element):
            raise ParameterError(unknown_name("element", element, list(get_args(Element))))
        self.mu, self.lam = lame_constants(youngs_modulus, poisson_ratio)
        if density <= 0:
            raise ParameterError(f"density must be positive, not {density}")
        if viscosity < 0 or friction < 0:
            raise ParameterError(f"viscosity and friction must not be negative: {viscosity}, {friction}")
        self.density, self.viscosity, self.friction = density, viscosity, friction
        self.gravity, self.floor, self.element = gravity, floor, element
        self.vertices = np.asarray(vertices, dtype=np.float64)
        self.tetrahedra = np.asarray(tetrahedra, dtype=np.int32)
        self.cells = len(self.tetrahedra)

        corners = self.vertices[self.tetrahedra]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        self.volumes = np.linalg.det(edges) / 6
        if not self.volumes.min() > 0:
            raise ParameterError(f"tetrahedron {self.volumes.argmin()} has volume {self.volumes.min():.3g}")
        self.inverse_edges = np.linalg.inv(edges)
        # Gradients of the shape functions at Gauss points of equal weight, shape [cells, points, corners, 3].
        if element == "quadratic":
            pairs = np.sort(self.tetrahedra[:, EDGES], axis=-1).reshape(-1, 2)
            ends, places = np.unique(pairs, axis=0, return_inverse=True)
            middles = len(self.vertices) + places.reshape(-1, len(EDGES))
            self.element_nodes = np.concatenate([self.tetrahedra, middles], axis=1).astype(np.int32)
            self.vertices = np.concatenate([self.vertices, self.vertices[ends].mean(1)])
            self.gradients = np.einsum("pni,cij->cpnj", QUADRATIC_GRADIENTS, self.inverse_edges)
            shares = QUADRATIC_MASSES
        else:
            self.element_nodes = self.tetrahedra
            self.gradients = np.empty((self.cells, 1, 4, 3))
            self.gradients[:, 0, 1:] = self.inverse_edges
            self.gradients[:, 0, 0] = -self.inverse_edges.sum(1)
            shares = np.full(4, 1 / 4)
        self.nodes = len(self.vertices)
        self.nodal_volumes = self.gather((self.volumes[:, None] * shares).ravel())
        self.masses = density * self.nodal_volumes
        self.inverse_masses = 1 / self.masses
        if fixed is not None:
            self.inverse_masses[fixed] = 0.0

    def gather(self, values: Array) -> Array:
        """Sum values of the cells' nodes [cells * nodes of a cell] at the nodes [nodes]."""
        return np.asarray(np.bincount(self.element_nodes.ravel(), values, self.nodes))

    @cached_property
    def highest_frequency(self) -> float:
        """Largest natural frequency omega_max at rest [rad/s]."""
        return float(np.sqrt(self.largest_eigenvalue(self.mu, self.lam)))

    def largest_eigenvalue(self, mu: float, lam: float) -> float:
        """Of M^-1 K at rest, where K has the Lame constants mu and lam; fixed nodes have an infinite mass."""
        root = np.sqrt(np.repeat(self.inverse_masses, 3))

        def product(flat: Array) -> Array:
            displacement = (root * flat.ravel()).reshape(-1, 3)
            return root * self._linear_force(displacement, mu, lam).ravel()

        size = 3 * self.nodes
        operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
        start = np.random.default_rng(0).normal(size=size)
        return float(eigsh(operator, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0])

    def elastic_energy(self, positions: Array) -> float:
        """Stored energy [J]."""
        gradients = self._deformation_gradients(positions)
        return self._stored_energy(gradients, np.linalg.det(gradients))

    def monitor(self, motion: Motion) -> tuple[Array, Array]:
        """Energies and volume ratios at the moments at which velocities are known.

        Returns:
            Kinetic, elastic and gravitational energy [J], shape [frames, 3], and the smallest J in every
            tetrahedron, shape [frames, cells].
        """
        energies = np.empty((len(motion.positions), 3))
        ratios = np.empty((len(motion.positions), self.cells))
        for frame, (x, v) in enumerate(zip(motion.positions, motion.velocities, strict=True)):
            earlier = x - v * motion.lag
            gradients = self._deformation_gradients(earlier)
            jacobians = np.linalg.det(gradients)
            ratios[frame] = jacobians.min(1)
            energies[frame] = (
                0.5 * float(self.masses @ (v**2).sum(1)),
                self._stored_energy(gradients, jacobians),
                self.gravity * float(self.masses @ earlier[:, 2]),
            )
        return energies, ratios

    def _linear_force(self, displacement: Array, mu: float, lam: float) -> Array:
        points = self.gradients.shape[1]
        gradient = displacement[self.element_nodes].transpose(0, 2, 1)[:, None] @ self.gradients
        stress = mu * (gradient + gradient.swapaxes(2, 3))
        dilatation = np.trace(gradient, axis1=2, axis2=3).mean(1)
        if self.element == "nodal pressure":
            nodal = self.gather(np.repeat(self.volumes * dilatation / 4, 4)) / self.nodal_volumes
            dilatation = nodal[self.tetrahedra].mean(1)
        stress[..., [0, 1, 2], [0, 1, 2]] += lam * dilatation[:, None, None]
        forces = (self.gradients @ (stress * (self.volumes / points)[:, None, None, None])).sum(1)
        return np.stack([self.gather(forces[:, :, axis].ravel()) for axis in range(3)], axis=1)

    def _deformation_gradients(self, positions: Array) -> Array:
        """F at every Gauss point, shape [cells, points, 3, 3]."""
        corners = positions[self.element_nodes]
        if self.element == "quadratic":
            return np.asarray(corners.transpose(0, 2, 1)[:, None] @ self.gradients)
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        return np.asarray(edges @ self.inverse_edges)[:, None]

    def _stored_energy(self, gradients: Array, jacobians: Array) -> float:
        stretch = (gradients**2).sum((2, 3)) - 3
        density = self.mu / 2 * (stretch + (jacobians - 1) ** 2) - self.mu * (jacobians - 1)
        energy = float(self.volumes @ density.mean(1))
        ratios, volumes = jacobians.mean(1), self.volumes
        if self.element == "nodal pressure":
            ratios = self.gather(np.repeat(self.volumes * ratios / 4, 4)) / self.nodal_volumes
            volumes = self.nodal_volumes
        return energy + self.lam / 2 * float(volumes @ (ratios - 1) ** 2)
