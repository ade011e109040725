"""How every solver of falling bodies marches: frame by frame, by replaying a recorded graph of substeps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.quiet_warp import wp
from m3gn_bench.generators.solvers.tetrahedra import Array, Motion, TetrahedralSolid


@dataclass(frozen=True)
class Start:
    """What a solid moves on from, and with how many substeps of the solver per frame; see `CapturedSolid.run`."""

    positions: Array
    velocities: Array
    substeps: int


@dataclass(frozen=True)
class Course:
    """For how long solids move; see `CapturedSolid.run`."""

    frames: int
    frame_time: float
    first_frame: int = 0


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
        start, course = Start(positions, velocities, substeps), Course(frames, frame_time, first_frame)
        (outcome,) = self.run_together([self], [start], course)
        if isinstance(outcome, SolverError):
            raise outcome
        return outcome

    @classmethod
    def run_together(
        cls, solids: Sequence[Self], starts: Sequence[Start], course: Course
    ) -> list[Motion | SolverError]:
        """Move several solids that know nothing of each other: each as `run` does, bit for bit.

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
    positions: Array,
    velocities: Array,
    frames: int,
    bodies: Sequence[slice],
) -> tuple[Array, Array, list[int | None]]:
    """Compute frames 1, 2, ... until all are done, or no body is finite any more.

    Args:
        play: computes a frame.
        state: positions [m] and velocities [m/s] after it, shape [nodes, 3].
        positions, velocities: the same in frame 0.
        frames: how many to compute.
        bodies: the nodes of each body.

    Returns:
        Positions and velocities, shape [frames + 1, nodes, 3], and of each body the first frame whose positions are
        not finite.
    """
    path = np.empty((frames + 1, *positions.shape))
    speeds = np.empty_like(path)
    path[0], speeds[0] = positions, velocities
    lost: list[int | None] = [None] * len(bodies)
    for frame in range(1, frames + 1):
        play()
        path[frame], speeds[frame] = state()
        finite = np.isfinite(path[frame]).all(1)
        for body, nodes in enumerate(bodies):
            if lost[body] is None and not finite[nodes].all():
                lost[body] = frame
        if None not in lost:
            break
    return path, speeds, lost
