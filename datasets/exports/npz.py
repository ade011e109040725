"""A trajectory as plain numpy arrays."""

from pathlib import Path
from typing import Any

import numpy as np

from m3gn_bench.datasets.exports.parts import frame_times
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.datasets.writer import atomic_path


def named_values(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Material, loads and tags under flat names, as several formats have them.

    Returns:
        material_<name>: a parameter, shape [].
        load_<name>: an array that describes the load.
        tag_<name>: a word, shape [].
    """
    return {
        **{f"material_{name}": np.array(value) for name, value in trajectory.material.items()},
        **{f"load_{name}": value for name, value in trajectory.loads.items()},
        **{f"tag_{name}": np.array(value) for name, value in trajectory.tags.items()},
    }


def named_arrays(key: str, trajectory: Trajectory, metadata: Metadata) -> dict[str, np.ndarray]:
    """A trajectory as named arrays; lengths, times and parameters in the units that `metadata` names.

    Returns:
        positions: [frames, nodes, dim], float32.
        time: [frames], float64.
        rest_positions: [nodes, dim], float32.
        cells: node indices, [cells, corners], int32.
        cell_type: VTK cell type (5 triangle, 10 tetrahedron), [].
        node_type: 0 free, 1 fixed, [nodes], uint8.
        collider_positions: [frames, collider_nodes, dim], float32; absent without a collider.
        collider_edges: [edges, 2], int32; absent where the collider has none.
        material_<name>, load_<name>, tag_<name>: see `named_values`.
        scale_centre, scale_length: models see (positions - scale_centre) / scale_length; [dim] and [].
        key: the trajectory's name, a word, [].
        metadata: the file's, with units and licence, as a JSON text, [].
    """
    mesh = trajectory.mesh
    arrays = {
        "positions": trajectory.positions,
        "time": frame_times(metadata),
        "rest_positions": mesh.rest_positions,
        "cells": mesh.cells,
        "cell_type": np.array(mesh.cell_type),
        "node_type": mesh.node_type,
        **named_values(trajectory),
        "scale_centre": np.array(metadata.scale_centre),
        "scale_length": np.array(metadata.scale_length),
        "key": np.array(key),
        "metadata": np.array(metadata.model_dump_json(exclude={"rejections"})),
    }
    if trajectory.collider_positions is not None:
        arrays["collider_positions"] = trajectory.collider_positions
    if trajectory.collider_edges is not None:
        arrays["collider_edges"] = trajectory.collider_edges
    return arrays


def export_npz(file: Path, key: str, out: Path) -> list[Path]:
    """Write a trajectory as a compressed .npz file of the arrays that `named_arrays` describes.

    Args:
        file: the dataset file.
        key: the trajectory's name in it.
        out: the file to write.

    Returns:
        The file written.

    Raises:
        DatasetError: the dataset file is unusable, or `out` cannot be written.
    """
    with open_file(file) as opened:
        # Any: numpy's own annotation takes every name for its one option
        arrays: dict[str, Any] = named_arrays(key, read_trajectory(opened, key), read_metadata(opened))
    with atomic_path(out) as temporary, temporary.open("wb") as stream:  # given a name, numpy would change it
        np.savez_compressed(stream, **arrays)
    return [out]
