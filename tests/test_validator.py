"""The validator sees every planted defect, under its code, and survives any damage."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import Change, TetraWriter

from m3gn_bench.datasets.file import open_file, read_metadata, read_splits, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import VTK_TRIANGLE, Trajectory
from m3gn_bench.datasets.validator import CODES, Problem, validate

KEY = "validation_00001"
GROUP = f"/trajectories/{KEY}"
TASK = "/splits/tetra_task"


# --- defects of a file: planted into a copy of a valid one ------------------------------------------------


def edit(change: Callable[[h5py.File], object]) -> Callable[[Path], None]:
    """A defect that is planted through h5py."""

    def plant(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return plant


def set_attribute(name: str, value: Any, group: str = "/") -> Callable[[Path], None]:
    return edit(lambda file: file[group].attrs.__setitem__(name, value))


def delete_attribute(name: str) -> Callable[[Path], None]:
    return edit(lambda file: file.attrs.__delitem__(name))


def delete(name: str) -> Callable[[Path], None]:
    return edit(lambda file: file.__delitem__(name))


def replace_array(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    def swap(file: h5py.File) -> None:
        array = file[name][()]
        del file[name]
        file[name] = change(array)

    return edit(swap)


def store_otherwise(name: str, **layout: Any) -> Callable[[Path], None]:
    """An array with the same numbers (if any) in another layout."""

    def swap(file: h5py.File) -> None:
        array = file[name][()]
        del file[name]
        file.create_dataset(name, **({} if "shape" in layout else {"data": array}), **layout)

    return edit(swap)


def foreign_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["trajectories"] = np.arange(3)


def flip_stored_bit(path: Path) -> None:
    """In the middle of the compressed positions."""
    with h5py.File(path) as file:
        chunk = file[f"{GROUP}/positions"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


# name: code of the first problem, its place, how to plant it
FILE_DEFECTS: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "empty file": ("E001", "/", lambda path: path.write_bytes(b"")),
    "text file": ("E001", "/", lambda path: path.write_text("frame,x,y,z\n" * 1000)),
    "truncated file": ("E001", "/", truncate),
    "foreign HDF5": ("E001", "/", foreign_hdf5),
    "other format": ("E001", "/", set_attribute("format", "another dataset")),
    "other schema version": ("E001", "/", set_attribute("schema_version", 99)),
    "missing attribute": ("E002", "/", delete_attribute("dt")),
    "unknown attribute": ("E002", "/", set_attribute("comment", "x")),
    "attribute of wrong type": ("E002", "/", set_attribute("frames", "many")),
    "no scale": ("E002", "/", set_attribute("scale_length", 0.0)),
    "time step not finite": ("E002", "/", set_attribute("dt", np.inf)),
    "unknown tier": ("E002", "/", set_attribute("tier", "huge")),
    "missing positions": ("E003", GROUP, delete(f"{GROUP}/positions")),
    "missing mesh": ("E003", GROUP, delete(f"{GROUP}/mesh")),
    "missing diagnostics": ("E003", GROUP, delete(f"{GROUP}/diagnostics")),
    "missing hash": ("E003", GROUP, edit(lambda file: file[GROUP].attrs.__delitem__("content_hash"))),
    "bit flip in compressed bytes": ("E003", GROUP, flip_stored_bit),
    "positions are text": ("E003", "/", replace_array(f"{GROUP}/positions", lambda array: b"text")),
    "splits are no groups": ("E003", "/splits", replace_array(f"{TASK}/test", len)),
    # One flipped bit can make HDF5 ask for terabytes, so only the writer's own layout is read.
    "more numbers than memory": (
        "E003",
        GROUP,
        store_otherwise(f"{GROUP}/positions", shape=(10**6, 10**6, 3), dtype="<f4"),
    ),
    "numbers of another file": (
        "E003",
        GROUP,
        store_otherwise(f"{GROUP}/positions", shape=(4, 5, 3), dtype="<f4", external=[(__file__, 0, 240)]),
    ),
    "other chunks": ("E003", GROUP, store_otherwise(f"{GROUP}/positions", chunks=(1, 5, 3))),
    "positions in float64": ("E004", GROUP, replace_array(f"{GROUP}/positions", np.float64)),
    "collider edges in int64": ("E004", GROUP, replace_array(f"{GROUP}/collider_edges", np.int64)),
    "wrong number of frames": ("E004", "/trajectories/test_00000", set_attribute("frames", 5)),
    "number changed": ("E009", GROUP, replace_array(f"{GROUP}/positions", lambda array: array + 1)),
    "material changed": ("E009", GROUP, set_attribute("density", 1.25, f"{GROUP}/material")),
    "tag changed": ("E009", GROUP, set_attribute("object", "edge", f"{GROUP}/tags")),
    "tags taken out": ("E009", GROUP, delete(f"{GROUP}/tags")),
    "hash of trajectory": ("E009", GROUP, set_attribute("content_hash", "0" * 64, GROUP)),
    "hash of file": ("E009", "/", set_attribute("content_hash", "0" * 64)),
    "trajectory taken out": ("E009", "/", delete(GROUP)),
    "no splits": ("E010", "/splits", delete("splits")),
    "trajectory in no split": ("E010", "/splits", replace_array(f"{TASK}/test", lambda keys: keys[1:])),
    "trajectory without proper name": (
        "E009",
        "/",
        edit(lambda file: file["trajectories"].move("test_00003", "last")),
    ),
    "split lists unknown key": (
        "E010",
        f"{TASK}/test",
        replace_array(f"{TASK}/test", lambda keys: np.array([*keys, b"test_00009"])),
    ),
    "split lists a key twice": (
        "E010",
        f"{TASK}/test",
        replace_array(f"{TASK}/test", lambda keys: np.array([*keys, keys[0]])),
    ),
    "trains on a test trajectory": (
        "E010",
        f"{TASK}/train",
        replace_array(f"{TASK}/train", lambda keys: np.array([*keys, b"test_00000"])),
    ),
    "unknown split": ("E010", f"{TASK}/holdout", edit(lambda file: file[TASK].move("test", "holdout"))),
    "unknown group": ("W002", "/notes", edit(lambda file: file.create_group("notes"))),
    "unknown array": ("W002", GROUP, edit(lambda file: file[GROUP].__setitem__("velocities", np.ones(3)))),
}


# --- defects of a trajectory: written with the right hashes, so that only the content is wrong ------------


@dataclass(frozen=True)
class Mutation:
    """Changes one trajectory on its way into a file."""

    change: Callable[[Trajectory], Trajectory]

    def __call__(self, key: str, trajectory: Trajectory) -> Trajectory:
        return self.change(trajectory) if key == KEY else trajectory


def with_value(name: str, index: tuple[int, ...], value: float) -> Change:
    """One number of an array replaced; names as in `Trajectory.arrays`."""

    def change(trajectory: Trajectory) -> Trajectory:
        array = trajectory.arrays()[name].copy()
        array[index] = value
        head, _, rest = name.partition("/")
        if head == "mesh":
            return replace(trajectory, mesh=replace(trajectory.mesh, **{rest: array}))
        return replace(trajectory, **{head: {rest: array} if rest else array})

    return Mutation(change)


def with_triangles(trajectory: Trajectory) -> Trajectory:
    """The second triangle's corners lie on a line."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [1, 1, 1]], np.float32)
    cells = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    mesh = replace(trajectory.mesh, rest_positions=rest, cells=cells, cell_type=VTK_TRIANGLE)
    return replace(trajectory, mesh=mesh)


