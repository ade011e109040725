"""Published data of others become dataset files that train and evaluate use, and nothing in them runs."""

import json
import os
import pickle
import pickletools
import struct
import sys
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from conftest import box_of_tetrahedra
from google_crc32c import value as crc32c

from m3gn_bench.cli import run
from m3gn_bench.datasets import writer
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import find_dataset, open_file, read_metadata
from m3gn_bench.datasets.imports.convert import import_dataset
from m3gn_bench.datasets.imports.ggns import GgnsSource
from m3gn_bench.datasets.imports.pickles import read_pickle
from m3gn_bench.datasets.imports.source import Found
from m3gn_bench.datasets.imports.tfrecord import count_records, parse_example, read_records
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.recorded import require_own
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FIXED, VTK_TETRA, VTK_TRIANGLE, Trajectory
from m3gn_bench.datasets.validator import cell_volumes

SIZES = {"train": 3, "validation": 2, "test": 2}


class Outcome(NamedTuple):
    """Of a command."""

    code: int
    output: str
    errors: str


Command = Callable[..., Outcome]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs the command line in this process."""

    def call(*arguments: object) -> Outcome:
        with pytest.raises(SystemExit) as stop:
            run([str(argument) for argument in arguments])
        output, errors = capsys.readouterr()
        return Outcome(int(stop.value.code or 0), output, errors)

    return call


def parsed(outcome: Outcome) -> dict[str, Any]:
    """The JSON object that a command printed."""
    assert (outcome.code, outcome.errors) == (0, "")
    return json.loads(outcome.output)


def assert_refused(outcome: Outcome, *parts: str) -> None:
    """Exit code 2 and one line that holds the parts."""
    assert (outcome.code, outcome.output) == (2, "")
    (line,) = outcome.errors.splitlines()
    assert line.startswith("error: ")
    for part in parts:
        assert part in line


# --- files as their publishers make them ------------------------------------------------------------------


def seed(word: str, index: int) -> int:
    """Of a trajectory."""
    return 10 * sum(word.encode()) + index


def lattice(nodes: int, side: float, corner: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [nodes², 2] of a square, row by row from its lower edge, and triangles, every other one inside out."""
    x, y = np.meshgrid(*(np.linspace(0, side, nodes) + start for start in corner))
    first = (np.arange(nodes - 1)[:, None] * nodes + np.arange(nodes - 1)).ravel()
    lower = np.stack([first, first + 1, first + nodes + 1], axis=1)
    upper = np.stack([first, first + nodes, first + nodes + 1], axis=1)
    return np.stack([x.ravel(), y.ravel()], axis=1), np.concatenate([lower, upper])


def swaying(rest: np.ndarray, held: np.ndarray, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Positions of a body that bends smoothly away from its held nodes, shape [frames, nodes, dim], float64."""
    size = np.ptp(rest, axis=0).max()
    distance = np.linalg.norm(rest[:, None] - rest[held][None], axis=-1).min(1) / size
    direction = rng.normal(size=rest.shape[1])
    time = np.linspace(0, 1, frames)[:, None, None]
    return rest + 0.1 * size * np.sin(2 * time) * direction * distance[:, None] ** 2


def ring(frames: int, nodes: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A circle that moves down, [frames, nodes, 2], and its edges in both directions, [2 nodes, 2]."""
    angle = 2 * np.pi * np.arange(nodes) / nodes
    centre = np.stack([np.zeros(frames), 130.0 - 2 * np.arange(frames)], axis=1)
    edges = np.stack([np.arange(nodes), (np.arange(nodes) + 1) % nodes], axis=1)
    path = centre[:, None] + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return path, np.concatenate([edges, edges[:, ::-1]])


def plate(seed: int, frames: int = 20) -> dict[str, Any]:
    """A trajectory of GGNS' Deformable Plate."""
    rng = np.random.default_rng(seed)
    rest, triangles = lattice(4, 200.0, (-100.0, -100.0))
    path, edges = ring(frames)
    return {
        "nodes_grid": list(swaying(rest, rest[:, 1] == -100, frames, rng)),
        "edge_index_grid": np.array([[0, 1], [1, 0]]),
        "triangles_grid": triangles,
        "nodes_collider": list(path),
        "edge_index_collider": edges,
        "triangles_collider": np.zeros((0, 3), int),
        "pcd_points": [rng.normal(size=(5 + i, 2)) for i in range(frames)],
        "pcd_colors": None,
        "poisson_ratio": np.float64(rng.choice([-0.9, 0.0, 0.49])),
    }


def tissue(seed: int, frames: int = 42) -> dict[str, Any]:
    """A trajectory of GGNS' Tissue Manipulation: a body's surface, pulled at a point."""
    rng = np.random.default_rng(seed)
    vertices, tetrahedra = box_of_tetrahedra((0.04, 0.01, 0.1), (1, 1, 3))
    faces = np.concatenate(
        [tetrahedra[:, corners] for corners in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])]
    )
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    positions = swaying(vertices, vertices[:, 2] == 0, frames, rng)
    return {
        "tissue_mesh_positions": positions,
        "tissue_mesh_triangles": faces[first[counts == 1]],
        "gripper_position": positions[:, -1].copy(),
        "poisson_ratio": -0.9,
    }


