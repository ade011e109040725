"""What every reader of a foreign layout delivers, and the checks of arrays that all of them share."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.validator import has_shape

UNKNOWN_UNIT = "unit of the source"
LISTED = 20  # entries that a message names
SPLIT_WORDS: dict[str, Split] = {
    "train": "train",
    "eval": "validation",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
    "test": "test",
}


@dataclass(frozen=True, eq=False)
class Found:
    """One trajectory as its publishers stored it; lengths in the source's unit.

    Attributes:
        where: file and place, for messages.
        positions: of mesh nodes, shape [frames, nodes, dim].
        cells: node indices of triangles or tetrahedra, shape [cells, 3 or 4].
        rest_positions: stress-free positions, shape [nodes, dim]; None: the first frame.
        held: nodes that the source holds, shape [nodes], bool; None: those that never move.
        material: parameters by name.
        loads: named arrays that describe the load.
        collider_positions: shape [frames, collider_nodes, dim], or None.
        collider_edges: node indices of the collider's own edges, shape [edges, 2], or None.
        tags: what else is known in words.
    """

    where: str
    positions: NDArray[np.floating]
    cells: NDArray[np.integer]
    rest_positions: NDArray[np.floating] | None = None
    held: NDArray[np.bool_] | None = None
    material: dict[str, float] = field(default_factory=dict)
    loads: dict[str, np.ndarray] = field(default_factory=dict)
    collider_positions: NDArray[np.floating] | None = None
    collider_edges: NDArray[np.integer] | None = None
    tags: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Facts:
    """What a layout says, or does not say, of all its trajectories.

    Attributes:
        simulator: by which the data were made.
        dt: time between frames, in `time_unit`.
        time_unit, length_unit: in words.
        material_units, load_units: by name.
        scale_centre, scale_length: the map to about [-1, 1] that is in use for these data; None: from the data.
    """

    simulator: str
    dt: float = 1.0
    time_unit: str = "frame"
    length_unit: str = UNKNOWN_UNIT
    material_units: dict[str, str] = field(default_factory=dict)
    load_units: dict[str, str] = field(default_factory=dict)
    scale_centre: tuple[float, ...] | None = None
    scale_length: float | None = None


class Source(Protocol):
    """Published files, opened: which splits they have, and the trajectories of each."""

    @property
    def facts(self) -> Facts: ...

    @property
    def splits(self) -> Sequence[Split]: ...

    def open(self, split: Split) -> tuple[int, Iterator[Found]]:
        """Number of trajectories of a split, and the trajectories.

        Raises:
            DatasetError: damaged, or not of this layout; so do the trajectories, as they come.
        """
        ...


def files_by_split(paths: Sequence[Path], ending: str) -> dict[Split, Path]:
    """The file of each split, told by the last word of its name: train, eval, val, valid, validation, test.

    Args:
        paths: files, or folders with such files.
        ending: of the files' names, e.g. ".pkl".

    Raises:
        DatasetError: a path that does not exist, a name without a split, or two files of the same split.
    """
    files: dict[Split, Path] = {}
    for path in paths:
        in_folder = sorted(path.glob(f"*{ending}")) if path.is_dir() else []
        for file in in_folder or [path]:
            if not file.is_file():
                raise DatasetError(f"no {ending} file at {file}")
            word = file.stem.rpartition("_")[2]
            if word not in SPLIT_WORDS:
                raise DatasetError(
                    f"{file}: the last word of the name must tell the split; "
                    + unknown_name("split", word, list(SPLIT_WORDS))
                )
            split = SPLIT_WORDS[word]
            if split in files:
                raise DatasetError(
                    f"both {files[split]} and {file} are of the {split} split; give one of them"
                )
            files[split] = file
    return files


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """What the operating system refuses becomes one line that names the file.

    Raises:
        DatasetError: it refused.
    """
    try:
        yield
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from error


def array(
    entry: Mapping[str, Any], name: str, where: str, shape: tuple[int | None, ...], *, whole: bool = False
) -> np.ndarray:
    """An entry as an array of numbers.

    Args:
        entry: named values, of which one is an array or a nested list of numbers.
        name: which of them.
        where: the place, for messages.
        shape: the expected one; None stands for any length.
        whole: whether the numbers must be integers.

    Raises:
        DatasetError: no such entry, no numbers, or another shape.
    """
    value = required(entry, name, where)
    try:
        result = np.asarray(value)
    except ValueError as error:  # rows of different length
        raise DatasetError(f"{where}: {name} is no array of numbers ({error})") from error
    if result.dtype.kind not in ("iu" if whole else "iuf"):
        raise DatasetError(f"{where}: {name} holds {result.dtype}, not {'integers' if whole else 'numbers'}")
    if not has_shape(result, shape):
        expected = ", ".join("any" if length is None else str(length) for length in shape)
        raise DatasetError(f"{where}: {name} has shape {result.shape}, expected ({expected})")
    return result


def required(entry: Mapping[str, Any], name: str, where: str) -> Any:
    """An entry of that name. Raises DatasetError listing the entries if there is none."""
    if name not in entry:
        known = sorted(map(str, entry))
        more = f" and {len(known) - LISTED} more" if len(known) > LISTED else ""
        raise DatasetError(f"{where}: {unknown_name('entry', name, known[:LISTED])}{more}")
    return entry[name]


def indices(values: np.ndarray, nodes: int, name: str, where: str) -> NDArray[np.int32]:
    """Node indices as the schema has them. Raises DatasetError if they are none, or of nodes that do not exist."""
    if values.dtype.kind not in "iu":
        raise DatasetError(f"{where}: {name} hold {values.dtype}, not integers")
    # Before they are narrowed, which would make large ones small.
    if values.size and not 0 <= values.min() <= values.max() < nodes:
        raise DatasetError(f"{where}: {name} refer to nodes {values.min()} to {values.max()} of {nodes}")
    return values.astype(np.int32)


def edges_of(cells: np.ndarray) -> np.ndarray:
    """Every edge of simplices [cells, corners] once, shape [edges, 2]."""
    pairs = cells[:, list(combinations(range(cells.shape[1]), 2))]
    return np.unique(np.sort(pairs.reshape(-1, 2), axis=1), axis=0)