def without_cells(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, mesh=replace(trajectory.mesh, cells=np.zeros((0, 4), np.int32)))


def inverted(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, mesh=replace(trajectory.mesh, cells=trajectory.mesh.cells[:, [1, 0, 2, 3]]))


CONTENT_DEFECTS: dict[str, tuple[str, Change]] = {
    "positions not a number": ("E005", with_value("positions", (2, 3, 0), np.nan)),
    "load infinite": ("E005", with_value("loads/push", (0, 0), np.inf)),
    "collider not a number": ("E005", with_value("collider_positions", (3, 0, 0), np.nan)),
    "material not finite": (
        "E005",
        Mutation(lambda t: replace(t, material={**t.material, "density": np.inf})),
    ),
    "other loads than named": ("E004", Mutation(lambda t: replace(t, loads={"pull": t.loads["push"]}))),
    "one number for a mesh": (
        "E004",
        Mutation(lambda t: replace(t, mesh=replace(t.mesh, rest_positions=np.array(1, np.float32)))),
    ),
    "node neither free nor fixed": ("E004", with_value("mesh/node_type", (2,), 7)),
    "node too large": ("E006", with_value("mesh/cells", (1, 3), 5)),
    "node negative": ("E006", with_value("mesh/cells", (0, 0), -1)),
    "collider's node too large": ("E006", with_value("collider_edges", (0, 1), 2)),
    "collider's node negative": ("E006", with_value("collider_edges", (0, 0), -1)),
    "edges of no collider": ("E006", Mutation(lambda t: replace(t, collider_positions=None))),
    "cell type unknown": ("E006", Mutation(lambda t: replace(t, mesh=replace(t.mesh, cell_type=12)))),
    "cell type of other corners": (
        "E006",
        Mutation(lambda t: replace(t, mesh=replace(t.mesh, cell_type=VTK_TRIANGLE))),
    ),
    "no cells": ("E006", Mutation(without_cells)),
    "tetrahedron inverted": ("E007", Mutation(inverted)),
    "tetrahedron flat": ("E007", with_value("mesh/rest_positions", (3, 2), 0)),
    "triangle without area": ("E007", Mutation(with_triangles)),
    "fixed node moves": ("E008", with_value("positions", (3, 0, 1), 1e-6)),
    "material unknown": ("E004", Mutation(lambda t: replace(t, material={"viscosity": 1.0}))),
    "node types for other nodes": (
        "E004",
        Mutation(lambda t: replace(t, mesh=replace(t.mesh, node_type=t.mesh.node_type[1:]))),
    ),
    "collider edges of three nodes": (
        "E004",
        Mutation(lambda t: replace(t, collider_edges=np.array([[0, 1, 0]], np.int32))),
    ),
    "collider in fewer frames": (
        "E004",
        Mutation(lambda t: replace(t, collider_positions=t.collider_positions[1:])),
    ),
}


