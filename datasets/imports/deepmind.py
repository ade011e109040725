"""TFRecords of DeepMind's MeshGraphNets (Pfaff et al. 2021): a folder of meta.json and {train,valid,test}.tfrecord.

A record is a trajectory; `meta.json` gives shape and type of each of its arrays. Used are `world_pos`, `mesh_pos`,
`cells` and `node_type`. Source: https://github.com/google-deepmind/deepmind-research/tree/master/meshgraphnets
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from m3gn_bench.datasets.errors import DatasetError, first_problem
from m3gn_bench.datasets.imports.source import (
    Facts,
    Found,
    edges_of,
    files_by_split,
    indices,
    reading,
    required,
)
from m3gn_bench.datasets.imports.tfrecord import count_records, parse_example, read_records
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.validator import has_shape

META = "meta.json"
# Whatever the body is, these tasks tell models what the data have: positions, and a body's or obstacle's path.
TASKS = ("tissue_manipulation", "falling_teddy")
DIMENSION = 3  # of these tasks
NORMAL, OBSTACLE, HANDLE = 0, 1, 3  # node types; the others are of flows
FIELDS = {"world_pos": "dynamic", "mesh_pos": "static", "cells": "static", "node_type": "static"}


class Feature(BaseModel):
    """How an array is stored: `shape` has -1 where trajectories differ."""

    type: str
    dtype: str
    shape: tuple[int, ...]


class UsedFeature(Feature):
    """The same of an array that is used; a static one has a single frame."""

    dtype: Literal["float32", "float64", "int32", "int64"]
    shape: tuple[int, int, int]


class Meta(BaseModel):
    """What is used of meta.json; a `dt` of 0 means a sequence of equilibria."""

    simulator: str = "unknown"
    dt: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    trajectory_length: int = Field(ge=2)
    features: dict[str, Feature]


class DeepMindSource:
    """A folder, or some of its files.

    Args:
        paths: the folder, or TFRecord files of one folder.
        task: one of `TASKS`; what is read does not depend on it.

    Raises:
        DatasetError: files or meta.json are missing or damaged, or the mesh does not deform, or changes.
    """

    def __init__(self, paths: Sequence[Path], task: str) -> None:
        self.files = files_by_split(paths, ".tfrecord")
        self.splits = list(self.files)
        folders = {file.parent for file in self.files.values()}
        if len(folders) > 1:
            raise DatasetError(f"the files are in several folders: {', '.join(sorted(map(str, folders)))}")
        self.meta_path = folders.pop() / META
        meta = _read_meta(self.meta_path)
        self.frames = meta.trajectory_length
        self.features = _used_features(meta, self.meta_path)
        self.facts = Facts(simulator=meta.simulator, dt=meta.dt or 1.0, time_unit="s" if meta.dt else "frame")

    def open(self, split: Split) -> tuple[int, Iterator[Found]]:
        """Number of trajectories of a split, and the trajectories."""
        path = self.files[split]
        return count_records(path), (
            self._found(content, f"{path}, record {number}")
            for number, content in enumerate(read_records(path))
        )

    def _found(self, content: bytes, where: str) -> Found:
        try:
            entries = parse_example(content)
        except ValueError as error:
            raise DatasetError(f"{where} is no tf.train.Example ({error})") from error
        arrays = {name: self._array(entries, name, where) for name in self.features}
        nodes = arrays["world_pos"].shape[1]
        expected = {
            "world_pos": (self.frames, nodes, DIMENSION),
            "mesh_pos": (1, nodes, None),
            "cells": (1, None, None),
            "node_type": (1, nodes, 1),
        }
        fit = all(has_shape(arrays[name], shape) for name, shape in expected.items())
        if not fit or arrays["mesh_pos"].shape[2] > DIMENSION:
            shapes = ", ".join(f"{name} {found.shape}" for name, found in arrays.items())
            raise DatasetError(
                f"{where}: arrays do not belong together, or are not of bodies in space: {shapes}"
            )
        place, rest, kind = arrays["world_pos"], arrays["mesh_pos"][0], arrays["node_type"][0, :, 0]
        cells = indices(arrays["cells"][0], nodes, "cells", where)
        unknown = set(kind.tolist()) - {NORMAL, OBSTACLE, HANDLE}
        if unknown:
            raise DatasetError(
                f"{where}: nodes of type {min(unknown)}; known are {NORMAL} (free), {OBSTACLE} (obstacle) and "
                f"{HANDLE} (held)"
            )
        obstacle = kind == OBSTACLE
        of_obstacle = obstacle[cells]
        body_cells, obstacle_cells = cells[~of_obstacle.any(1)], cells[of_obstacle.all(1)]
        if len(body_cells) + len(obstacle_cells) < len(cells):
            raise DatasetError(f"{where}: a cell has nodes of the body and of the obstacle")
        number = np.where(obstacle, np.cumsum(obstacle), np.cumsum(~obstacle)) - 1  # within its own group
        return Found(
            where=where,
            positions=place[:, ~obstacle],
            cells=number[body_cells],
            # A cloth's stress-free shape is given in its own two coordinates: laid out flat in space.
            rest_positions=np.pad(rest, ((0, 0), (0, DIMENSION - rest.shape[1])))[~obstacle],
            held=(kind == HANDLE)[~obstacle],
            collider_positions=place[:, obstacle] if obstacle.any() else None,
            collider_edges=edges_of(number[obstacle_cells]) if len(obstacle_cells) else None,
        )

    def _array(self, entries: dict[str, bytes], name: str, where: str) -> np.ndarray:
        feature = self.features[name]
        content = required(entries, name, where)
        try:
            return np.frombuffer(content, np.dtype(feature.dtype).newbyteorder("<")).reshape(feature.shape)
        except ValueError as error:
            raise DatasetError(
                f"{where}: {name} has {len(content)} bytes, which do not make {feature.dtype} of shape "
                f"{feature.shape}, as {self.meta_path} says"
            ) from error


def _read_meta(path: Path) -> Meta:
    if not path.is_file():
        raise DatasetError(
            f"there is no {path}, which belongs to the TFRecord files and gives the shape of their arrays"
        )
    try:
        with reading(path):
            return Meta.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise DatasetError(f"{path} does not fit: {first_problem(error)}") from error


def _used_features(meta: Meta, path: Path) -> dict[str, UsedFeature]:
    """Shape and type of the arrays in use. Raises DatasetError where they are not as in `FIELDS`."""
    if "world_pos" not in meta.features:
        raise DatasetError(
            f"{path}: nothing deforms in these data, which have no world_pos, but {', '.join(sorted(meta.features))}"
        )
    used = {}
    for name, expected in FIELDS.items():
        feature = required(meta.features, name, str(path))
        if feature.type != expected:
            raise DatasetError(
                f"{path}: {name} is {feature.type!r}, not {expected!r}; meshes that change with time cannot be "
                "imported"
            )
        try:
            used[name] = UsedFeature.model_validate(feature.model_dump())
        except ValidationError as error:
            problem = first_problem(error, "features", name)
            raise DatasetError(f"{path} does not fit: {problem}") from error
    return used
