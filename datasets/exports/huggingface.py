"""A dataset file as a folder that Hugging Face's library `datasets` loads and its hub shows: Parquet and a card."""

import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain, count, islice
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py

from m3gn_bench.datasets.card import CARDS
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.exports.npz import named_values
from m3gn_bench.datasets.file import open_file, read_metadata, read_splits, read_trajectory, stored_hashes
from m3gn_bench.datasets.schema import SPLITS, Metadata, parse_key
from m3gn_bench.datasets.trajectory import Trajectory

ROWS_AT_ONCE = 16  # trajectories in memory, and in a row group
COLUMNS = {
    "key": "the trajectory's name in the dataset file",
    "tasks": "the benchmark's tasks in whose split of this name it takes part",
    "positions": "[nodes, frames, dim]; nodes first, for their number may differ from row to row",
    "rest_positions": "[nodes, dim], free of stress",
    "cells": "node indices, [cells, corners]",
    "node_type": "0 free, 1 fixed, [nodes]",
    "collider_positions": "[collider nodes, frames, dim]",
    "collider_edges": "node indices of the collider's own edges, [edges, 2]",
}


def export_huggingface(
    file: Path, out: Path, *, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> int:
    """Write all trajectories of a dataset file as `out`/data/<split>.parquet, with `out`/README.md as their card.

    `datasets.load_dataset(out)` reads the folder. The columns are `COLUMNS` (those of the collider only where
    there is one) and what `named_values` gives.

    Args:
        file: the dataset file.
        out: the folder to make.
        on_progress: called with the number of trajectories done and of all.

    Returns:
        The number of trajectories.

    Raises:
        DatasetError: the dataset file is unusable or its trajectories do not have the same arrays; `out` is
            there already or cannot be written; or the library `datasets` is missing.
    """
    library = _library()
    with open_file(file) as opened, _new_folder(out) as folder:
        metadata, keys, tasks = read_metadata(opened), list(stored_hashes(opened)), _tasks(opened)
        if not keys:
            raise DatasetError(f"{file} holds no trajectories")
        features = _features(library, _row(keys[0], [], read_trajectory(opened, keys[0])))
        done = count(1)

        def row(key: str) -> dict[str, Any]:
            made = _row(key, tasks.get(key, []), read_trajectory(opened, key))
            if _features(library, made) != features:
                raise DatasetError(f"{file}: trajectories {keys[0]} and {key} do not have the same arrays")
            on_progress(next(done), len(keys))
            return made

        (folder / "data").mkdir()
        splits = {}
        for split in SPLITS:
            chosen = [key for key in keys if parse_key(key)[0] == split]
            if chosen:
                size = _write(library, folder / "data" / f"{split}.parquet", map(row, chosen), features)
                splits[split] = library.SplitInfo(split, num_bytes=size, num_examples=len(chosen))
        info = library.DatasetInfo(features=features, splits=library.SplitDict(splits))
        (folder / "README.md").write_text(_card(metadata, info), encoding="utf-8")
    return len(keys)


def _tasks(file: h5py.File) -> dict[str, list[str]]:
    """The tasks in whose splits each trajectory is, by key."""
    tasks: dict[str, list[str]] = {}
    for task, splits in read_splits(file).items():
        for key in chain(*splits.values()):
            tasks.setdefault(key, []).append(task)
    return tasks


def _write(library: ModuleType, path: Path, rows: Iterator[dict[str, Any]], features: Any) -> int:
    """Write a Parquet file, and return the bytes that it takes in memory."""
    from pyarrow.parquet import ParquetWriter

    words = [name for name, feature in features.items() if feature == library.Value("string")]
    size = 0
    with ParquetWriter(
        path,
        features.arrow_schema,
        compression="zstd",
        use_byte_stream_split=True,  # by significance, as in the dataset file: a fifth smaller
        use_dictionary=[*words, "tasks.list.element"],  # instead, for it cannot split words
    ) as writer:
        while batch := list(islice(rows, ROWS_AT_ONCE)):
            table = library.Dataset.from_list(batch, features=features).with_format("arrow")[:]
            writer.write_table(table)
            size += table.nbytes
    return size


def _library() -> ModuleType:
    """The library `datasets`. Raises DatasetError if there is none, or if another module has its name."""
    try:
        import datasets
    except ImportError as error:
        raise DatasetError(
            f"this format needs Hugging Face's library 'datasets' ({error}); pip install 'm3gn-bench[hub]'"
        ) from error
    if not hasattr(datasets, "load_dataset"):
        raise DatasetError(
            f"the folder {Path(str(datasets.__file__)).parent} hides Hugging Face's library 'datasets'; "
            "run the command from another folder"
        )
    return datasets


def _row(key: str, tasks: list[str], trajectory: Trajectory) -> dict[str, Any]:
    """One trajectory: numpy arrays, numbers, words and lists of words."""
    mesh, collider = trajectory.mesh, trajectory.collider_positions
    named = named_values(trajectory)
    row = {
        "key": key,
        "tasks": tasks,
        "positions": trajectory.positions.swapaxes(0, 1),
        "rest_positions": mesh.rest_positions,
        "cells": mesh.cells,
        "node_type": mesh.node_type,
        "collider_positions": None if collider is None else collider.swapaxes(0, 1),
        "collider_edges": trajectory.collider_edges,
        **{name: value if value.ndim else value[()] for name, value in named.items()},
    }
    return {name: value for name, value in row.items() if value is not None}


def _features(library: ModuleType, row: dict[str, Any]) -> Any:
    """The library's description of a row."""

    def feature(value: Any) -> Any:
        if isinstance(value, str):
            return library.Value("string")
        if isinstance(value, list):
            return library.List(library.Value("string"))
        dtype = value.dtype.name
        if value.ndim < 2:
            return library.List(library.Value(dtype)) if value.ndim else library.Value(dtype)
        array = {2: library.Array2D, 3: library.Array3D}[value.ndim]
        return array((None, *value.shape[1:]), dtype)

    return library.Features({name: feature(value) for name, value in row.items()})


@contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` on success and vanishes on failure.

    Raises:
        DatasetError: `path` is there already, or the operating system refuses.
    """
    # The current folder cannot be replaced under the feet of whoever is in it.
    if path.is_file() or (path.is_dir() and (path.samefile(".") or any(path.iterdir()))):
        raise DatasetError(f"{path} is there already; use another folder")
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _card(metadata: Metadata, info: Any) -> str:
    """The dataset card: a header that the hub reads, and what people need to know."""
    from huggingface_hub import DatasetCardData

    from datasets.info import DatasetInfosDict

    header = DatasetCardData(
        license="other" if metadata.is_imported else metadata.licence.lower(),  # identifiers of the hub
        pretty_name=f"m3gn-bench {metadata.scene}",
        tags=["physics", "simulation", "mesh", "deformable objects"],
        configs=[
            {
                "config_name": "default",
                "data_files": [{"split": name, "path": f"data/{name}.parquet"} for name in info.splits],
            }
        ],
    )
    DatasetInfosDict({"default": info}).to_dataset_card_data(header)
    units = {**metadata.material_units, **metadata.load_units}
    described = {
        **COLUMNS,
        **{name: _described(name, units) for name in info.features if name not in COLUMNS},
    }
    columns = "\n".join(f"| `{name}` | {described[name]} |" for name in info.features)
    simulators = ", ".join(f"{name} {version}" for name, version in metadata.simulator_versions.items())
    variant = "".join(f", {name} {value}" for name, value in metadata.variant.items())
    text = f"""# m3gn-bench: {metadata.scene}

Simulated trajectories of deformable objects, for learned simulators that infer an unknown material from the first
frames. {metadata.frames} frames, one every {metadata.dt:g} ({metadata.time_unit}); lengths in {metadata.length_unit}.
Models see `(positions - {list(metadata.scale_centre)}) / {metadata.scale_length:g}`.

    import datasets

    trajectory = datasets.load_dataset("folder or name on the hub", split="test").with_format("numpy")[0]
    trajectory["positions"]  # [nodes, frames, {metadata.dimension}]

| column | |
|---|---|
{columns}

| | |
|---|---|
| dataset version, tier | {metadata.dataset_version}, {metadata.tier} |
| content hash of the dataset file | `{metadata.content_hash}` |
| generated by | m3gn-bench {metadata.generator_version}, {simulators} |
| fidelity, seed | {metadata.fidelity}{variant}, {metadata.seed} |
| licence | {metadata.licence} |
"""
    own = CARDS / f"{metadata.scene}.md"
    if metadata.is_benchmark and own.is_file():
        without_links = re.sub(r"\[([^]]*)\]\((?!https?:)[^)]*\)", r"\1", own.read_text(encoding="utf-8"))
        text += "\n" + re.sub("^#", "##", without_links, flags=re.MULTILINE)
    return f"---\n{header.to_yaml()}\n---\n\n{text}"


def _described(column: str, units: dict[str, str]) -> str:
    """What a column of `named_values` is."""
    kind, _, name = column.partition("_")
    return f"{kind} `{name}`" + (f" [{units[name]}]" if units.get(name) else "")
