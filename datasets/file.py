"""Open dataset files and read what is in them; nothing is returned that does not match its hash."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.schema import (
    FORMAT,
    SCHEMA_VERSION,
    SPLITS,
    TIERS,
    Metadata,
    as_split,
    as_text,
    in_tier,
    parse_key,
    tier_sizes,
)
from m3gn_bench.datasets.trajectory import Mesh, Trajectory, combine_hashes

MAX_COMPRESSION = 1100  # gzip reaches 1032
MAX_LISTED = 5  # files of a folder that stands where a file is needed


def require_file(path: Path) -> None:
    """Raises DatasetError if there is no file, or none that may be read; of a folder it says what is in it."""
    if path.is_dir():
        names = sorted(file.name for file in path.glob("*.h5"))
        if not names:
            raise DatasetError(
                f"{path} is a folder without dataset files (*.h5); make one with 'm3gn-bench generate'"
            )
        others = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        raise DatasetError(f"{path} is a folder; name a file in it: {', '.join(names[:MAX_LISTED])}{others}")
    if not path.is_file():
        raise DatasetError(f"no dataset file at {path}; make one with 'm3gn-bench generate'")
    if not os.access(path, os.R_OK):
        raise DatasetError(f"{path} may not be read: its permissions do not allow it")


def open_file(path: Path) -> h5py.File:
    """Open a dataset file for reading.

    Raises:
        DatasetError: missing, truncated, not HDF5, not ours, or of another schema version.
    """
    require_file(path)
    try:
        file = h5py.File(path)
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be opened as HDF5, it may be truncated or damaged ({error})"
        ) from error
    try:
        with damage_as_dataset_error(f"{path}: root attributes"):
            found, version = as_text(file.attrs.get("format")), file.attrs.get("schema_version")
        if found != FORMAT:
            raise DatasetError(f"{path} is HDF5 but no m3gn-bench dataset (attribute 'format' is {found!r})")
        if version != SCHEMA_VERSION:
            raise DatasetError(
                f"{path} has schema version {version}, this m3gn-bench reads {SCHEMA_VERSION}; generate it again"
            )
    except DatasetError:
        file.close()
        raise
    return file


def read_metadata(file: h5py.File) -> Metadata:
    """The root attributes. Raises DatasetError if they do not fit the schema."""
    try:
        return Metadata.from_attributes(dict(file.attrs))
    except (ValueError, OSError, RuntimeError, KeyError, TypeError) as error:
        first = str(error).splitlines()
        raise DatasetError(
            f"{file.filename} has damaged root attributes: {' '.join(first[1:3]) or error}"
        ) from error


def read_trajectory(file: h5py.File, key: str) -> Trajectory:
    """Read one trajectory and verify its content hash.

    Raises:
        DatasetError: missing, damaged, or its content does not match its hash.
    """
    trajectory, stored = load_trajectory(file, key)
    if trajectory.content_hash() != stored:
        raise DatasetError(
            f"{file.filename}: trajectory {key} does not match its content hash; generate it again"
        )
    return trajectory


def load_trajectory(file: h5py.File, key: str) -> tuple[Trajectory, str]:
    """A trajectory as it is in the file, and the content hash that it should have.

    Raises:
        DatasetError: missing or unreadable.
    """
    with damage_as_dataset_error(f"{file.filename}: trajectory {key}"):
        group = file["trajectories"][key]
        mesh = group["mesh"]
        trajectory = Trajectory(
            positions=_array(group, "positions"),
            mesh=Mesh(
                rest_positions=_array(mesh, "rest_positions"),
                cells=_array(mesh, "cells"),
                cell_type=int(_array(mesh, "cell_type")),
                node_type=_array(mesh, "node_type"),
            ),
            material={name: float(value) for name, value in group["material"].attrs.items()},
            loads={name: _array(group["loads"], name) for name in group.get("loads", ())},
            collider_positions=_array(group, "collider_positions") if "collider_positions" in group else None,
            collider_edges=_array(group, "collider_edges") if "collider_edges" in group else None,
            tags={name: str(as_text(value)) for name, value in _attributes(group, "tags").items()},
            diagnostics={name: float(value) for name, value in group["diagnostics"].attrs.items()},
        )
        return trajectory, str(as_text(group.attrs["content_hash"]))


def _attributes(group: h5py.Group, name: str) -> dict[str, Any]:
    """Attributes of a group that may be absent."""
    return dict(group[name].attrs) if name in group else {}


def _array(group: h5py.Group, name: str) -> np.ndarray:
    """An array, if its layout is the writer's: a damaged one can ask for more memory than there is."""
    dataset = group[name]
    if dataset.chunks not in (None, dataset.shape):
        raise ValueError(f"{name} of shape {dataset.shape} has chunks {dataset.chunks}")
    require_stored(dataset)
    return dataset[()]


