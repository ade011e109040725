"""Soft solids that fall on a rigid floor, moved by Newton's vertex block descent, to compare with `explicit`.

Vertex block descent (Chen, Liu, Yang and Yuksel, 2024) takes steps of implicit Euler, each by Gauss-Seidel sweeps
over the nodes, colour by colour. Where the sweeps are too few the step is not solved: the solid is then softer
than E says, and can gain energy.

What Newton's parameters mean (release 1.8; the tests measure it):

- Its tetrahedral energy is that of `tetrahedra` without nodal pressure. It takes the Lame constants mu and lambda of
  small strain and makes those of Smith et al. (lambda + mu, alpha = 1 + mu / (lambda + mu)) of them itself.
- Its damping stress is 2 k_damp (C_now - C_before) / dt with C = F^T F, so 4 k_damp dE/dt: objective, and the
  Kelvin-Voigt viscosity of `explicit`, 2 eta dE/dt, where k_damp = eta / 2.
- Implicit Euler damps too, a mode of angular frequency omega with the ratio omega dt / 2. That is an error of first
  order in time; only shorter substeps make it smaller.
- The floor is a spring under each node, without damping, and Coulomb's law smoothed below FRICTION_SPEED.

Positions are in single precision. Newton takes velocities from their differences, so g dt^2 is rounded to the
spacing of floats: 80 substeps per 0.01 s lose a tenth of a fall of 0.4 m. Here they are the displacements that the
solver keeps, over dt, which loses a thousandth.

Which settings (teddy, drop from 0.5 m, error of the surface 0.2 s after the impact over its size, against `explicit`
without nodal pressure; CPU seconds per trajectory of 2 s on a busy core):

    iterations x substeps   E 3e5, nu 0.49   E 1e6, nu 0.499   seconds
    10 x 10                      3.5 %            34 %             20
    20 x 20                      1.7 %            9.5 %            70
    10 x 40                      0.8 %            5.3 %            65
     2 x 40                      1.7 %            20 %             13
     2 x 80                      0.9 %            7.2 %            28
     2 x 160                      -               2.6 %            58
     5 x 160                      -               2.3 %           130

Few iterations and many substeps are best at the same price; `explicit` needs 1 and 4 s for 0.2 % and less. In the
stiff case the last 2 % are friction's: without it 0.5 % are left, with it more substeps do not help. Over nine random
draws (nu up to 0.46) 2 x 40, 2 x 80 and 2 x 160 are off by 1.9, 0.9 and 0.45 % in the mean; at nu 0.499 the first two
gain energy in the impact (more than 1 % of it within a frame), the third does not.
"""

import logging
from collections.abc import Sequence
from functools import partial
from types import ModuleType
from typing import Self, Unpack

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.generators.errors import SolverError, require_installed
from m3gn_bench.generators.solvers.captured import CapturedSolid, Course, Start, march, record
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, SolidOptions
from m3gn_bench.generators.solvers.vbd_kernels import set_velocities

FLOOR_STIFFNESS = 1e7  # [N/m] per node; a node that carries 500 N sinks 0.05 mm into the skin
FLOOR_SKIN = 2e-4  # [m], the height at which the springs begin
FRICTION_SPEED = 1e-2  # [m/s], slower sliding is resisted less than Coulomb's law says
RECORDED = 10  # substeps per graph, about
ANYWHERE = 1e6  # [m], so far from the floor a node's contact is known beforehand


