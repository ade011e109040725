"""Soft solids on linear tetrahedra: mesh, mass, stable neo-Hookean energy; whoever moves them builds on this.

The energy is that of Smith, de Goes and Kim (Stable Neo-Hookean Flesh Simulation, 2018),

    W = mu/2 (|F|^2 - 3) - mu (J - 1) + mu/2 (J - 1)^2 + lambda/2 (J - 1)^2,

written so that its linearisation at rest has exactly the Lame constants mu and lambda. It stays finite where an
element inverts. Linear tetrahedra lock where lambda >> mu; with nodal pressure the last term is taken of the
volume ratio averaged over each node (average nodal pressure: Bonet and Burton, 1998).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Required, TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from m3gn_bench.generators.errors import ParameterError

Array = NDArray[np.float64]


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
        vertices: stress-free positions [m], shape [nodes, 3].
        tetrahedra: node indices, positively oriented, shape [cells, 4].
        density: [kg/m^3].
        youngs_modulus: [Pa].
        poisson_ratio: nu in [0, 0.5).
        viscosity: eta [Pa s].
        friction: Coulomb's coefficient of the floor.
        gravity: [m/s^2].
        floor: whether there is one.
        fixed: nodes that do not move.
        nodal_pressure: average the volume ratio over nodes; without it plain linear tetrahedra.

    Raises:
        ParameterError: a parameter out of its physical range, or a tetrahedron without volume.
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
        nodal_pressure: bool,
    ) -> None:
        self.mu, self.lam = lame_constants(youngs_modulus, poisson_ratio)
        if density <= 0:
            raise ParameterError(f"density must be positive, not {density}")
        if viscosity < 0 or friction < 0:
            raise ParameterError(f"viscosity and friction must not be negative: {viscosity}, {friction}")
        self.density, self.viscosity, self.friction = density, viscosity, friction
        self.gravity, self.floor, self.nodal_pressure = gravity, floor, nodal_pressure
        self.vertices = np.asarray(vertices, dtype=np.float64)
        self.tetrahedra = np.asarray(tetrahedra, dtype=np.int32)
        self.nodes, self.cells = len(self.vertices), len(self.tetrahedra)

        corners = self.vertices[self.tetrahedra]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        self.volumes = np.linalg.det(edges) / 6
        if not self.volumes.min() > 0:
            raise ParameterError(f"tetrahedron {self.volumes.argmin()} has volume {self.volumes.min():.3g}")
        self.inverse_edges = np.linalg.inv(edges)
        self.nodal_volumes = self.gather(np.repeat(self.volumes / 4, 4))
        self.masses = density * self.nodal_volumes
        self.inverse_masses = 1 / self.masses
        if fixed is not None:
            self.inverse_masses[fixed] = 0.0
        self.gradients = np.empty((self.cells, 4, 3))  # of the shape functions
        self.gradients[:, 1:] = self.inverse_edges
        self.gradients[:, 0] = -self.inverse_edges.sum(1)

    def gather(self, corner_values: Array) -> Array:
        """Sum values of the cells' corners [cells * 4] at the nodes [nodes]."""
        return np.asarray(np.bincount(self.tetrahedra.ravel(), corner_values, self.nodes))

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

    def volume_ratios(self, positions: Array) -> Array:
        """J of every tetrahedron, shape [cells]; negative where one is inverted."""
        return np.asarray(np.linalg.det(self._deformation_gradients(positions)))

    def elastic_energy(self, positions: Array) -> float:
        """Stored energy [J]."""
        gradients = self._deformation_gradients(positions)
        return self._stored_energy(gradients, np.linalg.det(gradients))

    def monitor(self, motion: Motion) -> tuple[Array, Array]:
        """Energies and volume ratios at the moments at which velocities are known.

        Returns:
            Kinetic, elastic and gravitational energy [J], shape [frames, 3], and J of every tetrahedron,
            shape [frames, cells].
        """
        energies = np.empty((len(motion.positions), 3))
        ratios = np.empty((len(motion.positions), self.cells))
        for frame, (x, v) in enumerate(zip(motion.positions, motion.velocities, strict=True)):
            earlier = x - v * motion.lag
            gradients = self._deformation_gradients(earlier)
            ratios[frame] = np.linalg.det(gradients)
            energies[frame] = (
                0.5 * float(self.masses @ (v**2).sum(1)),
                self._stored_energy(gradients, ratios[frame]),
                self.gravity * float(self.masses @ earlier[:, 2]),
            )
        return energies, ratios

    def _linear_force(self, displacement: Array, mu: float, lam: float) -> Array:
        gradient = displacement[self.tetrahedra].transpose(0, 2, 1) @ self.gradients
        stress = mu * (gradient + gradient.transpose(0, 2, 1))
        dilatation = np.trace(gradient, axis1=1, axis2=2)
        if self.nodal_pressure:
            nodal = self.gather(np.repeat(self.volumes * dilatation / 4, 4)) / self.nodal_volumes
            dilatation = nodal[self.tetrahedra].mean(1)
        stress[:, [0, 1, 2], [0, 1, 2]] += lam * dilatation[:, None]
        forces = self.gradients @ (stress * self.volumes[:, None, None])
        return np.stack([self.gather(forces[:, :, axis].ravel()) for axis in range(3)], axis=1)

    def _deformation_gradients(self, positions: Array) -> Array:
        corners = positions[self.tetrahedra]
        return (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1) @ self.inverse_edges

    def _stored_energy(self, gradients: Array, ratios: Array) -> float:
        stretch = (gradients**2).sum((1, 2)) - 3
        energy = float(self.volumes @ (self.mu / 2 * (stretch + (ratios - 1) ** 2) - self.mu * (ratios - 1)))
        volumes = self.volumes
        if self.nodal_pressure:
            ratios = self.gather(np.repeat(self.volumes * ratios / 4, 4)) / self.nodal_volumes
            volumes = self.nodal_volumes
        return energy + self.lam / 2 * float(volumes @ (ratios - 1) ** 2)