def require_stored(dataset: h5py.Dataset) -> None:
    """Raise ValueError unless the numbers of an array are in its own file, as many as it says."""
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"{dataset.name} is kept in another file")
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > MAX_COMPRESSION * stored:
        raise ValueError(f"{dataset.name} of shape {dataset.shape} has {stored} bytes in the file")


@contextmanager
def damage_as_dataset_error(where: str) -> Iterator[None]:
    """Whatever h5py raises on a damaged file becomes one line that names the place."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise DatasetError(f"{where} is damaged or missing ({error})") from error


def stored_hashes(file: h5py.File) -> dict[str, str]:
    """The recorded content hash of every trajectory, by key."""
    with damage_as_dataset_error(f"{file.filename}: the list of trajectories"):
        return {key: str(as_text(group.attrs["content_hash"])) for key, group in file["trajectories"].items()}


def read_splits(file: h5py.File) -> dict[str, dict[str, list[str]]]:
    """The keys of the trajectories, in order, by task and split."""
    with damage_as_dataset_error(f"{file.filename}: the splits"):
        return {
            task: {split: [key.decode() for key in _array(group, split)] for split in group}
            for task, group in file["splits"].items()
        }


def find_key(file: h5py.File, split: str, index: int, task: str | None = None) -> str:
    """The key of a trajectory of a split: of a task's, or without one of all that the file holds.

    Raises:
        DatasetError: there is none; says what there is instead.
    """
    listed: dict[str, list[str]] = {}
    if task is None:
        for key in stored_hashes(file):
            listed.setdefault(parse_key(key)[0], []).append(key)
    else:
        tasks = read_splits(file)
        if task not in tasks:
            raise DatasetError(f"{file.filename}: {unknown_name('task', task, list(tasks))}")
        listed = tasks[task]
    keys = listed.get(as_split(split), [])
    of_task = f" of task {task}" if task else ""
    if not keys:
        present = " and ".join(sorted(listed)) or "none"
        raise DatasetError(f"{file.filename} has no {split} trajectories{of_task}; it has {present}")
    if not 0 <= index < len(keys):
        raise DatasetError(
            f"index {index} is out of range: {file.filename} has {len(keys)} {split} trajectories{of_task}, "
            f"0 to {len(keys) - 1}"
        )
    return keys[index]


def content_hash(file: h5py.File, tier: str | None = None, splits: Sequence[str] = SPLITS) -> str:
    """Content hash of the trajectories of a tier (default: all in the file) and of the given splits.

    Raises:
        DatasetError: the file does not hold the whole tier.
    """
    hashes = stored_hashes(file)
    metadata = read_metadata(file)
    sizes = tier_sizes(tier or metadata.tier, metadata.paper_sizes)
    chosen = {k: h for k, h in hashes.items() if in_tier(k, sizes) and parse_key(k)[0] in splits}
    if tier is not None and len(chosen) != sum(sizes[s] for s in SPLITS if s in splits):
        raise DatasetError(f"{file.filename} does not hold the whole {tier} tier")
    return combine_hashes(chosen)


def tier_hashes(file: h5py.File) -> dict[str, str]:
    """Content hashes of the tiers that the file holds whole."""
    hashes: dict[str, str] = {}
    for tier in TIERS:
        try:
            hashes[tier] = content_hash(file, tier)
        except DatasetError:
            continue
    return hashes


def find_dataset(
    folder: Path, scene: str, tier: str, splits: Sequence[str], version: str | None = None
) -> Path | None:
    """The smallest file in a folder that holds the leaderboard's data of a scene, tier and splits, or None.

    With `version` only files of that dataset version count.
    """
    suitable = []
    for path in folder.glob(f"{scene}-*.h5"):
        try:
            with open_file(path) as file:
                metadata = read_metadata(file)
                if (
                    metadata.scene == scene
                    and metadata.is_benchmark
                    and version in (None, metadata.dataset_version)
                ):
                    content_hash(file, tier, splits)
                    suitable.append((path.stat().st_size, path))
        except DatasetError:
            continue
    return min(suitable)[1] if suitable else None