class VertexBlockDescent(CapturedSolid):
    """A soft solid on plain linear tetrahedra over a floor, moved by Newton's `SolverVBD`.

    Args:
        vertices: stress-free positions [m], shape [nodes, 3].
        tetrahedra: node indices, positively oriented, shape [cells, 4].
        iterations: sweeps over the nodes in each substep.
        device: of Warp, "cpu" or "cuda:0".
        options: see `TetrahedralSolid`.

    Raises:
        GeneratorError: Newton is not installed.
        ValueError: a parameter out of its physical range, or a tetrahedron without volume.
    """

    def __init__(
        self,
        vertices: Array,
        tetrahedra: NDArray[np.int32],
        *,
        iterations: int,
        device: str = "cpu",
        **options: Unpack[SolidOptions],
    ) -> None:
        super().__init__(vertices, tetrahedra, element="linear", **options)
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1, not {iterations}")
        newton = _newton()
        self.iterations, self.device = iterations, device

        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -self.gravity))
        if self.floor:
            surface = newton.ModelBuilder.ShapeConfig(ke=FLOOR_STIFFNESS, kd=0.0, mu=self.friction)
            builder.add_ground_plane(cfg=surface)
        builder.add_soft_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=self.vertices.tolist(),
            indices=self.tetrahedra.ravel().tolist(),
            density=self.density,
            k_mu=self.mu,
            k_lambda=self.lam,
            k_damp=self.viscosity / 2,
            add_surface_mesh_edges=False,
            particle_radius=FLOOR_SKIN,
        )
        self._free = self.inverse_masses > 0
        for node in np.flatnonzero(~self._free):
            builder.particle_mass[node] = 0.0
        builder.color()
        self._model = builder.finalize(device=device)
        self._model.soft_contact_ke = FLOOR_STIFFNESS
        self._model.soft_contact_kd = 0.0
        self._model.soft_contact_mu = self.friction
        self._solver = newton.solvers.SolverVBD(
            self._model,
            iterations=iterations,
            friction_epsilon=FRICTION_SPEED,
            particle_enable_self_contact=False,
            particle_enable_tile_solve=False,
            deterministic=wp.DeterministicMode.RUN_TO_RUN,
        )
        self._states = self._model.state(), self._model.state()
        self._control = self._model.control()
        self._contacts = None
        if self.floor:
            # Every node may touch the floor, always at the same height: found once, for all steps.
            pipeline = newton.CollisionPipeline(self._model, soft_contact_gap=ANYWHERE)
            self._contacts = pipeline.contacts()
            pipeline.collide(self._states[0], self._contacts)

    @classmethod
    def run_together(
        cls, solids: Sequence[Self], starts: Sequence[Start], course: Course
    ) -> list[Motion | SolverError]:
        """One after the other; see `CapturedSolid`."""
        return [solid._run(start, course) for solid, start in zip(solids, starts, strict=True)]

    def _run(self, start: Start, course: Course) -> Motion | SolverError:
        substep = course.frame_time / start.substeps
        # With half a step of gravity taken back, free fall is exact.
        earlier = np.where(self._free[:, None], start.velocities, 0.0)
        earlier[self._free, 2] += self.gravity * substep / 2
        self._states[0].particle_q.assign(start.positions.astype(np.float32))
        self._states[0].particle_qd.assign(earlier.astype(np.float32))
        play = record(partial(self._advance, substep), start.substeps, RECORDED, self.device)
        bodies = [slice(None)]
        path, speeds, (lost,) = march(play, self._state, start.positions, earlier, course.frames, bodies)
        if lost is not None:
            return self._lost(course.first_frame + lost, start.substeps)
        return Motion(path, speeds, lag=substep / 2)

    def _state(self) -> tuple[np.ndarray, np.ndarray]:
        return self._states[0].particle_q.numpy(), self._states[0].particle_qd.numpy()

    def _effort(self, substeps: int) -> str:
        return f"{self.iterations} iterations in {substeps} substeps"

    def _advance(self, substep: float, substeps: int) -> None:
        now, then = self._states
        for _ in range(substeps):
            self._solver.step(now, then, self._control, self._contacts, substep)
            moved = self._solver.particle_displacements
            inputs = [moved, substep, then.particle_qd]
            wp.launch(set_velocities, dim=self.nodes, inputs=inputs, device=self.device)
            now, then = then, now
        if now is not self._states[0]:
            wp.copy(self._states[0].particle_q, now.particle_q)
            wp.copy(self._states[0].particle_qd, now.particle_qd)


def _newton() -> ModuleType:
    require_installed("newton", "the solver newton-vbd", "newton")
    import newton

    logging.getLogger("newton").setLevel(logging.ERROR)
    return newton
