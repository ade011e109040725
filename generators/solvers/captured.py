"""How every solver of falling bodies marches: frame by frame, by replaying a recorded graph of substeps."""

from typing import ClassVar

import numpy as np

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, TetrahedralSolid


class CapturedSolid(TetrahedralSolid):
    """A solid on a device of Warp; a solver adds how it begins, what a substep does, and what it needs.

    Both solvers know velocities half a substep before positions.
    """

    captured: ClassVar[
        int
    ]  # substeps per recorded graph: long enough to hide the launch, short enough to record
    device: str

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
        """Move on from a state for `frames` frames of `frame_time` [s]; the first returned is the state given.

        Args:
            positions: [m], shape [nodes, 3].
            velocities: [m/s], shape [nodes, 3].
            frames: number of frames to compute.
            frame_time: time between frames [s].
            substeps: of the solver, per frame.
            first_frame: what to call the state given, in errors.

        Raises:
            SolverError: names the first frame whose positions are not finite.
        """
        substep = frame_time / substeps
        parts = next(k for k in range(max(1, substeps // self.captured), 0, -1) if substeps % k == 0)
        path = np.empty((frames + 1, self.nodes, 3))
        speeds = np.empty_like(path)
        path[0] = positions
        speeds[0] = self._earlier(positions, velocities, substep / 2)
        self._assign(path[0], speeds[0])
        with wp.ScopedCapture(device=self.device) as capture:
            self._advance(substeps // parts, substep)
        for frame in range(1, frames + 1):
            for _ in range(parts):
                wp.capture_launch(capture.graph)
            path[frame], speeds[frame] = self._state()
            if not np.isfinite(path[frame]).all():
                raise SolverError(
                    f"frame {first_frame + frame}: positions are not finite; "
                    f"{self._effort(substeps)} per frame are too few: use more, or a softer body"
                )
        return Motion(path, speeds, lag=substep / 2)

    def _earlier(self, positions: Array, velocities: Array, lag: float) -> Array:
        """The velocities [m/s] that this solver begins with: those of a time `lag` [s] earlier."""
        raise NotImplementedError

    def _assign(self, positions: Array, velocities: Array) -> None:
        """Put a state on the device."""
        raise NotImplementedError

    def _advance(self, substeps: int, substep: float) -> None:
        """Launch so many substeps of `substep` [s]."""
        raise NotImplementedError

    def _state(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities, from the device."""
        raise NotImplementedError

    def _effort(self, substeps: int) -> str:
        """What may be too little, in words."""
        return f"{substeps} substeps"