def write_ggns(
    folder: Path, make: Callable[..., dict[str, Any]] = plate, protocol: int = 4, **options: int
) -> Path:
    """NAME_{train,eval,test}.pkl in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for word, number in zip(("train", "eval", "test"), SIZES.values(), strict=True):
        content = [make(seed(word, i), **options) for i in range(number)]
        (folder / f"data_{word}.pkl").write_bytes(pickle.dumps(content, protocol))
    return folder


def write_mango(path: Path, task: str) -> Path:
    """One HDF5 file; each task (material) has two trajectories, and the splits are of tasks."""
    frames = 51 if task == "sheet_deformation" else 20
    rest, triangles = (
        lattice(5, 140.0, (0.0, 0.0)) if task == "sheet_deformation" else lattice(4, 200.0, (-100.0, -100.0))
    )
    held = ((rest == 0) | (rest == 140)).any(1) if task == "sheet_deformation" else rest[:, 1] == -100
    with h5py.File(path, "w") as file:
        for name, numbers in {"train": [4, 0], "val": [2], "test": [1, 3]}.items():
            file[f"splits/{name}_indices"] = numbers
        for number in range(5):
            rng = np.random.default_rng(number)
            group = file.create_group(f"task_{number:03d}")
            group["params/youngs_modulus"] = 50.0 * (number + 1)
            for one in range(2):
                trajectory = group.create_group(f"trajs/traj_{one:03d}")
                if task == "deformable_block":
                    group.require_group("params").pop("poisson_ratio", None)
                    group["params/poisson_ratio"] = -0.1 * number
                    trajectory["mesh_pos"] = swaying(rest, held, frames, rng)
                    trajectory["collider_pos"] = ring(frames)[0]
                else:
                    flat = np.pad(rest, ((0, 0), (0, 1)))
                    trajectory["mesh_pos"] = swaying(flat, held, frames, rng)
                    for name, place, force in (("a", (70, 70, 0), 200.0), ("b", (36, 39, 0), -200.0)):
                        trajectory[f"params/{name}/position"] = place
                        trajectory[f"params/{name}/direction"] = [0.0, 0.0, force]
        if task == "deformable_block":
            file["global_data/cell_indices/mesh_faces"] = triangles
            file["global_data/cell_indices/collider_faces"] = [(0, 1, 2), (2, 3, 4), (4, 5, 0)]
        else:
            file["global_data/cells"] = triangles
    return path


def delimited(field: int, content: bytes) -> bytes:
    """A field of a protocol buffer."""

    def varint(number: int) -> bytes:
        return bytes([number]) if number < 128 else bytes([number & 127 | 128]) + varint(number >> 7)

    return varint(field << 3 | 2) + varint(len(content)) + content


def example(entries: dict[str, np.ndarray]) -> bytes:
    """A tf.train.Example."""
    return delimited(
        1,
        b"".join(
            delimited(
                1, delimited(1, name.encode()) + delimited(2, delimited(1, delimited(1, value.tobytes())))
            )
            for name, value in entries.items()
        ),
    )


def masked(content: bytes) -> bytes:
    crc = crc32c(content)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def record(content: bytes) -> bytes:
    """A record of a TFRecord file."""
    length = struct.pack("<Q", len(content))
    return length + masked(length) + content + masked(content)


def deforming_plate(seed: int, frames: int = 42) -> dict[str, np.ndarray]:
    """A box held at one end (type 3), and another as obstacle (type 1), whose nodes are mixed with the first's."""
    rng = np.random.default_rng(seed)
    vertices, tetrahedra = box_of_tetrahedra((0.5, 0.1, 0.1), (3, 1, 1))
    nodes = len(vertices)
    held = vertices[:, 0] == 0
    body = swaying(vertices, held, frames, rng)
    obstacle = vertices * 0.2 + [0.5, 0.0, 0.15] - np.linspace(0, 0.05, frames)[:, None, None] * [0, 0, 1]
    order = rng.permutation(2 * nodes)  # place[order] in the file
    place = np.argsort(order)
    return {
        "world_pos": np.concatenate([body, obstacle], axis=1)[:, order].astype("<f4"),
        "mesh_pos": np.concatenate([vertices, obstacle[0]])[order].astype("<f4"),
        "cells": place[np.concatenate([tetrahedra, tetrahedra + nodes])].astype("<i4"),
        "node_type": np.concatenate([np.where(held, 3, 0), np.ones(nodes, int)])[order].astype("<i4"),
        "stress": np.zeros((frames, 2 * nodes, 1), "<f4"),
    }


def flag(seed: int, frames: int = 52) -> dict[str, np.ndarray]:
    """A cloth that hangs from two corners; its stress-free shape has two coordinates."""
    sheet, triangles = lattice(4, 1.0, (0.0, 0.0))
    upright = np.stack([sheet[:, 0], np.zeros(len(sheet)), sheet[:, 1]], axis=1)
    held = np.isin(np.arange(len(sheet)), [12, 15])
    return {
        "world_pos": swaying(upright, held, frames, np.random.default_rng(seed)).astype("<f4"),
        "mesh_pos": sheet.astype("<f4"),
        "cells": triangles.astype("<i4"),
        "node_type": np.where(held, 3, 0).astype("<i4"),
    }


def write_deepmind(
    folder: Path, make: Callable[[int], dict[str, np.ndarray]] = deforming_plate, dt: float = 0
) -> Path:
    """A folder of meta.json and {train,valid,test}.tfrecord."""
    folder.mkdir(parents=True, exist_ok=True)
    sample = make(0)
    features = {
        name: {
            "type": "dynamic" if value.ndim == 3 else "static",
            "dtype": {"f": "float32", "i": "int32"}[value.dtype.kind],
            "shape": [len(value) if value.ndim == 3 else 1, -1, value.shape[-1] if value.ndim > 1 else 1],
        }
        for name, value in sample.items()
    }
    meta = {
        "simulator": "comsol",
        "dt": dt,
        "collision_radius": None,
        "trajectory_length": len(sample["world_pos"]),
        "field_names": list(sample),
        "features": features,
    }
    (folder / "meta.json").write_text(json.dumps(meta))
    for word, number in zip(("train", "valid", "test"), SIZES.values(), strict=True):
        content = b"".join(record(example(make(seed(word, i)))) for i in range(number))
        (folder / f"{word}.tfrecord").write_bytes(content)
    return folder


class Published(NamedTuple):
    """Files, and what they are imported as."""

    path: Path
    layout: str
    task: str


