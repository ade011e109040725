"""What moves in a trajectory, and where its arrays lie in the dataset file: for formats that only point there."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import CELL_CORNERS, Trajectory

VTK_VERTEX, VTK_LINE = 1, 3  # cells of a collider


@dataclass(frozen=True)
class StoredArray:
    """An array in the dataset file: its path there, shape and numpy dtype."""

    path: str
    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class Part:
    """The deformable mesh, or the collider.

    Attributes:
        name: "mesh" or "collider".
        positions: of shape [frames, nodes, dim].
        cells: node indices, of shape [cells, corners]; None: every node is a cell of its own.
        cell_type: VTK cell type of all cells.
        node_arrays: further arrays of one row per node, by name.
    """

    name: str
    positions: StoredArray
    cells: StoredArray | None
    cell_type: int
    node_arrays: dict[str, StoredArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Located:
    """One trajectory of a dataset file, its content verified.

    Attributes:
        file: the dataset file.
        key: the trajectory's name in it.
        metadata: of the file.
        trajectory: what is in it.
        parts: the mesh, then the collider if there is one.
    """

    file: Path
    key: str
    metadata: Metadata
    trajectory: Trajectory
    parts: tuple[Part, ...]

    def path_from(self, out: Path) -> str:
        """The dataset file as seen from a file that stands beside or near it, so that both can be moved."""
        return os.path.relpath(self.file.resolve(), out.parent.resolve())


def frame_times(metadata: Metadata) -> np.ndarray:
    """Time of each frame in the dataset's unit of time, shape [frames]."""
    return metadata.dt * np.arange(metadata.frames)


def read_located(file: Path, key: str) -> Located:
    """Read one trajectory and where its arrays lie.

    Raises:
        DatasetError: the file is damaged, or what it holds is no mesh that moves in two or three dimensions.
    """
    with open_file(file) as opened:
        metadata, trajectory = read_metadata(opened), read_trajectory(opened, key)
        mesh, positions = trajectory.mesh, trajectory.positions
        collider = trajectory.collider_positions
        if (
            positions.ndim != 3
            or positions.shape[0] != metadata.frames
            or positions.shape[2] not in (2, 3)
            or mesh.rest_positions.shape != positions.shape[1:]
            or CELL_CORNERS.get(mesh.cell_type) != mesh.cells.shape[-1]
            or (collider is not None and collider[:, :1].shape != positions[:, :1].shape)
        ):
            raise DatasetError(
                f"{file}: trajectory {key} is no moving mesh; 'm3gn-bench validate' tells what is wrong with it"
            )
        group = opened["trajectories"][key]
        parts = [
            Part(
                name="mesh",
                positions=_stored(group, "positions"),
                cells=_stored(group, "mesh/cells"),
                cell_type=mesh.cell_type,
                node_arrays={
                    name: _stored(group, f"mesh/{name}") for name in ("rest_positions", "node_type")
                },
            )
        ]
        if collider is not None:
            has_edges = trajectory.collider_edges is not None
            parts.append(
                Part(
                    name="collider",
                    positions=_stored(group, "collider_positions"),
                    cells=_stored(group, "collider_edges") if has_edges else None,
                    cell_type=VTK_LINE if has_edges else VTK_VERTEX,
                )
            )
    return Located(file, key, metadata, trajectory, tuple(parts))


def _stored(group: h5py.Group, name: str) -> StoredArray:
    dataset = group[name]
    return StoredArray(f"{group.name}/{name}", dataset.shape, dataset.dtype)
