"""The Sheet Deformation scene, quickly; `validation/` goes deeper."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.generators.sheet_deformation import SheetDeformation

MIDDLE = 112  # of 15 x 15 nodes


@pytest.fixture
def trajectory(smoke_file: Path) -> Trajectory:
    """One that may be damaged."""
    stored = TrajectoryDataset(smoke_file, "sheet_deformation", "test", "smoke")[0]
    return replace(stored, positions=stored.positions.copy(), diagnostics=dict(stored.diagnostics))


def clamped(trajectory: Trajectory) -> int:
    return int(np.flatnonzero(trajectory.mesh.node_type == FIXED)[0])


def fold(trajectory: Trajectory) -> None:
    """A node of the last frame, as it would be after passing its neighbour."""
    trajectory.positions[-1, MIDDLE, 0] += 25


def snap(trajectory: Trajectory) -> None:
    """From some frame on the sheet is where it would be after passing through the plane."""
    trajectory.positions[30:, :, 2] *= -1


@pytest.mark.parametrize(
    ("fault", "reasons"),
    [
        (lambda t: None, []),
        (lambda t: t.positions.__setitem__((20, 3, 1), np.nan), ["frame 20: positions are not finite"]),
        (
            lambda t: t.positions.__setitem__((7, clamped(t), 2), 0.5),
            ["frame 7: a clamped node moves by 0.5 mm"],
        ),
        (fold, ["frame 50: a cell folds over", "frame 50: the sheet snaps"]),
        (snap, ["frame 30: the sheet snaps"]),
        (
            lambda t: t.diagnostics.update(min_principal_strain=-0.4),
            ["frame 50: compressive membrane strain -0.400, beyond the material law's stability at -0.333"],
        ),
    ],
)
def test_faults_are_found(
    trajectory: Trajectory, fault: Callable[[Trajectory], None], reasons: list[str]
) -> None:
    fault(trajectory)
    found = SheetDeformation().check(trajectory)
    assert len(found) == len(reasons)
    assert all(problem.startswith(reason) for problem, reason in zip(found, reasons, strict=True)), found