@pytest.fixture
def copy(tmp_path: Path, tetra_file: Path) -> Path:
    """A valid file that a test may damage."""
    return Path(shutil.copy(tetra_file, tmp_path))


@pytest.mark.parametrize("strict", [False, True])
def test_valid_files_have_no_problems(tetra_file: Path, smoke_file: Path, strict: bool) -> None:
    for path in (tetra_file, smoke_file):
        report = validate(path, strict=strict)
        assert (report.ok, report.problems, report.trajectories) == (True, (), 16)


@pytest.mark.parametrize("name", FILE_DEFECTS)
def test_damaged_file(copy: Path, name: str) -> None:
    code, where, plant = FILE_DEFECTS[name]
    plant(copy)
    report = validate(copy)
    first = report.problems[0]
    assert (first.code, first.where) == (code, where), report.problems
    assert "\n" not in first.message
    assert report.ok == code.startswith("W")
    assert not validate(copy, strict=True).ok


@pytest.mark.parametrize("name", CONTENT_DEFECTS)
def test_wrong_content(tmp_path: Path, write_tetra: TetraWriter, name: str) -> None:
    code, change = CONTENT_DEFECTS[name]
    report = validate(write_tetra(tmp_path / "wrong.h5", change=change))
    assert {(problem.code, problem.where) for problem in report.problems} == {(code, GROUP)}
    assert not report.ok


def only_warning(path: Path) -> Problem:
    """What a strict check alone refuses a file for, if it is one thing."""
    (problem,) = validate(path).problems
    assert validate(path).ok
    assert not validate(path, strict=True).ok
    return problem