WRITERS: dict[tuple[str, str], Callable[[Path], Path]] = {
    ("ggns", "deformable_block"): write_ggns,
    ("ggns", "tissue_manipulation"): lambda path: write_ggns(path, tissue),
    ("mango", "deformable_block"): lambda path: write_mango(path, "deformable_block"),
    ("mango", "sheet_deformation"): lambda path: write_mango(path, "sheet_deformation"),
    ("deepmind", "tissue_manipulation"): write_deepmind,
    ("deepmind", "falling_teddy"): lambda path: write_deepmind(path, flag, dt=0.02),
}


@pytest.fixture(params=WRITERS, ids="-".join)
def published(request: pytest.FixtureRequest, tmp_path: Path) -> Published:
    """Each kind of published files."""
    layout, task = request.param
    return Published(WRITERS[layout, task](tmp_path / "published"), layout, task)


def imported(command: Command, published: Published, *arguments: object) -> tuple[Path, dict[str, Any]]:
    """The file that the command makes, and what it says of it."""
    out = published.path.parent / "out" / "imported.h5"
    said = parsed(
        command(
            *("import", published.path, "--layout", published.layout, "--task", published.task),
            *("-o", out, "--json", *arguments),
        )
    )
    return out, said


def read(path: Path, task: str, split: Split, index: int = 0) -> Trajectory:
    return TrajectoryDataset(path, task, split)[index]


# --- what comes out ---------------------------------------------------------------------------------------


def test_imported_files_are_valid_and_can_be_learned_from(
    command: Command, published: Published, tmp_path: Path
) -> None:
    out, said = imported(command, published)
    assert said["file"] == str(out)
    assert list(out.parent.iterdir()) == [out]  # and nothing temporary
    sizes = SIZES if published.layout != "mango" else {"train": 4, "validation": 2, "test": 4}
    assert said["trajectories"] == sizes
    checked = parsed(command("validate", out, "--strict", "--json"))
    assert (checked["ok"], checked["problems"]) == (True, [])

    run_folder = tmp_path / "run"
    model = ["--model", "m3gn", "--json", "--threads", 1]
    training = ["--task", published.task, "--preset", "smoke", "--steps", 3, "--out", run_folder]
    trained = parsed(command("train", *training, *model, "--dataset", out))
    assert trained["steps"] == 3
    scores = parsed(command("evaluate", *model, "--checkpoint", run_folder, "--dataset", out))
    assert scores["dataset"] == str(out)
    assert {row["trajectories"] for row in scores["results"]} == {sizes["test"]}
    assert {row["recorded_mse"] for row in scores["results"]} == {None}
    for row in scores["results"]:
        assert 0 < row["mse"] < np.inf
        assert len(row["per_timestep_mse"]) == said["frames"] - row["context"]


def test_models_of_fixed_horizon_take_the_length_of_the_data(command: Command, tmp_path: Path) -> None:
    out, said = imported(command, Published(write_ggns(tmp_path / "plates"), "ggns", "deformable_block"))
    assert (said["frames"], said["benchmark_frames"]) == (20, 39)
    for model in ("egno", "nearest_neighbour"):
        folder = tmp_path / model
        arguments = ["--model", model, "--threads", 1, "--dataset", out]
        training = ["--task", "deformable_block", "--preset", "smoke", "--steps", 2, "--out", folder]
        parsed(command("train", *training, *arguments, "--json"))
        scores = parsed(
            command("evaluate", *arguments, "--checkpoint", folder, "--json", "--contexts", "2,19")
        )
        assert [len(row["per_timestep_mse"]) for row in scores["results"]] == [18, 1]


