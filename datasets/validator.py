"""Check a dataset file from top to bottom and report every problem under a stable code.

Errors make a file unusable; warnings (codes W...) are things to know, and fail only a strict check.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import load_trajectory, open_file, read_metadata, read_splits, require_file
from m3gn_bench.datasets.schema import SPLITS, Metadata, Record, parse_key, tier_sizes, trajectory_key
from m3gn_bench.datasets.trajectory import (
    CELL_CORNERS,
    FIXED,
    FREE,
    VTK_TETRA,
    Trajectory,
    combine_hashes,
)

CODES = {
    "E001": "the file cannot be opened as a dataset of this schema version",
    "E002": "root attributes are missing, unknown or out of range",
    "E003": "a group or array is missing or cannot be read",
    "E004": "an array has the wrong shape or type; material, loads or kinds of nodes are not those that are named",
    "E005": "a number is not finite",
    "E006": "a cell refers to a node that does not exist, or its type is unknown",
    "E007": "a cell has no or negative volume",
    "E008": "a fixed node moves",
    "E009": "content does not match its hash",
    "E010": "splits do not fit the trajectories or overlap",
    "W001": "the file does not hold its whole tier",
    "W002": "the file holds something that the schema does not know",
    "W003": "the same trajectory is in two splits",
    "W004": "nothing moves from one frame to the next",
}
TRAJECTORY_GROUP = {
    "positions",
    "mesh",
    "material",
    "loads",
    "collider_positions",
    "collider_edges",
    "tags",
    "diagnostics",
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
    """Check a file. Never raises for what is in it, however damaged.

    Raises:
        DatasetError: there is no such file.
    """
    require_file(path)
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
                problems += _file_problems(file, metadata, set(keys), hashes)
    except DatasetError as error:
        problems.append(Problem(code="E001", where="/", message=str(error)))
    except Exception as error:  # HDF5 has no list of what it raises on damaged files
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
    try:
        trajectory, stored = load_trajectory(file, key)
    except DatasetError as error:
        yield Problem(code="E003", where=where, message=str(error))
        return
    hashes[key] = stored
    for name in sorted(set(file[where]) - TRAJECTORY_GROUP):
        yield Problem(code="W002", where=where, message=f"{name} is unknown to the schema")
    if trajectory.content_hash() != stored:
        yield Problem(code="E009", where=where, message="the content hash does not match")
    problems = list(content_problems(trajectory, metadata, where))
    yield from problems
    if not problems:
        still = np.flatnonzero((np.diff(trajectory.positions, axis=0) == 0).all(axis=(1, 2)))
        if still.size:
            message = (
                f"no node moves from frame {still[0]} to the next ({still.size} such of {metadata.frames})"
            )
            yield Problem(code="W004", where=where, message=message)


def content_problems(trajectory: Trajectory, metadata: Metadata, where: str) -> Iterator[Problem]:
    """What is wrong with a trajectory, wherever it comes from.

    Args:
        trajectory: what to check.
        metadata: of its dataset.
        where: the place that the problems name.
    """

    def problem(code: Literal["E004", "E005", "E006", "E007", "E008"], message: str) -> Problem:
        return Problem(code=code, where=where, message=message)

    mesh = trajectory.mesh
    misfits = list(_misfits(trajectory, metadata))
    yield from (problem("E004", misfit) for misfit in misfits)
    if misfits:
        return
    nodes = len(mesh.rest_positions)
    for kind, found, units in (
        ("material", trajectory.material, metadata.material_units),
        ("loads", trajectory.loads, metadata.load_units),
    ):
        if set(found) != set(units):
            yield problem("E004", f"{kind} {sorted(found)} are not {sorted(units)}")
    kinds = set(np.unique(mesh.node_type).tolist()) - {FREE, FIXED}
    if kinds:
        yield problem("E004", f"node_type {min(kinds)} is neither {FREE} (free) nor {FIXED} (fixed)")
    for name, array in trajectory.arrays().items():
        if not np.isfinite(array).all():
            yield problem(
                "E005", f"{name} holds {np.count_nonzero(~np.isfinite(array))} numbers that are not finite"
            )
    if not all(np.isfinite(value) for value in trajectory.material.values()):
        yield problem("E005", "the material is not finite")
    if not len(mesh.cells) or CELL_CORNERS.get(mesh.cell_type) != mesh.cells.shape[1]:
        yield problem(
            "E006",
            f"cells of shape {mesh.cells.shape} and VTK type {mesh.cell_type} are no triangles or tetrahedra",
        )
        return
    if not 0 <= mesh.cells.min() <= mesh.cells.max() < nodes:
        yield problem("E006", f"cells refer to nodes {mesh.cells.min()}..{mesh.cells.max()} of {nodes}")
        return
    edges, path = trajectory.collider_edges, trajectory.collider_positions
    if edges is not None and edges.size:
        ends = 0 if path is None else path.shape[1]
        if not 0 <= edges.min() <= edges.max() < ends:
            yield problem("E006", f"collider edges refer to nodes {edges.min()}..{edges.max()} of {ends}")
    smallest = cell_volumes(mesh.rest_positions, mesh.cells, mesh.cell_type).min()
    if not smallest > 0:
        yield problem("E007", f"the smallest cell at rest has volume {smallest:.3g}")
    moving = trajectory.positions[:, mesh.node_type == FIXED]
    if moving.size and np.ptp(moving, axis=0).max() > 0:
        yield problem("E008", f"a fixed node moves by up to {np.ptp(moving, axis=0).max():.3g}")


def _misfits(trajectory: Trajectory, metadata: Metadata) -> Iterator[str]:
    """Arrays of another shape or type than the schema's."""
    mesh = trajectory.mesh
    frames, nodes, dimension = metadata.frames, mesh.rest_positions.shape[:1], metadata.dimension
    expected: dict[str, tuple[np.ndarray, tuple[int | None, ...], str]] = {
        "mesh/rest_positions": (mesh.rest_positions, (*nodes, dimension), "float32"),
        "mesh/cells": (mesh.cells, (None, None), "int32"),
        "mesh/node_type": (mesh.node_type, nodes, "uint8"),
        "positions": (trajectory.positions, (frames, *nodes, dimension), "float32"),
    }
    if trajectory.collider_positions is not None:
        expected["collider_positions"] = (trajectory.collider_positions, (frames, None, dimension), "float32")
    if trajectory.collider_edges is not None:
        expected["collider_edges"] = (trajectory.collider_edges, (None, 2), "int32")
    for name, (array, shape, dtype) in expected.items():
        if not has_shape(array, shape) or array.dtype != dtype:
            yield f"{name} is {array.shape} {array.dtype}, expected {shape} {dtype}"


