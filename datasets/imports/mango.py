"""HDF5 of MaNGO (Dahlinger et al. 2025, https://github.com/ALRhub/mango): one file, split by material.

/splits/<train|val|test>_indices    numbers of tasks; a task is a material
/task_<number>/params/<name>        the material
/task_<number>/trajs/traj_<number>/mesh_pos, collider_pos      [frames, nodes, dim]
/task_<number>/trajs/traj_<number>/params/<force>/direction, position      [3], Sheet Deformation alone
/global_data/cells                  Sheet Deformation ("planar bending")
/global_data/cell_indices/mesh_faces, collider_faces           Deformable Block ("deformable plate")
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import damage_as_dataset_error
from m3gn_bench.datasets.imports.source import (
    SPLIT_WORDS,
    UNKNOWN_UNIT,
    Facts,
    Found,
    array,
    edges_of,
    required,
)
from m3gn_bench.datasets.schema import Split

FORCE_RADIUS = 10.0  # [mm]; nodes strictly within it, in the plane of the sheet, are told the force


@dataclass(frozen=True)
class Names:
    """Where a task's meshes are."""

    cells: str
    collider_cells: str | None
    dimension: int
    has_forces: bool
    facts: Facts


TASKS = {
    "deformable_block": Names(
        cells="global_data/cell_indices/mesh_faces",
        collider_cells="global_data/cell_indices/collider_faces",
        dimension=2,
        has_forces=False,
        facts=Facts(
            simulator="SOFA",
            material_units={"poisson_ratio": "1", "youngs_modulus": "Pa"},
            scale_centre=(0.0, 0.0),
            scale_length=100.0,
        ),
    ),
    # The sheet's side is 140 mm, with a corner at the origin.
    "sheet_deformation": Names(
        cells="global_data/cells",
        collider_cells=None,
        dimension=3,
        has_forces=True,
        facts=Facts(
            simulator="Abaqus",
            length_unit="mm",
            material_units={"youngs_modulus": "MPa"},
            load_units={"nodal_forces": UNKNOWN_UNIT},
            scale_centre=(70.0, 70.0, 0.0),
            scale_length=70.0,
        ),
    ),
}


class MangoSource:
    """One file.

    Args:
        paths: the file, alone.
        task: whose meshes to read.

    Raises:
        DatasetError: not one file, damaged, or not of this layout.
    """

    def __init__(self, paths: Sequence[Path], task: str) -> None:
        if len(paths) != 1 or not paths[0].is_file():
            raise DatasetError(
                f"layout mango is one HDF5 file with all splits, not {' '.join(map(str, paths))}"
            )
        (self.path,) = paths
        self.names = TASKS[task]
        self.facts = self.names.facts
        with damage_as_dataset_error(str(self.path)), h5py.File(self.path) as file:
            words = {name.removesuffix("_indices") for name in _group(file, "splits")}
        self.words: dict[Split, str] = {SPLIT_WORDS[w]: w for w in sorted(words) if w in SPLIT_WORDS}
        self.splits = list(self.words)

    def open(self, split: Split) -> tuple[int, Iterator[Found]]:
        """Number of trajectories of a split, and the trajectories."""
        with damage_as_dataset_error(str(self.path)), h5py.File(self.path) as file:
            name = f"{self.words[split]}_indices"
            numbers = array(file["splits"], name, f"{self.path}: /splits", (None,), whole=True)
            pairs = [
                (task, trajectory)
                for task in (f"task_{number:03d}" for number in numbers)
                for trajectory in sorted(_group(file, f"{task}/trajs"))
            ]
        return len(pairs), self._read(pairs)

    def _read(self, pairs: list[tuple[str, str]]) -> Iterator[Found]:
        with damage_as_dataset_error(str(self.path)), h5py.File(self.path) as file:
            for task, trajectory in pairs:
                yield self._found(file, task, trajectory)

    def _found(self, file: h5py.File, task: str, trajectory: str) -> Found:
        names, dimension = self.names, self.names.dimension
        place = f"{task}/trajs/{trajectory}"
        where = f"{self.path}: /{place}"
        stored = _group(file, place)
        positions = array(stored, "mesh_pos", where, (None, None, dimension))
        path = edges = None
        if names.collider_cells is not None:
            path = array(stored, "collider_pos", where, (None, None, dimension))
            edges = edges_of(_cells(file, names.collider_cells))
        parameters = _group(file, f"{task}/params")
        return Found(
            where=where,
            positions=positions,
            cells=_cells(file, names.cells),
            material={
                name: float(array(parameters, name, f"{self.path}: /{task}/params", ()))
                for name in self.facts.material_units
            },
            loads={"nodal_forces": _nodal_forces(file, place, positions[0])} if names.has_forces else {},
            collider_positions=path,
            collider_edges=edges,
            tags={"task": task, "trajectory": trajectory},
        )


def _group(file: h5py.File, place: str) -> h5py.Group:
    """The group at a place. Raises DatasetError listing what is there instead."""
    group = file
    for name in place.split("/"):
        group = required(group, name, f"{file.filename}: {group.name}")
    return group


def _cells(file: h5py.File, place: str) -> np.ndarray:
    folder, _, name = place.rpartition("/")
    return array(_group(file, folder), name, f"{file.filename}: /{folder}", (None, 3), whole=True)


def _nodal_forces(file: h5py.File, place: str, sheet: np.ndarray) -> NDArray[np.float32]:
    """Every force, whole, at every node close to it, as the authors' own models are told; shape [nodes, 3]."""
    forces = np.zeros(sheet.shape, np.float32)
    for name, group in _group(file, f"{place}/params").items():
        where = f"{file.filename}: /{place}/params/{name}"
        position = array(group, "position", where, (3,))
        direction = array(group, "direction", where, (3,))
        distance = np.linalg.norm(sheet[:, :2] - position[:2], axis=1)
        forces[distance < FORCE_RADIUS] += direction.astype(np.float32)
    return forces