def test_predictions_are_drawn_beside_them(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out, _ = imported(command, Published(write_ggns(tmp_path / "plates"), "ggns", "deformable_block"))
    model = ["--task", "deformable_block", "--model", "stand_still", "--out", tmp_path / "run"]
    parsed(command("train", *model, "--steps", 1, "--preset", "smoke", "--dataset", out, "--json"))
    picture = ["-o", tmp_path / "x.png", "--frames", 1, "--index", 1]
    shown = parsed(command("view", out, "--checkpoint", tmp_path / "run", *picture, "--json"))
    assert (shown["trajectory"], shown["panels"]) == ("test_00001", ["truth", "stand_still"])
    assert_refused(
        command("view", out, "--checkpoint", tmp_path / "run", "--task", "tissue_manipulation", *picture),
        "unknown task 'tissue_manipulation'; known: deformable_block",
    )


def test_a_point_with_an_axis_of_its_own(command: Command, tmp_path: Path) -> None:
    """As some readers of these files expect it."""

    def with_axis(seed: int) -> dict[str, Any]:
        made = tissue(seed)
        return made | {"gripper_position": made["gripper_position"][:, None]}

    paths = []
    for number, make in enumerate((tissue, with_axis)):
        folder = write_ggns(tmp_path / f"tissue{number}", make)
        out, _ = imported(command, Published(folder, "ggns", "tissue_manipulation"))
        paths.append(read(out, "tissue_manipulation", "test", 0).collider_positions)
        out.rename(tmp_path / f"{number}.h5")
    np.testing.assert_array_equal(paths[0], paths[1])


def test_names_that_are_no_words(command: Command, tmp_path: Path) -> None:
    for number, entry in enumerate(({0: 1}, {0: 1, "a": 2})):
        path = tmp_path / f"names{number}_train.pkl"
        path.write_bytes(pickle.dumps([entry]))
        assert_refused(command("import", path, *GGNS), "unknown entry 'nodes_grid'; known: 0")


def test_numbers_of_ggns(command: Command, tmp_path: Path) -> None:
    folder = write_ggns(tmp_path / "plates")
    out, _ = imported(command, Published(folder, "ggns", "deformable_block"))
    original = pickle.loads((folder / "data_eval.pkl").read_bytes())[1]
    found = read(out, "deformable_block", "validation", 1)
    np.testing.assert_array_equal(found.positions, np.array(original["nodes_grid"], np.float32))
    np.testing.assert_array_equal(found.collider_positions, np.array(original["nodes_collider"], np.float32))
    assert found.material == {"poisson_ratio": original["poisson_ratio"]}
    assert np.flatnonzero(found.mesh.node_type == FIXED).tolist() == [0, 1, 2, 3]
    assert found.mesh.cell_type == VTK_TRIANGLE
    assert {*map(frozenset, found.mesh.cells.tolist())} == {
        *map(frozenset, original["triangles_grid"].tolist())
    }
    assert found.collider_edges is not None
    assert len(found.collider_edges) == 6
    with open_file(out) as file:
        metadata = read_metadata(file)
    assert (metadata.scale_centre, metadata.scale_length, metadata.dt) == ((0, 0), 100, 0.01)


def test_numbers_of_mango(command: Command, tmp_path: Path) -> None:
    path = write_mango(tmp_path / "sheets.hdf5", "sheet_deformation")
    out, _ = imported(command, Published(path, "mango", "sheet_deformation"))
    found = read(out, "sheet_deformation", "train", 1)  # the second of task 4, which the file lists first
    with h5py.File(path) as file:
        expected = file["task_004/trajs/traj_001/mesh_pos"][()]
    np.testing.assert_array_equal(found.positions, expected.astype(np.float32))
    assert found.material == {"youngs_modulus": 250.0}
    assert found.tags == {"task": "task_004", "trajectory": "traj_001"}
    assert np.count_nonzero(found.mesh.node_type == FIXED) == 16
    loaded = np.flatnonzero(found.loads["nodal_forces"][:, 2])  # (70, 70) and (35, 35) in a lattice of 35 mm
    assert dict(zip(loaded, found.loads["nodal_forces"][loaded, 2], strict=True)) == {6: -200, 12: 200}


def test_numbers_of_deepmind(command: Command, tmp_path: Path) -> None:
    folder = write_deepmind(tmp_path / "deforming_plate")
    out, said = imported(command, Published(folder, "deepmind", "tissue_manipulation"))
    assert said["material"] == []
    original = deforming_plate(seed("test", 1))
    found = read(out, "tissue_manipulation", "test", 1)
    body = original["node_type"] != 1
    np.testing.assert_array_equal(found.positions, original["world_pos"][:, body])
    np.testing.assert_array_equal(found.collider_positions, original["world_pos"][:, ~body])
    np.testing.assert_array_equal(found.mesh.rest_positions, original["mesh_pos"][body])
    np.testing.assert_array_equal(found.mesh.node_type == FIXED, original["node_type"][body] == 3)
    assert found.mesh.cell_type == VTK_TETRA
    volumes = cell_volumes(found.mesh.rest_positions, found.mesh.cells, VTK_TETRA)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(0.5 * 0.1 * 0.1)
    assert found.collider_edges is not None
    assert found.collider_edges.max() == len(found.collider_positions[0]) - 1  # type: ignore[index]


def test_a_cloth_is_laid_out_flat(command: Command, tmp_path: Path) -> None:
    folder = write_deepmind(tmp_path / "flag_simple", flag, dt=0.02)
    out, _ = imported(command, Published(folder, "deepmind", "falling_teddy"))
    rest = read(out, "falling_teddy", "train").mesh.rest_positions
    np.testing.assert_array_equal(rest[:, :2], flag(0)["mesh_pos"])
    assert not rest[:, 2].any()
    with open_file(out) as file:
        assert (read_metadata(file).dt, read_metadata(file).time_unit) == (0.02, "s")


def test_choosing_frames_and_trajectories(command: Command, tmp_path: Path) -> None:
    folder = write_ggns(tmp_path / "plates", frames=50)
    arguments = ["--skip", 11, "--every", 2, "--frames", 18, "--limit", 2]
    out, said = imported(command, Published(folder, "ggns", "deformable_block"), *arguments)
    assert (said["frames"], said["trajectories"]) == (18, {"train": 2, "validation": 2, "test": 2})
    original = np.array(pickle.loads((folder / "data_train.pkl").read_bytes())[0]["nodes_grid"], np.float32)
    found = read(out, "deformable_block", "train")
    np.testing.assert_array_equal(found.positions, original[11:47:2])
    np.testing.assert_array_equal(found.mesh.rest_positions, original[0])
    with open_file(out) as file:
        assert read_metadata(file).dt == 0.02


def test_noise_of_rounding_does_not_free_a_held_node(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "plates"
    folder.mkdir()
    entry = plate(0)
    rng = np.random.default_rng(0)
    entry["nodes_grid"] = [frame + rng.uniform(-4e-5, 4e-5, frame.shape) for frame in entry["nodes_grid"]]
    (folder / "data_train.pkl").write_bytes(pickle.dumps([entry]))
    out, _ = imported(command, Published(folder, "ggns", "deformable_block"))
    found = read(out, "deformable_block", "train")
    assert np.flatnonzero(found.mesh.node_type == FIXED).tolist() == [0, 1, 2, 3]
    assert parsed(command("validate", out, "--json"))["ok"]


def test_the_file_is_never_taken_for_the_benchmark_s(command: Command, tmp_path: Path) -> None:
    folder = write_ggns(tmp_path / "plates")
    data = tmp_path / "data"
    arguments = ["import", folder, "--layout", "ggns", "--task", "deformable_block", "--data", data]
    assert command(*arguments).code == 0
    out = data / "ggns_deformable_block.h5"
    with open_file(out) as file:
        metadata = read_metadata(file)
    assert metadata.is_imported
    assert not metadata.is_benchmark
    assert metadata.variant == {"imported": "ggns"}
    assert metadata.licence == "that of the source"
    for name in ("deformable_block-paper.h5", "ggns_deformable_block-paper.h5"):
        out.rename(data / name)
        for scene in ("deformable_block", "ggns_deformable_block"):
            assert find_dataset(data, scene, "paper", ["test"]) is None
        (data / name).rename(out)
    with pytest.raises(DatasetError, match="not the benchmark's own"):
        require_own(out)
    assert_refused(
        command("evaluate", "--model", "stand_still", "--dataset", out, "--record", tmp_path / "board"),
        "--record takes the benchmark's own data",
    )
    assert_refused(command(*arguments), "exists already")


# --- what is refused --------------------------------------------------------------------------------------


class Malicious:
    """Runs a command when an ordinary unpickler reads it."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    ("function", "name"), [(os.mkdir, "posix.mkdir|nt.mkdir"), (eval, "builtins.eval|__builtin__.eval")]
)
def test_a_malicious_pickle_does_not_run(
    command: Command, tmp_path: Path, protocol: int, function: Callable[..., object], name: str
) -> None:
    trace = tmp_path / "it-ran"
    argument = f"__import__('os').mkdir({str(trace)!r})" if function is eval else str(trace)
    path = tmp_path / "data_train.pkl"
    path.write_bytes(pickle.dumps([{**plate(0), "poisson_ratio": Malicious(function, argument)}], protocol))
    outcome = command(
        "import", path, "--layout", "ggns", "--task", "deformable_block", "-o", tmp_path / "o.h5"
    )
    assert_refused(outcome, str(path), "was not read")
    assert any(part in outcome.errors for part in name.split("|"))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["data_train.pkl"]
    pickle.loads(path.read_bytes())
    assert trace.exists()  # it would have run


def opcodes(*lines: bytes) -> bytes:
    return b"".join(lines) + b"."


@pytest.mark.parametrize(
    ("content", "message"),
    [
        # objects at an address of the writer's choice
        (opcodes(b"cnumpy\nndarray\n", b"(I1\ntR"), "not callable"),
        (opcodes(b"cnumpy._core.multiarray\nscalar\n", b"(cnumpy\ndtype\n(VO\ntRC\x0812345678tR"), "type 'O'"),
        (
            opcodes(
                b"cnumpy.core.multiarray\nscalar\n",
                b"(cnumpy\ndtype\n(VO8\ntR(I3\nV|\nNNNI-1\nI-1\nI0\ntb",
                b"C\x0812345678tR",
            ),
            "type 'O8'",
        ),
        # a list that is shorter than its array
        (
            opcodes(
                b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntC\x01btR",
                b"(I1\n(I234\ntcnumpy\ndtype\n(VO8\ntRI00\n(ltb",
            ),
            "234.* with 0 entries",
        ),
        # changing what was handed out
        (opcodes(b"cnumpy\ndtype\n", b"(N}V_function\nI1\nstb"), "function with a state"),
        (opcodes(b"cnumpy\ndtype.__init__.__globals__\n"), "asks for numpy.dtype.__init__"),
        (opcodes(b"cm3gn_bench.datasets.imports.pickles\nADMITTED\n"), "asks for m3gn_bench"),
        (b"not a pickle", "no pickle of plain arrays"),
        (pickle.dumps(np.arange(1000.0))[:-500], "no pickle of plain arrays"),
    ],
)  # fmt: skip
def test_tricks_with_admitted_names(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read_pickle(tmp_path / "a.pkl")


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_plain_pickles_arrive_whole(tmp_path: Path, protocol: int) -> None:
    rows = np.empty(2, object)
    rows[:] = [np.arange(2), np.arange(3.0)]
    content = {
        "big": np.arange(6, dtype=">i4").reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "scalar": np.float32(1.5),
        "rows": rows,
        "words": ("ü", b"\xff", {1}, None, True, 2**80),
        "truth": np.array([True, False]),
        "empty": np.zeros((0, 3)),
    }
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(content, protocol))
    found = read_pickle(path)
    assert found["words"] == content["words"]
    for name in ("big", "columns", "scalar", "truth", "empty"):
        np.testing.assert_array_equal(found[name], content[name])
        assert found[name].dtype.newbyteorder("=") == np.asarray(content[name]).dtype.newbyteorder("=")
    for one, other in zip(found["rows"], rows, strict=True):
        np.testing.assert_array_equal(one, other)


def test_names_of_old_and_new_numpy(tmp_path: Path) -> None:
    """numpy 2 renamed the module that its pickles name."""
    new = pickle.dumps(np.arange(3), 2)
    assert any(
        argument == "numpy._core.multiarray _reconstruct" for _, argument, _ in pickletools.genops(new)
    )
    for content in (new, new.replace(b"numpy._core", b"numpy.core")):
        (tmp_path / "a.pkl").write_bytes(content)
        np.testing.assert_array_equal(read_pickle(tmp_path / "a.pkl"), np.arange(3))


# Written by another program (tfrecord 1.14.6): {"pos": float32 0 and 1 as bytes, "n": 3 as a number}, {"pos": b""}.
BY_ANOTHER_PROGRAM = bytes.fromhex(
    "2300000000000000b09f77430a210a0a0a016e12051a030a01030a130a03706f73120c0a0a0a08000000000000803ff164fd65"
    "0f000000000000006d532b090a0d0a0b0a03706f7312040a020a00112eef66"
)


def test_tfrecord_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(BY_ANOTHER_PROGRAM)
    assert count_records(path) == 2
    first, second = map(parse_example, read_records(path))
    assert first == {"pos": np.array([0, 1], "<f4").tobytes(), "n": b""}
    assert second == {"pos": b""}


@pytest.mark.parametrize("kept", [4, 11, 30, 50, len(BY_ANOTHER_PROGRAM) - 1])
def test_truncated_tfrecord(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(BY_ANOTHER_PROGRAM[:kept])
    for read_all in (lambda: list(read_records(path)), lambda: count_records(path)):
        with pytest.raises(DatasetError, match="truncated: it ends within record"):
            read_all()


@pytest.mark.parametrize("length", [2**45, 2**63])
def test_lengths_that_no_file_has(tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.tfrecord"
    head = struct.pack("<Q", length)
    path.write_bytes(BY_ANOTHER_PROGRAM + head + masked(head))
    for read_all in (lambda: list(read_records(path)), lambda: count_records(path)):
        with pytest.raises(DatasetError, match=r"a.tfrecord is truncated: it ends within record 2"):
            read_all()


def test_what_the_system_does_not_let_one_read(tmp_path: Path) -> None:
    """A folder stands for all of that."""
    for read_all in (read_pickle, count_records, lambda path: list(read_records(path))):
        with pytest.raises(DatasetError, match=f"cannot read {tmp_path}: Is a directory"):
            read_all(tmp_path)


def test_records_without_the_library(
    command: Command, shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "google_crc32c", None)
    outcome = command("import", shelf / "deforming_plate", *DEEPMIND, "-o", tmp_path / "o.h5")
    assert_refused(outcome, "reading TFRecord takes google-crc32c", "pip install 'm3gn-bench[import]'")


@pytest.mark.parametrize("byte", [0, 9, 20, 48, 52])
def test_damaged_tfrecord(tmp_path: Path, byte: int) -> None:
    content = bytearray(BY_ANOTHER_PROGRAM)
    content[byte] ^= 1
    path = tmp_path / "a.tfrecord"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"checksum of record [01] does not match"):
        list(read_records(path))


@pytest.mark.parametrize("content", [b"\x0a\x05ab", b"\x0a", b"\x0f", b"\x80", b"\x09ab"])
def test_malformed_examples(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"byte|number"):
        parse_example(content)


Spoil = Callable[[dict[str, Any]], object]


def replaced(**changes: object) -> Spoil:
    return lambda entry: entry.update(changes)


def ruined(entry: dict[str, Any]) -> None:
    entry["nodes_grid"][3] = entry["nodes_grid"][3] * np.nan


def flattened(entry: dict[str, Any]) -> None:
    """The third node of a triangle is moved between the two others, in all frames."""
    first, second, third = entry["triangles_grid"][0]
    for frame in entry["nodes_grid"]:
        frame[third] = (frame[first] + frame[second]) / 2


def collapsed(entry: dict[str, Any]) -> None:
    entry["nodes_grid"][0] = entry["nodes_grid"][0] * 0


def out_of_range(entry: dict[str, Any]) -> None:
    """In 32 bits it would be in range."""
    entry["triangles_grid"] = entry["triangles_grid"].astype(np.int64)
    entry["triangles_grid"][0, 0] += 2**32


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (lambda entry: entry.pop("poisson_ratio"), ["unknown entry 'poisson_ratio'", "known: edge_index"]),
        (lambda entry: entry.pop("nodes_collider"), ["'nodes_collider'", "trajectory 1"]),
        (replaced(poisson_ratio="soft"), ["poisson_ratio holds", "not numbers"]),
        (replaced(triangles_grid=np.zeros((2, 3))), ["triangles_grid holds float64, not integers"]),
        (replaced(triangles_grid=np.array([[0, 1, 99]])), ["cells refer to nodes 0 to 99 of 16"]),
        (out_of_range, ["cells refer to nodes 0 to 4294967296 of 16"]),
        (replaced(triangles_grid=np.zeros((0, 3), int)), ["cells of shape (0, 3)", "are no triangles"]),
        (flattened, ["the smallest cell at rest has volume 0"]),
        (collapsed, ["all nodes start at the same place"]),
        (
            replaced(edge_index_collider=np.array([[0, 999], [1, 2]])),
            ["collider edges refer to nodes 0 to 999 of 6"],
        ),
        (replaced(poisson_ratio=np.nan), ["the material is not finite"]),
        (
            replaced(nodes_collider=np.full((20, 6, 2), np.inf)),
            ["collider_positions holds 240 numbers that are not"],
        ),
        (replaced(nodes_grid=np.zeros((0, 16, 2))), ["0 of its 0 frames are left"]),
        (replaced(nodes_grid=np.zeros((20, 0, 2))), ["there are none"]),
        (
            replaced(nodes_grid=np.zeros((20, 16, 3))),
            ["nodes_grid has shape (20, 16, 3), expected (any, any, 2)"],
        ),
        (replaced(nodes_grid=[np.zeros((2, 2)), np.zeros((3, 2))]), ["nodes_grid is no array of numbers"]),
        (replaced(nodes_grid=np.ones((20, 16, 2))), ["nothing moves"]),
        (ruined, ["positions are not finite"]),
        (replaced(nodes_collider=np.zeros((5, 6, 2))), ["20 frames, its collider 5"]),
        (
            lambda entry: entry.update(plate(0, frames=19)),
            ["has 19 frames, those before it 20", "--frames 19"],
        ),
    ],
)
def test_spoiled_trajectories(command: Command, tmp_path: Path, spoil: Spoil, parts: list[str]) -> None:
    entries = [plate(0), plate(1)]
    spoil(entries[1])
    path, out = tmp_path / "data_train.pkl", tmp_path / "out" / "o.h5"
    path.write_bytes(pickle.dumps(entries))
    outcome = command("import", path, "--layout", "ggns", "--task", "deformable_block", "-o", out)
    assert_refused(outcome, str(path), *parts)
    assert list(out.parent.iterdir()) == []


def test_one_split_at_a_time_is_in_memory(tmp_path: Path) -> None:
    opened: list[weakref.ref[Iterator[Found]]] = []

    class Watched(GgnsSource):
        def open(self, split: Split) -> tuple[int, Iterator[Found]]:
            assert [found() for found in opened] == [None] * len(opened)
            number, found = super().open(split)
            opened.append(weakref.ref(found))
            return number, found

    source = Watched([write_ggns(tmp_path / "plates")], "deformable_block")
    import_dataset(source, "ggns", "deformable_block", tmp_path / "o.h5", version="0")
    assert len(opened) == 3


def test_what_the_source_raises_is_not_the_writer_s(tmp_path: Path) -> None:
    """Errors of HDF5 alone are taken for errors of writing."""

    class Failing(GgnsSource):
        def open(self, split: Split) -> tuple[int, Iterator[Found]]:
            if split == "test":
                raise RuntimeError("a mistake of ours")
            return super().open(split)

    source = Failing([write_ggns(tmp_path / "plates")], "deformable_block")
    with pytest.raises(RuntimeError, match="a mistake of ours"):
        import_dataset(source, "ggns", "deformable_block", tmp_path / "out" / "o.h5", version="0")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_full_disk(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> str:
        raise RuntimeError("Unable to flush file (errno = 28, error message = 'No space left on device')")

    monkeypatch.setattr(writer, "_write_trajectory", refuse)
    out = tmp_path / "out" / "o.h5"
    outcome = command("import", write_ggns(tmp_path / "plates"), *GGNS, "-o", out)
    assert_refused(outcome, f"cannot write {out}: No space left on device")
    assert list(out.parent.iterdir()) == []


GGNS = ["--layout", "ggns", "--task", "deformable_block"]
MANGO = ["--layout", "mango", "--task", "sheet_deformation"]
DEEPMIND = ["--layout", "deepmind", "--task", "tissue_manipulation"]


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset of each layout."""
    folder = tmp_path_factory.mktemp("shelf")
    write_ggns(folder / "plates")
    write_mango(folder / "sheets.hdf5", "sheet_deformation")
    write_deepmind(folder / "deforming_plate")
    (folder / "short").mkdir()
    (folder / "short" / "data_train.pkl").write_bytes(pickle.dumps([plate(0, frames=15)]))
    write_deepmind(folder / "long_plate", lambda seed: deforming_plate(seed, frames=52))
    (write_deepmind(folder / "half_plate") / "valid.tfrecord").unlink()
    (folder / "half_plate" / "valid.tfrecord").mkdir()
    (folder / "half.hdf5").write_bytes((folder / "sheets.hdf5").read_bytes()[:3000])
    (folder / "other.pkl").write_bytes(pickle.dumps([]))
    (folder / "words_train.pkl").write_bytes(pickle.dumps({"a": 1}))
    (folder / "none_train.pkl").write_bytes(pickle.dumps([]))
    return folder


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["plates", *GGNS, "--layout", "vtk"], ["unknown layout 'vtk'", "known: deepmind, ggns, mango"]),
        (["plates", *GGNS, "--task", "bending"], ["unknown task 'bending'", "known: deformable_block,"]),
        (["plates", *GGNS, "--task", "falling_teddy"], ["layout ggns", "known: deformable_block, tissue_"]),
        (["plates", *GGNS, "--task", "tissue_manipulation"], ["'tissue_mesh_positions'", "known: edge_"]),
        (["absent", *GGNS], ["no .pkl file at absent"]),
        (["deforming_plate", *GGNS], ["no .pkl file at deforming_plate"]),
        (["half_plate", *DEEPMIND], ["no .tfrecord file at half_plate/valid.tfrecord"]),
        (["other.pkl", *GGNS], ["must tell the split", "'other'", "known: eval, test, train"]),
        (["plates", "words_train.pkl", *GGNS], ["are of the train split"]),
        (["words_train.pkl", *GGNS], ["no list of trajectories"]),
        (["none_train.pkl", *GGNS], ["no trajectories in the train"]),
        (["short", *GGNS], ["15 frames are too few for task deformable_block", "up to 15"]),
        (["plates", *GGNS, "--skip", "19"], ["1 of its 20 frames are left"]),
        (["sheets.hdf5", *MANGO, "--task", "deformable_block"], ["mesh_pos has shape (51, 25, 3), expected ("]),
        (["sheets.hdf5", "plates", *MANGO], ["one HDF5 file"]),
        (["half.hdf5", *MANGO], ["half.hdf5", "damaged"]),
        (["long_plate", *DEEPMIND, "--task", "falling_teddy"], ["has a collider, but task falling_teddy"]),
    ],
    ids=lambda value: " ".join(value[-3:]) if "--layout" in value else None,
)  # fmt: skip
def test_import_refuses(
    command: Command, shelf: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], parts: list[str]
) -> None:
    monkeypatch.chdir(shelf)
    before = sorted(shelf.iterdir())
    assert_refused(command("import", *arguments), *parts)
    assert sorted(shelf.iterdir()) == before