def test_incomplete_tier_is_a_warning(tmp_path: Path, write_tetra: TetraWriter) -> None:
    """Single splits are generated on purpose, so it takes a strict check to refuse them."""
    path = write_tetra(tmp_path / "test.h5", only={f"test_{i:05d}" for i in range(4)})
    problem = only_warning(path)
    assert problem.code == "W001"
    assert "12 trajectories" in problem.message


def test_a_trajectory_in_two_splits_is_a_warning(tmp_path: Path, write_tetra: TetraWriter) -> None:
    """Whoever is tested on what it was trained on should know; data of others may be so."""
    written: dict[str, Trajectory] = {}

    def repeat(key: str, trajectory: Trajectory) -> Trajectory:
        written[key] = trajectory
        return written["train_00002"] if key == "test_00001" else trajectory

    path = write_tetra(tmp_path / "repeated.h5", change=repeat)
    problem = only_warning(path)
    assert (problem.code, problem.where) == ("W003", "/trajectories/train_00002")
    assert problem.message == "train_00002 is the same as test_00001"


def test_a_body_that_stops_is_a_warning(tmp_path: Path, write_tetra: TetraWriter) -> None:
    """A solver that returned what it was given; but what lies on a floor in data of others may stand still."""

    def stop(key: str, trajectory: Trajectory) -> Trajectory:
        if key != "test_00001":
            return trajectory
        positions = trajectory.positions.copy()
        positions[2:] = positions[1]
        return replace(trajectory, positions=positions)

    path = write_tetra(tmp_path / "still.h5", change=stop)
    problem = only_warning(path)
    assert (problem.code, problem.where) == ("W004", "/trajectories/test_00001")
    assert problem.message == "no node moves from frame 1 to the next (2 such of 4)"


def test_every_code_is_planted() -> None:
    planted = {code for code, *_ in FILE_DEFECTS.values()} | {code for code, _ in CONTENT_DEFECTS.values()}
    assert planted | {"W001", "W003", "W004"} == set(CODES)


def test_progress_is_reported(tetra_file: Path) -> None:
    seen: list[tuple[int, int]] = []
    validate(tetra_file, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 16) for i in range(1, 17)]


# --- random damage ----------------------------------------------------------------------------------------


def everything(path: Path) -> tuple[Metadata, dict[str, dict[str, list[str]]], dict[str, str]]:
    """All that anybody reads from a file, arrays by their hash (which reading verifies)."""
    with open_file(path) as file:
        hashes = {key: read_trajectory(file, key).content_hash() for key in file["trajectories"]}
        return read_metadata(file), read_splits(file), hashes


@pytest.mark.parametrize("name", ["tetra_file", "smoke_file"])  # mostly HDF5's own bytes; mostly arrays
def test_no_damaged_byte_goes_unnoticed(tmp_path: Path, name: str, request: pytest.FixtureRequest) -> None:
    original = request.getfixturevalue(name)
    expected, content = everything(original), original.read_bytes()
    path = tmp_path / "damaged.h5"
    rng = np.random.default_rng(0)
    unnoticed = 0
    for position in rng.integers(len(content), size=40):
        damaged = bytearray(content)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        if validate(path).ok:  # must be a byte that HDF5 does not use
            unnoticed += 1
            assert everything(path) == expected, position
    assert unnoticed < 20


@pytest.mark.parametrize("text", ['"train": 100', "[0.0, 0.0, 0.5]", "µm", "tetra_task", "test_00003"])
def test_no_damaged_text_goes_unnoticed(tmp_path: Path, tetra_file: Path, text: str) -> None:
    """Content hashes do not cover metadata and splits, so HDF5's checksums must."""
    content, wanted = tetra_file.read_bytes(), text.encode()
    places = [i for i in range(len(content)) if content.startswith(wanted, i)]
    assert places
    for place in places:
        damaged = bytearray(content)
        damaged[place + len(wanted) - 1] ^= 1
        path = tmp_path / "damaged.h5"
        path.write_bytes(damaged)
        assert not validate(path).ok
