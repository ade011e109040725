"""Turn what a reader finds into one dataset file of our schema, marked as the work of others."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.imports.source import Facts, Found, Source, indices
from m3gn_bench.datasets.schema import IMPORTED, NO_SEED, SPLITS, Metadata, Split, trajectory_key
from m3gn_bench.datasets.trajectory import CELL_CORNERS, FIXED, FREE, Mesh, Trajectory
from m3gn_bench.datasets.validator import cell_volumes, content_problems
from m3gn_bench.datasets.writer import write_dataset

STILL = 1e-6  # of the body's size: a node that moves by less, in all frames, stays where it is
_MODULE = "m3gn_bench.datasets.imports"
_LAYOUTS = {  # imported on demand, for each has a library of its own
    "ggns": (f"{_MODULE}.ggns", "GgnsSource"),
    "mango": (f"{_MODULE}.mango", "MangoSource"),
    "deepmind": (f"{_MODULE}.deepmind", "DeepMindSource"),
}

Check = Callable[[Metadata, str, Trajectory], object]


@dataclass(frozen=True)
class Frames:
    """Which frames of a trajectory to keep: after the first `skip` every `every`th, and at most `most`."""

    skip: int = 0
    every: int = 1
    most: int | None = None

    def of(self, positions: np.ndarray) -> np.ndarray:
        """Those of an array [frames, ...]."""
        return positions[self.skip :: self.every][: self.most]


ALL_FRAMES = Frames()


@dataclass(frozen=True)
class Imported:
    """What `import_dataset` made."""

    file: Path
    metadata: Metadata


def open_source(layout: str, paths: Sequence[Path], task: str) -> Source:
    """Open published files.

    Args:
        layout: "ggns", "mango" or "deepmind".
        paths: files or folders, as the layout has them.
        task: whose data they are.

    Raises:
        DatasetError: unknown layout, nothing of that task in it, or files that are missing or damaged.
    """
    if layout not in _LAYOUTS:
        raise DatasetError(unknown_name("layout", layout, list(_LAYOUTS)))
    name, source = _LAYOUTS[layout]
    module = import_module(name)
    if task not in module.TASKS:
        raise DatasetError(f"layout {layout}: {unknown_name('task', task, list(module.TASKS))}")
    return getattr(module, source)(paths, task)


def import_dataset(
    source: Source,
    layout: str,
    task: str,
    out: Path,
    *,
    version: str,
    frames: Frames = ALL_FRAMES,
    limit: int | None = None,
    check: Check = lambda metadata, key, trajectory: None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Imported:
    """Write a dataset file of what a source holds.

    Args:
        source: the published files, opened.
        layout, task: what it was opened as.
        out: the file to make.
        version: of this package, for the record.
        frames: which frames to keep.
        limit: at most so many trajectories of each split.
        check: called with every trajectory before it is written, and with metadata that are final but for
            numbers and scale; raises what is to end the import.
        on_progress: called with (done, total) of a split after every trajectory.

    Raises:
        DatasetError: the source is damaged, or holds what the schema has no place for; nothing is left behind.
    """
    if out.exists():
        raise DatasetError(f"{out} exists already; delete it, or name another file")
    draft = _Draft(source.facts, layout, task, version, frames.every)
    converted = _converted(source, draft, frames, limit, check, on_progress)
    # The first trajectory tells most mistakes, such as the wrong task, before a folder is made.
    first = next(converted, None)
    if first is None:
        raise DatasetError(f"there are no trajectories in the {', '.join(source.splits) or 'files'}")
    content_hash = write_dataset(out, chain([first], converted), task, draft.metadata)
    return Imported(out, draft.metadata().model_copy(update={"content_hash": content_hash}))


@dataclass
class _Draft:
    """What becomes known on the way: the length, the numbers of trajectories and the space they take."""

    facts: Facts
    layout: str
    task: str
    version: str
    every: int
    frames: int = 0
    sizes: dict[Split, int] = field(default_factory=lambda: dict.fromkeys(SPLITS, 0))
    lower: NDArray[np.float64] = field(default_factory=lambda: np.array(np.inf))
    upper: NDArray[np.float64] = field(default_factory=lambda: np.array(-np.inf))

    def add(self, split: Split, where: str, trajectory: Trajectory) -> None:
        """Count a trajectory. Raises DatasetError if it has no size, or another length than those before."""
        found = len(trajectory.positions)
        self.frames = self.frames or found
        if found != self.frames:
            raise DatasetError(
                f"{where} has {found} frames, those before it {self.frames}; --frames {min(found, self.frames)} "
                "makes them equal"
            )
        if not np.ptp(trajectory.positions[0], axis=0).any():
            raise DatasetError(f"{where}: all nodes start at the same place")
        self.sizes[split] += 1
        self.lower = np.minimum(self.lower, trajectory.positions[0].min(0))
        self.upper = np.maximum(self.upper, trajectory.positions[0].max(0))

    def metadata(self) -> Metadata:
        """As far as it is known; where no scale is in use, all bodies in their first frames fit [-1, 1]."""
        facts = self.facts
        middle, size = (self.lower + self.upper) / 2, (self.upper - self.lower).max()
        return Metadata(
            scene=f"{self.layout}_{self.task}",
            dataset_version=f"{IMPORTED} from {self.layout}",
            tier="paper",
            paper_sizes=self.sizes,
            generator_version=self.version,
            simulator_versions={facts.simulator: "unknown"},
            fidelity="default",
            variant={IMPORTED: self.layout},
            seed=NO_SEED,
            dt=facts.dt * self.every,
            time_unit=facts.time_unit,
            length_unit=facts.length_unit,
            material_units=facts.material_units,
            load_units=facts.load_units,
            frames=self.frames,
            scale_centre=facts.scale_centre or tuple(middle.tolist()),
            scale_length=facts.scale_length or float(size / 2),
            licence="that of the source",
        )


def _converted(
    source: Source,
    draft: _Draft,
    frames: Frames,
    limit: int | None,
    check: Check,
    on_progress: Callable[[int, int], None],
) -> Iterator[tuple[str, Trajectory]]:
    """Key and content of every trajectory, in the order of the splits.

    Raises:
        DatasetError: a file of them would not be valid.
    """
    for split in (split for split in SPLITS if split in source.splits):
        number, found = source.open(split)
        total = number if limit is None else min(limit, number)
        for index, one in enumerate(islice(found, total)):
            key = trajectory_key(split, index)
            trajectory = convert(one, frames)
            draft.add(split, one.where, trajectory)
            metadata = draft.metadata()
            problem = next(content_problems(trajectory, metadata, one.where), None)
            if problem is not None:
                raise DatasetError(f"{problem.where}: {problem.message}")
            try:
                check(metadata, key, trajectory)
            except DatasetError as error:
                raise DatasetError(f"{one.where}: {error}") from error
            yield key, trajectory
            on_progress(index + 1, total)
        del found  # which may hold a whole split, before the next is opened


def convert(found: Found, frames: Frames) -> Trajectory:
    """A trajectory in the types of the schema: no cell inside out, held nodes marked and still.

    Raises:
        DatasetError: what that needs is missing: finite positions, a frame of the collider for each of the mesh, two
            frames to keep, cells of triangles or tetrahedra, indices of nodes that exist, held nodes that do not
            move, and others that do.
    """
    positions = np.asarray(found.positions, np.float32)
    path = None if found.collider_positions is None else np.asarray(found.collider_positions, np.float32)
    kept = frames.of(positions)
    if len(kept) < 2:
        raise DatasetError(
            f"{found.where}: {len(kept)} of its {len(positions)} frames are left; keep two or more"
        )
    # Of all frames, not only those that are kept: they tell which nodes are held.
    if not positions.size or not np.isfinite(positions).all():
        raise DatasetError(f"{found.where}: positions are not finite, or there are none")
    if path is not None and len(path) != len(positions):
        raise DatasetError(f"{found.where}: the mesh has {len(positions)} frames, its collider {len(path)}")
    rest = positions[0] if found.rest_positions is None else np.asarray(found.rest_positions, np.float32)
    edges = found.collider_edges
    if edges is not None:
        edges = indices(edges, 0 if path is None else path.shape[1], "collider edges", found.where)
    cells, cell_type = _cells(found, rest)
    held = _held(found, positions)
    return Trajectory(
        positions=np.where(held[:, None], positions[0], kept),
        mesh=Mesh(
            rest_positions=rest,
            cells=cells,
            cell_type=cell_type,
            node_type=np.where(held, FIXED, FREE).astype(np.uint8),
        ),
        material=found.material,
        loads=found.loads,
        collider_positions=None if path is None else frames.of(path),
        collider_edges=edges,
        tags=found.tags,
    )


def _cells(found: Found, rest: NDArray[np.float32]) -> tuple[NDArray[np.int32], int]:
    """The cells, with two corners of those swapped that are inside out, and their VTK type."""
    cells = indices(found.cells, len(rest), "cells", found.where)
    types = {corners: cell_type for cell_type, corners in CELL_CORNERS.items()}
    if cells.shape[1] not in types:
        raise DatasetError(
            f"{found.where}: cells of shape {cells.shape} are neither triangles nor tetrahedra"
        )
    cell_type = types[cells.shape[1]]
    inverted = cell_volumes(rest, cells, cell_type) < 0
    cells[inverted, -2:] = cells[inverted, :-3:-1]
    return cells, cell_type


def _held(found: Found, positions: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Nodes of prescribed position, shape [nodes]."""
    travel = np.ptp(positions, axis=0).max(1)
    still = travel <= STILL * np.ptp(positions[0], axis=0).max()
    if still.all():
        raise DatasetError(f"{found.where}: nothing moves")
    held = still if found.held is None else found.held
    if (held & ~still).any():
        raise DatasetError(
            f"{found.where}: a node that the source holds moves by {travel[held].max():.3g}; only held nodes that stay "
            "where they are can be imported"
        )
    return held