def meta_changes() -> Iterator[tuple[str, Callable[[dict[str, Any]], object], str]]:
    yield "no positions", lambda m: m["features"].pop("world_pos"), "nothing deforms"
    yield "no cells", lambda m: m["features"].pop("cells"), "unknown entry 'cells'"
    yield "remeshed", lambda m: m["features"]["cells"].update(type="dynamic_varlen"), "change with time"
    yield "type", lambda m: m["features"]["cells"].update(dtype="object"), "features.cells.dtype"
    yield "shape", lambda m: m["features"]["world_pos"].update(shape=[42, -1, 2]), "world_pos"
    yield "dimension", lambda m: m["features"]["mesh_pos"].update(shape=[1, 8, -1]), "bodies in space"
    yield "frames", lambda m: m["features"]["cells"].update(shape=[-1, 2, 4]), "do not belong together"
    yield "cells of points", lambda m: m["features"]["cells"].update(shape=[1, -1, 1]), "neither triangles"
    yield "cells of floats", lambda m: m["features"]["cells"].update(dtype="float32"), "not integers"
    yield "length", lambda m: m.update(trajectory_length=7), "do not belong together"
    yield "no length", lambda m: m.pop("trajectory_length"), "trajectory_length: Field required"


@pytest.mark.parametrize(
    ("change", "part"), [(c, p) for _, c, p in meta_changes()], ids=[n for n, *_ in meta_changes()]
)
def test_deepmind_meta(
    command: Command, tmp_path: Path, change: Callable[[dict[str, Any]], object], part: str
) -> None:
    folder = write_deepmind(tmp_path / "data")
    meta = json.loads((folder / "meta.json").read_text())
    change(meta)
    (folder / "meta.json").write_text(json.dumps(meta))
    assert_refused(command("import", folder, *DEEPMIND, "-o", tmp_path / "o.h5"), part)
    (folder / "meta.json").unlink()
    assert_refused(command("import", folder, *DEEPMIND, "-o", tmp_path / "o.h5"), "meta.json")


