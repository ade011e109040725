"""Soft solids that fall on a rigid floor: explicit finite elements on tetrahedra, in Warp.

To the stable neo-Hookean energy (see `tetrahedra`) comes Kelvin-Voigt viscosity, with the
second Piola-Kirchhoff stress 2 eta dE/dt, which is objective. Without it nothing converges after an impact,
which excites every frequency that the mesh has.

The floor is z = 0: a node that would pass it within the step gets the velocity with which it just arrives,
and Coulomb's law limits the tangential impulse by the same normal one. No penalty, so no parameter and no
limit on the step.

Time: leapfrog in double precision. Forces are written per tetrahedron and gathered per node, without
atomics, so the result does not depend on the order of execution. The same code runs on CPU and CUDA.
"""

from functools import cached_property
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.generators.solvers.captured import CapturedSolid
from m3gn_bench.generators.solvers.explicit_kernels import (
    cell_volumes,
    corner_forces,
    move,
    nodal_pressures,
    quadratic_forces,
)
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import (
    QUADRATIC_GRADIENTS,
    Array,
    Element,
    SolidOptions,
)

MIN_SUBSTEPS = 20  # per frame; resolves the impact of the softest bodies


class ExplicitSolid(CapturedSolid):
    """A soft solid over a rigid floor, moved by leapfrog.

    Args:
        vertices, tetrahedra, element, options: see `TetrahedralSolid`.
        device: of Warp, "cpu" or "cuda:0".

    Raises:
        ParameterError: see `TetrahedralSolid`.
    """

    captured = 50

    def __init__(
        self,
        vertices: Array,
        tetrahedra: NDArray[np.int32],
        *,
        element: Element = "nodal pressure",
        device: str = "cpu",
        **options: Unpack[SolidOptions],
    ) -> None:
        super().__init__(vertices, tetrahedra, element=element, **options)
        self.device = device

        # The cells' nodes, sorted: what a node gathers, always in the same order.
        flat = self.element_nodes.ravel()
        incident = np.argsort(flat, kind="stable")
        start = np.searchsorted(flat[incident], np.arange(self.nodes + 1))
        if element == "quadratic":
            self._element_nodes = self._upload(self.element_nodes, wp.int32)
            self._gradients = self._upload(QUADRATIC_GRADIENTS, wp.vec3d)
        else:
            self._tetrahedra = self._upload(self.tetrahedra, wp.vec4i)
        self._rest = self._upload(self.inverse_edges, wp.mat33d)
        self._volumes = self._upload(self.volumes, wp.float64)
        self._nodal_volumes = self._upload(self.nodal_volumes, wp.float64)
        self._inverse_mass = self._upload(self.inverse_masses, wp.float64)
        self._incident = self._upload(incident, wp.int32)
        self._start = self._upload(start, wp.int32)
        self._cell_volumes = wp.zeros(self.cells, dtype=wp.float64, device=device)
        self._pressures = wp.zeros(self.nodes, dtype=wp.float64, device=device)
        self._forces = wp.zeros(self.element_nodes.size, dtype=wp.vec3d, device=device)
        self._x = wp.zeros(self.nodes, dtype=wp.vec3d, device=device)
        self._v = wp.zeros(self.nodes, dtype=wp.vec3d, device=device)

    def _upload(self, values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self.device)

    # -- the stable step -------------------------------------------------------------------------------

    @cached_property
    def highest_damping_rate(self) -> float:
        """Largest rate at which viscosity damps a velocity field at rest [1/s]."""
        return self.largest_eigenvalue(self.viscosity, 0.0) if self.viscosity else 0.0

    def substeps(self, frame_time: float, courant: float) -> int:
        """Substeps per frame that keep leapfrog at `courant` times its limit of stability at rest."""
        # x'' = -r x' - omega^2 x, with the damping taken of the last half step, is stable up to this step.
        omega, r = self.highest_frequency, self.highest_damping_rate
        limit = (np.sqrt(r**2 + 4 * omega**2) - r) / omega**2
        return max(MIN_SUBSTEPS, int(np.ceil(frame_time / (courant * limit))))

    # -- motion ----------------------------------------------------------------------------------------

    def _earlier(self, positions: Array, velocities: Array, lag: float) -> Array:
        return velocities - self.accelerations(positions, velocities) * lag

    def _assign(self, positions: Array, velocities: Array) -> None:
        self._x.assign(np.ascontiguousarray(positions, dtype=np.float64))
        self._v.assign(np.ascontiguousarray(velocities, dtype=np.float64))

    def _state(self) -> tuple[np.ndarray, np.ndarray]:
        return self._x.numpy(), self._v.numpy()

    def accelerations(self, positions: Array, velocities: Array) -> Array:
        """By elasticity, viscosity and gravity [m/s^2], shape [nodes, 3]; the floor not counted."""
        self._assign(positions, velocities)
        self._launch_forces()
        by_corner = self._forces.numpy()
        forces = np.stack([self.gather(by_corner[:, axis]) for axis in range(3)], axis=1)
        gravity = np.where(self.inverse_masses > 0, -self.gravity, 0.0)
        return forces * self.inverse_masses[:, None] + gravity[:, None] * np.array([0.0, 0.0, 1.0])

    def _launch_forces(self) -> None:
        law = [self.mu, self.lam, self.viscosity]
        if self.element == "quadratic":
            body = [self._element_nodes, self._gradients, self._rest, self._volumes]
            self._launch(quadratic_forces, self.cells, self._x, self._v, *body, *law, self._forces)
            return
        body = [self._tetrahedra, self._rest, self._volumes]
        nodal_pressure = self.element == "nodal pressure"
        if nodal_pressure:
            self._launch(cell_volumes, self.cells, self._x, *body, self._cell_volumes)
            gather = [self._start, self._incident, self._nodal_volumes]
            self._launch(nodal_pressures, self.nodes, self._cell_volumes, *gather, self.lam, self._pressures)
        body += [self._pressures, *law, nodal_pressure]
        self._launch(corner_forces, self.cells, self._x, self._v, *body, self._forces)

    def _advance(self, substeps: int, substep: float) -> None:
        gather = [self._forces, self._start, self._incident, self._inverse_mass]
        world = [self.gravity, self.friction, self.floor, substep]
        for _ in range(substeps):
            self._launch_forces()
            self._launch(move, self.nodes, *gather, *world, self._x, self._v)

    def _launch(self, kernel: wp.Kernel, size: int, *inputs: object) -> None:
        wp.launch(kernel, dim=size, inputs=list(inputs), device=self.device)
