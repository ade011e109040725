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
from m3gn_bench.datasets.file import damage_as_dataset_error, require_stored
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

FORCE_RADIUS = (
    10.0  # [mm], the authors'; nodes strictly within it, in the plane of the sheet, are told the force
)


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
            numbers = _array(_group(file, "splits"), f"{self.words[split]}_indices", (None,), whole=True)
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
        stored = _group(file, f"{task}/trajs/{trajectory}")
        positions = _array(stored, "mesh_pos", (None, None, dimension))
        path = edges = None
        if names.collider_cells is not None:
            path = _array(stored, "collider_pos", (None, None, dimension))
            edges = edges_of(_cells(file, names.collider_cells))
        parameters = _group(file, f"{task}/params")
        return Found(
            where=_place(stored),
            positions=positions,
            cells=_cells(file, names.cells),
            material={name: float(_array(parameters, name, ())) for name in self.facts.material_units},
            loads={"nodal_forces": _nodal_forces(_group(stored, "params"), positions)}
            if names.has_forces
            else {},
            collider_positions=path,
            collider_edges=edges,
            tags={"task": task, "trajectory": trajectory},
        )


def _place(group: h5py.Group) -> str:
    return f"{group.file.filename}: {group.name}"


def _group(group: h5py.Group, path: str) -> h5py.Group:
    """The group there. Raises DatasetError listing what is there instead, or if it is in another file."""
    for name in path.split("/"):
        group = _own(group, name)
    return group


def _own(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset:
    """What a group holds, unless a link leads out of the file, to whatever lies on the reader's machine."""
    found = required(group, name, _place(group))
    if found.file != group.file:
        raise DatasetError(f"{_place(group)}: {name} is in another file, which is not read")
    return found


def _array(group: h5py.Group, name: str, shape: tuple[int | None, ...], *, whole: bool = False) -> np.ndarray:
    """An array of this very file; see `array`."""
    require_stored(_own(group, name))
    return array(group, name, _place(group), shape, whole=whole)


def _cells(file: h5py.File, path: str) -> np.ndarray:
    folder, _, name = path.rpartition("/")
    return _array(_group(file, folder), name, (None, 3), whole=True)


def _nodal_forces(forces: h5py.Group, positions: np.ndarray) -> NDArray[np.float32]:
    """Every force, whole, at every node close to it; shape [nodes, 3].

    Forces that overlap are added up, in the one place that the task has for them; the authors' own models are told
    each by itself, and take the distance in space.

    Raises:
        DatasetError: a force is close to no node.
    """
    nodal = np.zeros(positions.shape[1:], np.float32)
    for name in forces:
        force = _group(forces, name)
        position = _array(force, "position", (3,))
        direction = _array(force, "direction", (3,))
        near = (np.linalg.norm(positions[:1, :, :2] - position[:2], axis=-1) < FORCE_RADIUS).any(0)
        if not near.any():
            raise DatasetError(f"{_place(force)}: the force is closer than {FORCE_RADIUS:g} mm to no node")
        nodal[near] += direction.astype(np.float32)
    return nodal
