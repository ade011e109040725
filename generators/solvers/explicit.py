"""Soft solids that fall on a rigid floor: explicit finite elements on tetrahedra, in Warp.

To the stable neo-Hookean energy (see `tetrahedra`) comes Kelvin-Voigt viscosity, with the
second Piola-Kirchhoff stress 2 eta dE/dt, which is objective. Without it nothing converges after an impact,
which excites every frequency that the mesh has.

The floor is z = 0: a node that would pass it within the step gets the velocity with which it just arrives,
and Coulomb's law limits the tangential impulse by the same normal one. No penalty, so no parameter and no
limit on the step.

Time: leapfrog in double precision. Forces are written per tetrahedron and gathered per node, without
atomics, so the result does not depend on the order of execution. The same code runs on CPU and CUDA. Several
solids can be moved at once, which is what keeps a GPU busy; each moves as it does alone, bit for bit.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, Self, Unpack

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.generators.errors import ParameterError, SolverError
from m3gn_bench.generators.solvers.captured import CapturedSolid, Course, Start, march, record
from m3gn_bench.generators.solvers.explicit_kernels import (
    cell_volumes,
    corner_forces,
    move,
    nodal_pressures,
    quadratic_forces,
)
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import (
    Array,
    Element,
    Motion,
    SolidOptions,
)

MIN_SUBSTEPS = 20  # per frame; resolves the impact of the softest bodies
RECORDED = 50  # substeps per graph, about


class ExplicitSolid(CapturedSolid):
    """A soft solid over a rigid floor, moved by leapfrog.

    Args:
        vertices, tetrahedra, element, options: see `TetrahedralSolid`.
        device: of Warp, "cpu" or "cuda:0".

    Raises:
        ParameterError: see `TetrahedralSolid`.
    """

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

    def accelerations(self, positions: Array, velocities: Array) -> Array:
        """By elasticity, viscosity and gravity [m/s^2], shape [nodes, 3]; the floor not counted."""
        return self._alone.accelerations(positions, velocities)

    @cached_property
    def _alone(self) -> "_Group":
        return _Group([self])

    @classmethod
    def run_together(
        cls, solids: Sequence[Self], starts: Sequence[Start], course: Course
    ) -> list[Motion | SolverError]:
        """All at once, on the device of the first; see `CapturedSolid`."""
        # Those with most substeps first: then those that are not done with a frame lie at the front of all arrays.
        order = sorted(range(len(solids)), key=lambda k: -starts[k].substeps)
        ordered, begun = [solids[k] for k in order], [starts[k] for k in order]
        group = ordered[0]._alone if len(ordered) == 1 else _Group(ordered)
        substeps = [start.substeps for start in begun]
        lengths = course.frame_time / np.array(substeps)
        positions = np.concatenate([start.positions for start in begun])
        velocities = np.concatenate([start.velocities for start in begun])
        lags = np.repeat(lengths / 2, [solid.nodes for solid in ordered])
        earlier = velocities - group.accelerations(positions, velocities) * lags[:, None]
        play = group.record(positions, earlier, lengths, substeps)
        path, speeds, lost = march(play, group.state, positions, earlier, course.frames, group.bodies)

        outcomes: dict[int, Motion | SolverError] = {}
        for k, nodes, length, frame in zip(order, group.bodies, lengths, lost, strict=True):
            outcomes[k] = (
                Motion(path[:, nodes], speeds[:, nodes], lag=float(length) / 2)
                if frame is None
                else solids[k]._lost(course.first_frame + frame, starts[k].substeps)
            )
        return [outcomes[k] for k in range(len(solids))]


_SHARED = ("element", "viscosity", "friction", "gravity", "floor", "device")


class _Group:
    """Solids side by side in the same arrays of a device: one launch works on all, or on the first few.

    Attributes:
        bodies: the nodes of each solid.

    Raises:
        ParameterError: they differ in what is not an array.
    """

    def __init__(self, solids: "Sequence[ExplicitSolid]") -> None:
        for name in _SHARED:
            values = {getattr(solid, name) for solid in solids}
            if len(values) > 1:
                raise ParameterError(
                    f"solids that move together must have one {name}, not {sorted(map(str, values))}"
                )
        one = solids[0]  # not kept: it may keep this group
        self.element, self.viscosity, self.friction = one.element, one.viscosity, one.friction
        self.gravity, self.floor, self.device = one.gravity, one.floor, one.device
        nodes, cells = [solid.nodes for solid in solids], [solid.cells for solid in solids]
        self.nodes_of_first = [0, *np.cumsum(nodes).tolist()]  # so many solids
        self.cells_of_first = [0, *np.cumsum(cells).tolist()]
        self.nodes = self.nodes_of_first[-1]
        self.bodies = [
            slice(*ends) for ends in zip(self.nodes_of_first, self.nodes_of_first[1:], strict=False)
        ]

        offset = np.repeat(self.nodes_of_first[:-1], cells)[:, None]
        self.element_nodes = (np.concatenate([s.element_nodes for s in solids]) + offset).astype(np.int32)
        self.inverse_masses = np.concatenate([solid.inverse_masses for solid in solids])
        # The cells' nodes, sorted: what a node gathers, always in the same order.
        flat = self.element_nodes.ravel()
        incident = np.argsort(flat, kind="stable")
        start = np.searchsorted(flat[incident], np.arange(self.nodes + 1))
        if self.element == "quadratic":
            self._element_nodes = self._upload(self.element_nodes, wp.int32)
        else:
            self._tetrahedra = self._upload(self.element_nodes, wp.vec4i)
        mu, lam = np.array([solid.mu for solid in solids]), np.array([solid.lam for solid in solids])
        self._mu = self._upload(np.repeat(mu, cells), wp.float64)
        self._lam = self._upload(np.repeat(lam, cells), wp.float64)
        self._nodal_lam = self._upload(np.repeat(lam, nodes), wp.float64)
        self._rest = self._upload(np.concatenate([solid.inverse_edges for solid in solids]), wp.mat33d)
        self._volumes = self._upload(np.concatenate([solid.volumes for solid in solids]), wp.float64)
        nodal_volumes = np.concatenate([solid.nodal_volumes for solid in solids])
        self._nodal_volumes = self._upload(nodal_volumes, wp.float64)
        self._inverse_mass = self._upload(self.inverse_masses, wp.float64)
        self._incident = self._upload(incident, wp.int32)
        self._start = self._upload(start, wp.int32)
        self._cell_volumes = self._zeros(len(self.element_nodes), wp.float64)
        self._pressures = self._zeros(self.nodes, wp.float64)
        self._forces = self._zeros(flat.size, wp.vec3d)
        self._substeps = self._zeros(self.nodes, wp.float64)
        self._x = self._zeros(self.nodes, wp.vec3d)
        self._v = self._zeros(self.nodes, wp.vec3d)

    def _upload(self, values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self.device)

    def _zeros(self, size: int, dtype: Any) -> Any:
        return wp.zeros(size, dtype=dtype, device=self.device)

    def accelerations(self, positions: Array, velocities: Array) -> Array:
        """See `ExplicitSolid`; of all nodes."""
        self._assign(positions, velocities)
        self._launch_forces(len(self.bodies))
        corners = self.element_nodes.ravel()
        by_axis = [np.bincount(corners, force, self.nodes) for force in self._forces.numpy().T]
        gravity = np.where(self.inverse_masses > 0, -self.gravity, 0.0)
        return np.stack(by_axis, axis=1) * self.inverse_masses[:, None] + gravity[:, None] * np.array(
            [0.0, 0.0, 1.0]
        )

    def record(
        self, positions: Array, velocities: Array, lengths: Array, substeps: Sequence[int]
    ) -> Callable[[], None]:
        """Put the solids into a state [m, m/s], and get what moves them on by a frame.

        Args:
            positions, velocities: of all nodes.
            lengths: of each solid's substeps [s].
            substeps: of each solid per frame, in descending order.
        """
        self._assign(positions, velocities)
        self._substeps.assign(np.repeat(lengths, np.diff(self.nodes_of_first)))
        plays, done = [], 0
        for moving in range(len(self.bodies), 0, -1):
            more = substeps[moving - 1] - done
            if more:
                plays.append(record(partial(self._advance, moving), more, RECORDED, self.device))
                done += more

        def play() -> None:
            for part in plays:
                part()

        return play

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and velocities [m/s], from the device."""
        return self._x.numpy(), self._v.numpy()

    def _assign(self, positions: Array, velocities: Array) -> None:
        self._x.assign(np.ascontiguousarray(positions, dtype=np.float64))
        self._v.assign(np.ascontiguousarray(velocities, dtype=np.float64))

    def _advance(self, moving: int, substeps: int) -> None:
        """Launch so many substeps of the first solids."""
        gather = [self._forces, self._start, self._incident, self._inverse_mass]
        world = [self.gravity, self.friction, self.floor, self._substeps]
        for _ in range(substeps):
            self._launch_forces(moving)
            self._launch(move, self.nodes_of_first[moving], *gather, *world, self._x, self._v)

    def _launch_forces(self, moving: int) -> None:
        nodes, cells = self.nodes_of_first[moving], self.cells_of_first[moving]
        law = [self._mu, self._lam, self.viscosity]
        if self.element == "quadratic":
            body = [self._element_nodes, self._rest, self._volumes]
            self._launch(quadratic_forces, cells, self._x, self._v, *body, *law, self._forces)
            return
        body = [self._tetrahedra, self._rest, self._volumes]
        nodal_pressure = self.element == "nodal pressure"
        if nodal_pressure:
            self._launch(cell_volumes, cells, self._x, *body, self._cell_volumes)
            gather = [self._start, self._incident, self._nodal_volumes, self._nodal_lam]
            self._launch(nodal_pressures, nodes, self._cell_volumes, *gather, self._pressures)
        body += [self._pressures, *law, nodal_pressure]
        self._launch(corner_forces, cells, self._x, self._v, *body, self._forces)

    def _launch(self, kernel: wp.Kernel, size: int, *inputs: object) -> None:
        wp.launch(kernel, dim=size, inputs=list(inputs), device=self.device)