def pulled(entry: dict[str, np.ndarray]) -> None:
    entry["world_pos"][5, entry["node_type"] == 3] += np.float32(0.1)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda entry: entry.pop("cells"), "record 0: unknown entry 'cells'"),
        (lambda entry: entry.update(node_type=entry["node_type"] + np.int32(3)), "nodes of type"),
        (lambda entry: entry["cells"].put(0, 999), "cells refer to nodes 0 to 999 of 32"),
        (lambda entry: entry["node_type"].put(np.flatnonzero(entry["node_type"] == 1)[0], 0), "of the body and of"),
        (pulled, "a node that the source holds moves by 0.1"),
    ],
)  # fmt: skip
def test_spoiled_records(
    command: Command, tmp_path: Path, spoil: Callable[[dict[str, np.ndarray]], object], part: str
) -> None:
    folder = write_deepmind(tmp_path / "data")
    entry = deforming_plate(0)
    spoil(entry)
    (folder / "train.tfrecord").write_bytes(record(example(entry)))
    assert_refused(command("import", folder, *DEEPMIND, "-o", tmp_path / "o.h5"), part)
    assert not (tmp_path / "o.h5").exists()


Damage = Callable[[h5py.File], object]
ONE = "task_004/trajs/traj_000"


def elsewhere(name: str) -> Damage:
    """The array's bytes are those of another file."""

    def point(file: h5py.File) -> None:
        array = file.pop(name)
        file.create_dataset(name, array.shape, array.dtype, external=[(__file__, 0, array.nbytes)])

    return point


