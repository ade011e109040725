"""Pickles of GGNS (Linkerhägner et al. 2023, https://github.com/jlinki/GGNS): NAME_train.pkl, _eval.pkl, _test.pkl.

Each is a list of trajectories, and a trajectory is a dict of arrays; what the point clouds saw is not used.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.imports.pickles import read_pickle
from m3gn_bench.datasets.imports.source import Facts, Found, array, files_by_split
from m3gn_bench.datasets.schema import Split

MATERIAL_UNITS = {"poisson_ratio": "1"}


@dataclass(frozen=True)
class Names:
    """Entries of a trajectory."""

    positions: str
    cells: str
    collider: str
    collider_edges: str | None
    dimension: int
    facts: Facts


TASKS = {
    # "Deformable Plate": the base lies at y = -100, and its authors divide all positions by 100.
    "deformable_block": Names(
        positions="nodes_grid",
        cells="triangles_grid",
        collider="nodes_collider",
        collider_edges="edge_index_collider",
        dimension=2,
        facts=Facts(
            simulator="SOFA",
            dt=0.01,
            time_unit="s",
            material_units=MATERIAL_UNITS,
            scale_centre=(0.0, 0.0),
            scale_length=100.0,
        ),
    ),
    "tissue_manipulation": Names(
        positions="tissue_mesh_positions",
        cells="tissue_mesh_triangles",
        collider="gripper_position",
        collider_edges=None,
        dimension=3,
        facts=Facts(simulator="SOFA", material_units=MATERIAL_UNITS),
    ),
}


class GgnsSource:
    """The files of one dataset; one at a time is in memory.

    Args:
        paths: the files, or their folder.
        task: whose entries to read.
    """

    def __init__(self, paths: Sequence[Path], task: str) -> None:
        self.names = TASKS[task]
        self.facts = self.names.facts
        self.files = files_by_split(paths, ".pkl")
        self.splits = list(self.files)

    def open(self, split: Split) -> tuple[int, Iterator[Found]]:
        """Number of trajectories of a split, and the trajectories."""
        path = self.files[split]
        entries = read_pickle(path)
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise DatasetError(f"{path} holds no list of trajectories, each a dict of arrays")
        return len(entries), (
            self._found(entry, f"{path}, trajectory {i}") for i, entry in enumerate(entries)
        )

    def _found(self, entry: dict, where: str) -> Found:
        names, dimension = self.names, self.names.dimension
        positions = array(entry, names.positions, where, (None, None, dimension))
        if names.collider_edges is None:  # a single point, with an axis of its own or without
            own_axis = getattr(entry.get(names.collider), "ndim", 2) == 3
            shape = (None, 1, dimension) if own_axis else (None, dimension)
            path = array(entry, names.collider, where, shape).reshape(-1, 1, dimension)
            edges = None
        else:
            path = array(entry, names.collider, where, (None, None, dimension))
            pairs = array(entry, names.collider_edges, where, (None, 2), whole=True)
            edges = np.unique(np.sort(pairs, axis=1), axis=0)  # both directions are listed
        return Found(
            where=where,
            positions=positions,
            cells=array(entry, names.cells, where, (None, 3), whole=True),
            material={name: float(array(entry, name, where, ())) for name in MATERIAL_UNITS},
            collider_positions=path,
            collider_edges=edges,
        )