def has_shape(array: np.ndarray, expected: tuple[int | None, ...]) -> bool:
    """Whether an array has a shape, in which None stands for any length."""
    return array.ndim == len(expected) and all(
        e in (None, a) for a, e in zip(array.shape, expected, strict=True)
    )


def cell_volumes(positions: np.ndarray, cells: np.ndarray, cell_type: int) -> np.ndarray:
    """Volumes of tetrahedra, areas of triangles: signed where the space allows a sign, shape [cells]."""
    corners = positions[cells].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    if cell_type == VTK_TETRA:
        return np.linalg.det(edges) / 6
    if edges.shape[-1] == 2:
        return np.linalg.det(edges) / 2
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1) / 2


def _file_problems(
    file: h5py.File, metadata: Metadata, present: set[str], hashes: dict[str, str]
) -> Iterator[Problem]:
    if combine_hashes(hashes) != metadata.content_hash:
        yield Problem(
            code="E009", where="/", message="the file's content hash does not match its trajectories'"
        )
    try:
        tasks = read_splits(file) if "splits" in file else {}
    except DatasetError as error:
        yield Problem(code="E003", where="/splits", message=str(error))
        return
    for task, splits in tasks.items():
        for split, keys in splits.items():
            where = f"/splits/{task}/{split}"
            if split not in SPLITS:
                yield Problem(code="E010", where=where, message=f"unknown split; known: {', '.join(SPLITS)}")
            missing = [key for key in keys if key not in present]
            if missing:
                message = f"lists {missing[0]}, which is not in the file"
                yield Problem(code="E010", where=where, message=message)
            if len(set(keys)) < len(keys) or {key.rpartition("_")[0] for key in keys} - {split}:
                message = "lists a trajectory twice, or one of another split"
                yield Problem(code="E010", where=where, message=message)
    unlisted = present - {key for splits in tasks.values() for keys in splits.values() for key in keys}
    if unlisted:
        yield Problem(code="E010", where="/splits", message=f"{min(unlisted)} is in no split of any task")
    first: dict[str, str] = {}
    for key, digest in hashes.items():
        other = first.setdefault(digest, key)
        if parse_key(key)[0] != parse_key(other)[0]:
            message = f"{key} is the same as {other}"
            yield Problem(code="W003", where=f"/trajectories/{key}", message=message)
    sizes = tier_sizes(metadata.tier, metadata.paper_sizes)
    absent = [
        key
        for split in SPLITS
        for i in range(sizes[split])
        if (key := trajectory_key(split, i)) not in present
    ]
    if absent:
        message = f"{len(absent)} trajectories of tier {metadata.tier} are not in the file, the first is {absent[0]}"
        yield Problem(code="W001", where="/trajectories", message=message)
    for name in sorted(set(file) - {"meshes", "trajectories", "splits"}):
        yield Problem(code="W002", where=f"/{name}", message="unknown to the schema")