def virtual(name: str) -> Damage:
    def point(file: h5py.File) -> None:
        array = file.pop(name)
        layout = h5py.VirtualLayout(array.shape, array.dtype)
        layout[:] = h5py.VirtualSource("other.hdf5", "x", array.shape)
        file.create_virtual_dataset(name, layout)

    return point


def linked(name: str) -> Damage:
    """What bears the name is in another file, by way of a link within this one."""

    def point(file: h5py.File) -> None:
        with h5py.File(Path(file.filename).with_name("other.hdf5"), "w") as other:
            file.copy(name, other, "x")
        del file[name]
        file["hidden"] = h5py.ExternalLink("other.hdf5", "/x")
        file[name] = h5py.SoftLink("/hidden")

    return point


def empty(name: str, *shape: int) -> Damage:
    """An array of which nothing is stored."""

    def declare(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, shape, "f4")

    return declare


def changed(name: str, value: object) -> Damage:
    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return change


@pytest.mark.parametrize(
    ("damage", "part"),
    [
        (elsewhere(f"{ONE}/mesh_pos"), "mesh_pos is kept in another file"),
        (elsewhere("global_data/cells"), "cells is kept in another file"),
        (virtual("global_data/cells"), "cells is kept in another file"),
        (linked(f"{ONE}/mesh_pos"), "mesh_pos is in another file"),
        (linked("global_data"), "global_data is in another file"),
        (linked(f"{ONE}/params/a"), "a is in another file"),
        (empty(f"{ONE}/mesh_pos", 2**49, 3), "has 0 bytes in the file"),
        (changed(f"{ONE}/mesh_pos", np.zeros((0, 25, 3))), "is closer than 10 mm to no node"),
        (changed(f"{ONE}/params/b/position", [500.0, 0.0, 0.0]), "params/b: the force is closer than 10 mm to no node"),
        (changed("task_004/params/youngs_modulus", 0.0), "youngs_modulus is 0, of which models are told the logarithm"),
    ],
)  # fmt: skip
def test_spoiled_hdf5(command: Command, tmp_path: Path, damage: Damage, part: str) -> None:
    path = write_mango(tmp_path / "sheets.hdf5", "sheet_deformation")
    with h5py.File(path, "r+") as file:
        damage(file)
    assert_refused(command("import", path, *MANGO, "-o", tmp_path / "o.h5"), str(path), part)
    assert not (tmp_path / "o.h5").exists()


