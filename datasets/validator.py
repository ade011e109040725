"""Check a dataset file from top to bottom and report every problem under a stable code.

Errors make a file unusable; warnings (codes W...) are things to know, and fail only a strict check.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import open_file, read_metadata
from m3gn_bench.datasets.schema import SPLITS, Metadata, Record, tier_sizes, trajectory_key
from m3gn_bench.datasets.trajectory import (
    CELL_CORNERS,
    FIXED,
    VTK_TETRA,
    Mesh,
    Trajectory,
    combine_hashes,
)

CODES = {
    "E001": "the file cannot be opened as a dataset of this schema version",
    "E002": "root attributes are missing, unknown or out of range",
    "E003": "a group or array is missing or cannot be read",
    "E004": "an array has the wrong shape, type or number of dimensions",
    "E005": "a number is not finite",
    "E006": "a cell refers to a node that does not exist, or its type is unknown",
    "E007": "a cell has no or negative volume",
    "E008": "a fixed node moves",
    "E009": "content does not match its hash",
    "E010": "splits do not fit the trajectories or overlap",
    "W001": "the file does not hold its whole tier",
    "W002": "the file holds something that the schema does not know",
}


class Problem(Record):
    """One finding: its code (see `CODES`), the place inside the file, and what is wrong there."""

    code: str
    where: str
    message: str


class ValidationReport(Record):
    """The outcome for one file; `ok` depends on strictness."""

    file: str
    trajectories: int
    ok: bool
    problems: tuple[Problem, ...]


def validate(
    path: Path, *, strict: bool = False, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> ValidationReport:
    """Check a file. Never raises for what is in it, however damaged."""
    problems: list[Problem] = []
    count = 0
    try:
        with open_file(path) as file:
            metadata = _checked_metadata(file, problems)
            if metadata is not None:
                keys = list(file["trajectories"]) if "trajectories" in file else []
                count = len(keys)
                hashes: dict[str, str] = {}
                for done, key in enumerate(keys, 1):
                    problems += _trajectory_problems(file, key, metadata, hashes)
                    on_progress(done, count)
                problems += _file_problems(file, metadata, hashes)
    except DatasetError as error:
        problems.append(Problem(code="E001", where="/", message=str(error)))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        problems.append(Problem(code="E003", where="/", message=f"damaged: {error}"))
    failing = [p for p in problems if strict or p.code.startswith("E")]
    return ValidationReport(file=str(path), trajectories=count, ok=not failing, problems=tuple(problems))


def _checked_metadata(file: h5py.File, problems: list[Problem]) -> Metadata | None:
    try:
        return read_metadata(file)
    except DatasetError as error:
        problems.append(Problem(code="E002", where="/", message=str(error)))
        return None


def _trajectory_problems(
    file: h5py.File, key: str, metadata: Metadata, hashes: dict[str, str]
) -> Iterator[Problem]:
    where = f"/trajectories/{key}"

    def problem(
        code: Literal["E003", "E004", "E005", "E006", "E007", "E008", "E009"], message: str
    ) -> Problem:
        return Problem(code=code, where=where, message=message)

    try:
        group = file[where]
        mesh = Mesh(
            rest_positions=group["mesh/rest_positions"][()],
            cells=group["mesh/cells"][()],
            cell_type=int(group["mesh/cell_type"][()]),
            node_type=group["mesh/node_type"][()],
        )
        trajectory = Trajectory(
            positions=group["positions"][()],
            mesh=mesh,
            material={name: float(value) for name, value in group["material"].attrs.items()},
            loads={name: array[()] for name, array in group.get("loads", {}).items()},
            collider_positions=group["collider_positions"][()] if "collider_positions" in group else None,
        )
        stored = str(group.attrs["content_hash"])
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        yield problem("E003", f"cannot be read: {error}")
        return
    hashes[key] = stored
    if trajectory.content_hash() != stored:
        yield problem("E009", "the content hash does not match")

    nodes = len(mesh.rest_positions)
    expected = (metadata.frames, nodes, metadata.dimension)
    if trajectory.positions.shape != expected or trajectory.positions.dtype != np.float32:
        found = f"{trajectory.positions.shape} {trajectory.positions.dtype}"
        yield problem("E004", f"positions are {found}, expected {expected} float32")
        return
    if mesh.node_type.shape != (nodes,) or mesh.cells.ndim != 2:
        yield problem(
            "E004", f"node_type {mesh.node_type.shape} or cells {mesh.cells.shape} do not fit {nodes} nodes"
        )
        return
    if set(trajectory.material) != set(metadata.material_units):
        yield problem(
            "E004", f"material {sorted(trajectory.material)} is not {sorted(metadata.material_units)}"
        )
    for name, array in trajectory.arrays().items():
        if not np.isfinite(array).all():
            yield problem(
                "E005", f"{name} holds {np.count_nonzero(~np.isfinite(array))} numbers that are not finite"
            )
    if not all(np.isfinite(value) for value in trajectory.material.values()):
        yield problem("E005", "the material is not finite")
    if CELL_CORNERS.get(mesh.cell_type) != mesh.cells.shape[1]:
        yield problem("E006", f"cells of {mesh.cells.shape[1]} corners have VTK type {mesh.cell_type}")
        return
    if mesh.cells.size and not 0 <= mesh.cells.min() <= mesh.cells.max() < nodes:
        yield problem("E006", f"cells refer to nodes {mesh.cells.min()}..{mesh.cells.max()} of {nodes}")
        return
    smallest = cell_volumes(mesh.rest_positions, mesh.cells, mesh.cell_type).min()
    if not smallest > 0:
        yield problem("E007", f"the smallest cell at rest has volume {smallest:.3g}")
    moving = trajectory.positions[:, mesh.node_type == FIXED]
    if moving.size and np.ptp(moving, axis=0).max() > 0:
        yield problem("E008", f"a fixed node moves by up to {np.ptp(moving, axis=0).max():.3g}")


def cell_volumes(positions: np.ndarray, cells: np.ndarray, cell_type: int) -> np.ndarray:
    """Volumes of tetrahedra, areas of triangles: signed where the space allows a sign, shape [cells]."""
    corners = positions[cells].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    if cell_type == VTK_TETRA:
        return np.linalg.det(edges) / 6
    if edges.shape[-1] == 2:
        return np.linalg.det(edges) / 2
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1) / 2


def _file_problems(file: h5py.File, metadata: Metadata, hashes: dict[str, str]) -> Iterator[Problem]:
    if combine_hashes(hashes) != metadata.content_hash:
        yield Problem(
            code="E009", where="/", message="the file's content hash does not match its trajectories'"
        )
    for task, splits in file.get("splits", {}).items():
        seen: set[str] = set()
        for split in splits:
            where = f"/splits/{task}/{split}"
            keys = [key.decode() for key in splits[split][()]]
            if split not in SPLITS:
                yield Problem(code="E010", where=where, message=f"unknown split; known: {', '.join(SPLITS)}")
            missing = [key for key in keys if key not in hashes]
            if missing:
                yield Problem(
                    code="E010", where=where, message=f"lists {missing[0]}, which is not in the file"
                )
            if len(set(keys)) < len(keys) or seen & set(keys):
                yield Problem(
                    code="E010", where=where, message="lists a trajectory twice, or one of another split"
                )
            seen |= set(keys)
    if not file.get("splits"):
        yield Problem(code="E010", where="/splits", message="there are no splits")
    sizes = tier_sizes(metadata.tier, metadata.paper_sizes)
    absent = [
        key
        for split in SPLITS
        for i in range(sizes[split])
        if (key := trajectory_key(split, i)) not in hashes
    ]
    if absent:
        message = f"{len(absent)} trajectories of tier {metadata.tier} are not in the file, the first is {absent[0]}"
        yield Problem(code="W001", where="/trajectories", message=message)
    for name in sorted(set(file) - {"meshes", "trajectories", "splits"}):
        yield Problem(code="W002", where=f"/{name}", message="unknown to the schema")
