"""How every solver of falling bodies marches: frame by frame, by replaying a recorded graph of substeps."""

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, TetrahedralSolid


class CapturedSolid(TetrahedralSolid):
    """A solid on a device of Warp; a solver adds how several of them move.

    All solvers know velocities half a substep before positions.
    """

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
        (outcome,) = self.run_together(
            [self],
            [positions],
            [velocities],
            frames=frames,
            frame_time=frame_time,
            substeps=[substeps],
            first_frame=first_frame,
        )
        if isinstance(outcome, SolverError):
            raise outcome
        return outcome

    @classmethod
    def run_together(
        cls,
        solids: Sequence[Self],
        positions: Sequence[Array],
        velocities: Sequence[Array],
        *,
        frames: int,
        frame_time: float,
        substeps: Sequence[int],
        first_frame: int = 0,
    ) -> list[Motion | SolverError]:
        """Move several solids that know nothing of each other: each as `run` does, bit for bit.

        Args:
            solids, positions, velocities, substeps: one for each solid; see `run`.
            frames, frame_time, first_frame: the same for all; see `run`.

        Returns:
            Of each solid its motion, or the error that `run` raises.

        Raises:
            ParameterError: the solver cannot move these solids together.
        """
        raise NotImplementedError

    def _lost(self, frame: int, substeps: int) -> SolverError:
        return SolverError(
            f"frame {frame}: positions are not finite; "
            f"{self._effort(substeps)} per frame are too few: use more, or a softer body"
        )

    def _effort(self, substeps: int) -> str:
        """What may be too little, in words."""
        return f"{substeps} substeps"


def record(advance: Callable[[int], None], substeps: int, longest: int, device: str) -> Callable[[], None]:
    """What does so many substeps whenever it is called, without launching each of them again.

    Args:
        advance: launches as many substeps as it is told.
        substeps: how many.
        longest: about how many to record: enough to hide the launch, few enough to record.
        device: of Warp.
    """
    parts = next(k for k in range(max(1, substeps // longest), 0, -1) if substeps % k == 0)
    with wp.ScopedCapture(device=device) as capture:
        advance(substeps // parts)

    def play() -> None:
        for _ in range(parts):
            wp.capture_launch(capture.graph)

    return play


def march(
    play: Callable[[], None],
    state: Callable[[], tuple[np.ndarray, np.ndarray]],
    path: Array,
    speeds: Array,
    bodies: Sequence[slice],
) -> list[int | None]:
    """Compute frames 1, 2, ... until all are done, or no body is finite any more.

    Args:
        play: computes a frame.
        state: positions [m] and velocities [m/s] after it, shape [nodes, 3].
        path, speeds: written to, shape [frames, nodes, 3].
        bodies: the nodes of each body.

    Returns:
        Of each body the first frame whose positions are not finite.
    """
    lost: list[int | None] = [None] * len(bodies)
    for frame in range(1, len(path)):
        play()
        path[frame], speeds[frame] = state()
        finite = np.isfinite(path[frame]).all(1)
        for body, nodes in enumerate(bodies):
            if lost[body] is None and not finite[nodes].all():
                lost[body] = frame
        if None not in lost:
            break
    return lost