def test_large_indices_of_colliders(command: Command, tmp_path: Path) -> None:
    """In 32 bits they would be in range."""
    path = write_mango(tmp_path / "plates.hdf5", "deformable_block")
    with h5py.File(path, "r+") as file:
        changed("global_data/cell_indices/collider_faces", np.array([[0, 1, 2 + 2**32]]))(file)
    outcome = command("import", path, *MANGO, "--task", "deformable_block", "-o", tmp_path / "o.h5")
    assert_refused(outcome, "collider edges refer to nodes 0 to 4294967298 of 6")


def test_damage_in_the_middle_leaves_nothing(command: Command, tmp_path: Path) -> None:
    folder = write_deepmind(tmp_path / "data")
    path = folder / "train.tfrecord"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    out = tmp_path / "out" / "o.h5"
    assert_refused(command("import", folder, *DEEPMIND, "-o", out), "checksum of record 2 does not match")
    assert list(out.parent.iterdir()) == []


def test_models_that_are_told_the_material_need_it(command: Command, tmp_path: Path) -> None:
    folder = write_deepmind(tmp_path / "data")
    out, _ = imported(command, Published(folder, "deepmind", "tissue_manipulation"))
    training = ["--task", "tissue_manipulation", "--preset", "smoke", "--steps", 2, "--out", tmp_path / "run"]
    assert_refused(
        command("train", "--model", "mgn_material", *training, "--dataset", out), "told the material"
    )
