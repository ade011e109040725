"""Soft solids that fall on a rigid floor: explicit finite elements on linear tetrahedra, in Warp.

To the stable neo-Hookean energy with nodal pressure (see `tetrahedra`) comes Kelvin-Voigt viscosity, with the
second Piola-Kirchhoff stress 2 eta dE/dt, which is objective. Without it nothing converges after an impact,
which excites every frequency that the mesh has.

The floor is z = 0: a node that would pass it within the step gets the velocity with which it just arrives,
and Coulomb's law limits the tangential impulse by the same normal one. No penalty, so no parameter and no
limit on the step.

Time: leapfrog in double precision. Corner forces are written per tetrahedron and gathered per node, without
atomics, so the result does not depend on the order of execution. The same code runs on CPU and CUDA.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.explicit_kernels import (
    cell_volumes,
    corner_forces,
    move,
    nodal_pressures,
)
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, TetrahedralSolid

MIN_SUBSTEPS = 20  # per frame; resolves the impact of the softest bodies
CAPTURED = 50  # substeps per recorded graph: long enough to hide the launch, short enough to record fast


class ExplicitSolid(TetrahedralSolid):
    """A soft solid over a rigid floor, moved by leapfrog.

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
        nodal_pressure: average the volume ratio over nodes; without it plain linear tetrahedra.
        fixed: nodes that do not move.
        device: of Warp, "cpu" or "cuda:0".

    Raises:
        ValueError: a parameter out of its physical range, or a tetrahedron without volume.
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
        nodal_pressure: bool = True,
        fixed: NDArray[np.integer] | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(
            vertices,
            tetrahedra,
            density=density,
            youngs_modulus=youngs_modulus,
            poisson_ratio=poisson_ratio,
            gravity=gravity,
            nodal_pressure=nodal_pressure,
        )
        if viscosity < 0 or friction < 0:
            raise ValueError(f"viscosity and friction must not be negative: {viscosity}, {friction}")
        self.viscosity, self.friction, self.floor, self.device = viscosity, friction, floor, device
        self._gradients = np.empty((self.cells, 4, 3))  # of the shape functions
        self._gradients[:, 1:] = self.inverse_edges
        self._gradients[:, 0] = -self.inverse_edges.sum(1)
        self._inverse_masses = 1 / self.masses
        if fixed is not None:
            self._inverse_masses[fixed] = 0.0

        # Corners sorted by node: what a node gathers, always in the same order.
        flat = self.tetrahedra.ravel()
        incident = np.argsort(flat, kind="stable")
        start = np.searchsorted(flat[incident], np.arange(self.nodes + 1))
        self._tetrahedra = self._upload(self.tetrahedra, wp.vec4i)
        self._rest = self._upload(self.inverse_edges, wp.mat33d)
        self._volumes = self._upload(self.volumes, wp.float64)
        self._nodal_volumes = self._upload(self.nodal_volumes, wp.float64)
        self._inverse_mass = self._upload(self._inverse_masses, wp.float64)
        self._incident = self._upload(incident, wp.int32)
        self._start = self._upload(start, wp.int32)
        self._cell_volumes = wp.zeros(self.cells, dtype=wp.float64, device=device)
        self._pressures = wp.zeros(self.nodes, dtype=wp.float64, device=device)
        self._forces = wp.zeros(4 * self.cells, dtype=wp.vec3d, device=device)
        self._x = wp.zeros(self.nodes, dtype=wp.vec3d, device=device)
        self._v = wp.zeros(self.nodes, dtype=wp.vec3d, device=device)

    def _upload(self, values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self.device)

    # -- the stable step -------------------------------------------------------------------------------

    @cached_property
    def highest_frequency(self) -> float:
        """Largest natural frequency omega_max at rest [rad/s]."""
        return float(np.sqrt(self._largest_eigenvalue(self.mu, self.lam)))

    @cached_property
    def highest_damping_rate(self) -> float:
        """Largest rate at which viscosity damps a velocity field at rest [1/s]."""
        return self._largest_eigenvalue(self.viscosity, 0.0) if self.viscosity else 0.0

    def substeps(self, frame_time: float, courant: float) -> int:
        """Substeps per frame that keep leapfrog at `courant` times its limit of stability at rest."""
        # x'' = -r x' - omega^2 x, with the damping taken of the last half step, is stable up to this step.
        omega, r = self.highest_frequency, self.highest_damping_rate
        limit = (np.sqrt(r**2 + 4 * omega**2) - r) / omega**2
        return max(MIN_SUBSTEPS, int(np.ceil(frame_time / (courant * limit))))

    def _largest_eigenvalue(self, mu: float, lam: float) -> float:
        """Of M^-1 K at rest, where K has the Lame constants mu and lam."""
        root = np.sqrt(np.repeat(self._inverse_masses, 3))

        def product(flat: Array) -> Array:
            displacement = (root * flat.ravel()).reshape(-1, 3)
            return root * self._linear_force(displacement, mu, lam).ravel()

        size = 3 * self.nodes
        operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
        start = np.random.default_rng(0).normal(size=size)
        return float(eigsh(operator, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0])

    def _linear_force(self, displacement: Array, mu: float, lam: float) -> Array:
        gradient = displacement[self.tetrahedra].transpose(0, 2, 1) @ self._gradients
        stress = mu * (gradient + gradient.transpose(0, 2, 1))
        dilatation = np.trace(gradient, axis1=1, axis2=2)
        if self.nodal_pressure:
            nodal = self.gather(np.repeat(self.volumes * dilatation / 4, 4)) / self.nodal_volumes
            dilatation = nodal[self.tetrahedra].mean(1)
        stress[:, [0, 1, 2], [0, 1, 2]] += lam * dilatation[:, None]
        forces = self._gradients @ (stress * self.volumes[:, None, None])
        return np.stack([self.gather(forces[:, :, axis].ravel()) for axis in range(3)], axis=1)

    # -- motion ----------------------------------------------------------------------------------------

    def run(
        self,
        positions: Array,
        velocities: Array,
        *,
        frames: int,
        frame_time: float,
        substeps: int,
        first_frame: int = 0,
    ) -> Motion:
        substep = frame_time / substeps
        parts = next(k for k in range(max(1, substeps // CAPTURED), 0, -1) if substeps % k == 0)
        path = np.empty((frames + 1, self.nodes, 3))
        speeds = np.empty_like(path)
        path[0] = positions
        # Leapfrog's velocities live between positions: go back half a step.
        speeds[0] = velocities - self.accelerations(positions, velocities) * (substep / 2)
        self._x.assign(path[0])
        self._v.assign(speeds[0])
        with wp.ScopedCapture(device=self.device) as capture:
            for _ in range(substeps // parts):
                self._step(substep)
        for frame in range(1, frames + 1):
            for _ in range(parts):
                wp.capture_launch(capture.graph)
            path[frame], speeds[frame] = self._x.numpy(), self._v.numpy()
            if not np.isfinite(path[frame]).all():
                raise SolverError(
                    f"frame {first_frame + frame}: positions are not finite; {substeps} substeps per frame are too few"
                )
        return Motion(path, speeds, lag=substep / 2)

    def accelerations(self, positions: Array, velocities: Array) -> Array:
        """By elasticity, viscosity and gravity [m/s^2], shape [nodes, 3]; the floor not counted."""
        self._x.assign(np.ascontiguousarray(positions, dtype=np.float64))
        self._v.assign(np.ascontiguousarray(velocities, dtype=np.float64))
        self._launch_forces()
        by_corner = self._forces.numpy()
        forces = np.stack([self.gather(by_corner[:, axis]) for axis in range(3)], axis=1)
        gravity = np.where(self._inverse_masses > 0, -self.gravity, 0.0)
        return forces * self._inverse_masses[:, None] + gravity[:, None] * np.array([0.0, 0.0, 1.0])

    def _launch_forces(self) -> None:
        body = [self._tetrahedra, self._rest, self._volumes]
        if self.nodal_pressure:
            self._launch(cell_volumes, self.cells, self._x, *body, self._cell_volumes)
            gather = [self._start, self._incident, self._nodal_volumes]
            self._launch(nodal_pressures, self.nodes, self._cell_volumes, *gather, self.lam, self._pressures)
        law = [self.mu, self.lam, self.viscosity, self.nodal_pressure]
        self._launch(corner_forces, self.cells, self._x, self._v, *body, self._pressures, *law, self._forces)

    def _step(self, substep: float) -> None:
        self._launch_forces()
        gather = [self._forces, self._start, self._incident, self._inverse_mass]
        world = [self.gravity, self.friction, self.floor, substep]
        self._launch(move, self.nodes, *gather, *world, self._x, self._v)

    def _launch(self, kernel: wp.Kernel, size: int, *inputs: object) -> None:
        wp.launch(kernel, dim=size, inputs=list(inputs), device=self.device)
