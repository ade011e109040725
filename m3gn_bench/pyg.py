"""Trajectories as graphs of PyTorch Geometric."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from m3gn_bench.data import both_directions, mesh_edges
from m3gn_bench.datasets.exports.parts import frame_times
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import VTK_TRIANGLE, Trajectory
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import ConfigError

if TYPE_CHECKING:
    from torch_geometric.data import Data

COLLIDER = 2  # node type, after FREE and FIXED


def to_pyg(trajectory: Trajectory, metadata: Metadata) -> "Data":
    """One trajectory as a graph: the nodes of the mesh, then those of the collider if there is one.

    Everything is in the physical units that `metadata` names. Nodes come first in every array that has them,
    so that `torch_geometric.loader.DataLoader` can put graphs of different meshes together.

    Args:
        trajectory: e.g. of a `TrajectoryDataset`, whose `metadata` is the second argument.
        metadata: of its dataset.

    Returns:
        A `Data` of
            positions: [nodes, frames, dim];
            pos: at rest (the collider: in frame 0), [nodes, dim];
            node_type: 0 free, 1 fixed, 2 collider, [nodes];
            edge_index: both directions of every edge of the cells, then of the collider's own, [2, edges];
            edge_type: 0 mesh, 1 collider, [edges];
            face: of triangles, [3, cells]; or tetra_index: of tetrahedra, [4, cells];
            time: [1, frames];
            material: [1, parameters], in the order of the list of words material_names;
            load_<name>: [nodes, ...] where the load has a row per mesh node (0 at the collider), or [1, ...];
            scale_centre, scale_length: models see (positions - scale_centre) / scale_length; [1, dim] and [1].

    Raises:
        ConfigError: PyTorch Geometric is missing.
    """
    try:
        from torch_geometric.data import Data
    except ImportError as error:
        raise ConfigError(f"graphs need torch_geometric ({error}); pip install 'm3gn-bench[pyg]'") from error

    mesh, collider = trajectory.mesh, trajectory.collider_positions
    frames, mesh_nodes, dimension = trajectory.positions.shape
    path = np.empty((frames, 0, dimension), np.float32) if collider is None else collider
    own_edges = trajectory.collider_edges
    edges = torch.from_numpy(mesh_edges(mesh.cells))
    collider_edges = torch.from_numpy(
        mesh_nodes + both_directions(np.empty((0, 2), np.int32) if own_edges is None else own_edges)
    )

    def with_collider(values: np.ndarray, of_collider: np.ndarray) -> Tensor:
        return torch.from_numpy(np.concatenate([values, of_collider]))

    def load(values: np.ndarray) -> Tensor:
        if values.ndim == 2 and len(values) == mesh_nodes:
            return with_collider(values, np.zeros((path.shape[1], values.shape[1]), values.dtype))
        return torch.from_numpy(values)[None]

    cells = torch.from_numpy(mesh.cells.T.astype(np.int64))
    return Data(
        positions=with_collider(trajectory.positions.swapaxes(0, 1), path.swapaxes(0, 1)),
        pos=with_collider(mesh.rest_positions, path[0]),
        node_type=with_collider(mesh.node_type.astype(np.int64), np.full(path.shape[1], COLLIDER)),
        edge_index=torch.cat([edges, collider_edges], dim=1),
        edge_type=torch.repeat_interleave(torch.tensor([edges.shape[1], collider_edges.shape[1]])),
        time=torch.from_numpy(frame_times(metadata)).float()[None],
        material=torch.tensor([list(trajectory.material.values())], dtype=torch.float32),
        material_names=list(trajectory.material),
        scale_centre=torch.tensor([metadata.scale_centre]),
        scale_length=torch.tensor([metadata.scale_length]),
        **{"face" if mesh.cell_type == VTK_TRIANGLE else "tetra_index": cells},
        **{f"load_{name}": load(values) for name, values in trajectory.loads.items()},
    )


def export_pyg(file: Path, key: str, out: Path) -> list[Path]:
    """Write the graph of a trajectory with `torch.save`; `Data.from_dict(torch.load(out))` reads it.

    The file holds tensors and words only, not a pickled object that would run code when it is loaded.

    Args:
        file: the dataset file.
        key: the trajectory's name in it.
        out: the file to write.

    Returns:
        The file written.

    Raises:
        ConfigError: PyTorch Geometric is missing.
        DatasetError: the dataset file is unusable, or `out` cannot be written.
    """
    with open_file(file) as opened:
        graph = to_pyg(read_trajectory(opened, key), read_metadata(opened))
    buffer = io.BytesIO()  # given a path that it cannot write, torch raises no OSError
    torch.save(graph.to_dict(), buffer)
    write_bytes_atomically(out, buffer.getvalue())
    return [out]
