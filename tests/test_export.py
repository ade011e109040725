"""Trajectories in the formats of other tools, read back with those tools."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from conftest import TetraWriter

from m3gn_bench.cli import run
from m3gn_bench.datasets.exports.npz import named_arrays
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TRIANGLE, Mesh, Trajectory

KEY = "test_00001"
CHOICE = ["--split", "test", "--index", "1"]
KINDS = ["sheet", "tetra", "flat"]
ROOT = Path(__file__).parent.parent


def flat(key: str, trajectory: Trajectory) -> Trajectory:
    """The same with two triangles in a plane, and a collider that has no edges."""
    mesh = Mesh(
        rest_positions=trajectory.mesh.rest_positions[:4, :2].copy(),
        cells=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        cell_type=VTK_TRIANGLE,
        node_type=np.array([FIXED, FREE, FREE, FREE], np.uint8),
    )
    assert trajectory.collider_positions is not None
    return replace(
        trajectory,
        positions=trajectory.positions[:, :4, :2].copy(),
        mesh=mesh,
        collider_positions=trajectory.collider_positions[..., :2].copy(),
        collider_edges=None,
    )


@pytest.fixture(scope="module")
def files(
    smoke_file: Path,
    tetra_file: Path,
    write_tetra: TetraWriter,
    tetra_metadata: Metadata,
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, Path]:
    """Dataset files: a surface in space, tetrahedra with a collider, a plane with a collider of points."""
    plane = tetra_metadata.model_copy(update={"scale_centre": (0.0, 0.5)})
    path = tmp_path_factory.mktemp("flat") / "flat.h5"
    write_tetra(path, change=flat, metadata=plane, only={"test_00000", KEY})
    return {"sheet": smoke_file, "tetra": tetra_file, "flat": path}


def load(file: Path, key: str = KEY) -> tuple[Trajectory, Metadata]:
    with open_file(file) as opened:
        return read_trajectory(opened, key), read_metadata(opened)


def export(*arguments: object) -> int:
    """Run the command and return its exit code."""
    with pytest.raises(SystemExit) as stop:
        run(["export", *(str(argument) for argument in arguments)])
    return int(stop.value.code or 0)


def in_space(vectors: np.ndarray) -> np.ndarray:
    """With a third coordinate."""
    return np.pad(vectors, [(0, 0)] * (vectors.ndim - 1) + [(0, 3 - vectors.shape[-1])])


def cell_nodes(grid: Any) -> np.ndarray:
    """The nodes of each cell of a grid whose cells are all of one type, shape [cells, corners]."""
    return np.asarray(grid.cells).reshape(grid.n_cells, -1)[:, 1:]


# --- vtkhdf -----------------------------------------------------------------------------------------------


def steps_of(path: Path) -> Iterator[tuple[float, Any]]:
    """Time and grid of every step, as VTK reads them, forwards and then the first one again."""
    pyvista = pytest.importorskip("pyvista")
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    for time in (*times, times[0]):
        reader.UpdateTimeStep(time)
        yield time, pyvista.wrap(reader.GetOutputDataObject(0))


@pytest.mark.parametrize("kind", KINDS)
def test_vtk_steps_through_a_trajectory(files: dict[str, Path], kind: str, tmp_path: Path) -> None:
    trajectory, metadata = load(files[kind])
    out = tmp_path / "x.vtkhdf"
    assert export(files[kind], "--format", "vtkhdf", *CHOICE, "-o", out) == 0
    steps = list(steps_of(out))
    assert len(steps) == metadata.frames + 1
    for frame, (time, grid) in zip([*range(metadata.frames), 0], steps, strict=True):
        assert time == pytest.approx(frame * metadata.dt)
        np.testing.assert_array_equal(grid.points, in_space(trajectory.positions[frame]))
        np.testing.assert_array_equal(cell_nodes(grid), trajectory.mesh.cells)
        assert set(grid.celltypes) == {trajectory.mesh.cell_type}
        np.testing.assert_array_equal(grid["node_type"], trajectory.mesh.node_type)
        np.testing.assert_array_equal(grid["rest_positions"], in_space(trajectory.mesh.rest_positions))
        for name, value in trajectory.material.items():
            assert grid.field_data[name] == [value]
    collider = tmp_path / "x-collider.vtkhdf"
    assert collider.exists() == (trajectory.collider_positions is not None)
    if trajectory.collider_positions is not None:
        for frame, (time, grid) in zip([*range(metadata.frames), 0], steps_of(collider), strict=True):
            assert time == pytest.approx(frame * metadata.dt)
            np.testing.assert_array_equal(grid.points, in_space(trajectory.collider_positions[frame]))
            edges = trajectory.collider_edges
            np.testing.assert_array_equal(cell_nodes(grid), [[0], [1]] if edges is None else edges)


@pytest.mark.parametrize("kind", KINDS)
def test_vtkhdf_holds_no_copy(files: dict[str, Path], kind: str, tmp_path: Path) -> None:
    out = tmp_path / "x.vtkhdf"
    assert export(files[kind], "--format", "vtkhdf", "-o", out) == 0
    trajectory, metadata = load(files[kind], "test_00000")
    stored: list[str] = []

    def note(name: str, found: h5py.Group | h5py.Dataset) -> None:
        if isinstance(found, h5py.Dataset) and not found.is_virtual and found.id.get_storage_size():
            stored.append(name)

    with h5py.File(out) as file:
        file.visititems(note)
        for name in ("Points", "Connectivity", "PointData/rest_positions", "PointData/node_type"):
            assert file["VTKHDF"][name].is_virtual
        assert file.attrs["content_hash"].decode() == trajectory.content_hash()
        assert file.attrs["length_unit"].decode() == metadata.length_unit
    small = ("VTKHDF/Steps/", "VTKHDF/FieldData/", "VTKHDF/NumberOf", "VTKHDF/Offsets")
    assert [name for name in stored if not name.startswith(small)] == []
    assert out.stat().st_size < 20_000


def test_moved_together_they_stay_together(
    smoke_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, views = tmp_path / "here" / "data", tmp_path / "here" / "views"
    data.mkdir(parents=True)
    source = Path(shutil.copy(smoke_file, data / "sheet 100%b: ü.h5"))  # HDF5 knows patterns such as %b
    monkeypatch.chdir(data)
    assert export(source.name, "--format", "vtkhdf", "-o", Path("..") / "views" / "x.vtkhdf") == 0
    (tmp_path / "here").rename(tmp_path / "there")
    out = tmp_path / "there" / "views" / "x.vtkhdf"
    monkeypatch.chdir(tmp_path)
    with h5py.File(out) as file:
        points = file["VTKHDF/Points"][()]
    positions = load(smoke_file, "test_00000")[0].positions
    np.testing.assert_array_equal(points.reshape(positions.shape), positions)
    assert not views.exists()


def test_a_missing_dataset_file_does_not_look_like_data(files: dict[str, Path], tmp_path: Path) -> None:
    source = Path(shutil.copy(files["flat"], tmp_path))
    out = tmp_path / "x.vtkhdf"
    assert export(source, "--format", "vtkhdf", "-o", out) == 0
    source.unlink()
    with h5py.File(out) as file:
        assert np.isnan(file["VTKHDF/Points"][:, :2]).all()


# --- xdmf -------------------------------------------------------------------------------------------------


def read_item(item: ElementTree.Element, folder: Path) -> np.ndarray:
    """The array that a DataItem stands for."""
    shape = tuple(map(int, item.attrib["Dimensions"].split()))
    if item.get("ItemType") == "HyperSlab":
        selection, whole = item.findall("DataItem")
        assert selection.text
        start, stride, count = np.array(selection.text.split(), int).reshape(3, -1)
        array = read_item(whole, folder)
        slices = tuple(map(slice, start, start + stride * count, stride))
        return array[slices].reshape(shape)
    assert item.text
    name, path = item.text.split(":")
    with h5py.File(folder / name) as file:
        array = file[path][()]
    assert array.shape == shape
    assert array.dtype.itemsize == int(item.attrib["Precision"])
    return array


@pytest.mark.parametrize("kind", KINDS)
def test_xdmf_refers_to_the_arrays(files: dict[str, Path], kind: str, tmp_path: Path) -> None:
    trajectory, metadata = load(files[kind])
    out = tmp_path / "folder" / "x.xdmf"
    assert export(files[kind], "--format", "xdmf", *CHOICE, "-o", out) == 0
    paths = {"mesh": trajectory.positions, "collider": trajectory.collider_positions}
    collections = {grid.get("Name"): grid for grid in ElementTree.parse(out).iterfind("Domain/Grid")}
    assert set(collections) == {name for name, path in paths.items() if path is not None}
    for name, collection in collections.items():
        assert (collection.get("GridType"), collection.get("CollectionType")) == ("Collection", "Temporal")
        grids = collection.findall("Grid")
        assert len(grids) == metadata.frames
        path = paths[name or ""]
        assert path is not None
        for frame, grid in enumerate(grids):
            time, topology, geometry = (grid.find(tag) for tag in ("Time", "Topology", "Geometry/DataItem"))
            assert time is not None
            assert topology is not None
            assert geometry is not None
            assert float(time.attrib["Value"]) == pytest.approx(frame * metadata.dt)
            np.testing.assert_array_equal(read_item(geometry, out.parent), path[frame])
            cells = trajectory.mesh.cells if name == "mesh" else trajectory.collider_edges
            item = topology.find("DataItem")
            assert (item is None) == (cells is None)
            if item is not None and cells is not None:
                np.testing.assert_array_equal(read_item(item, out.parent), cells)
            shown = path.shape[1] if cells is None else len(cells)
            assert topology.attrib["NumberOfElements"] == str(shown)


@pytest.mark.parametrize("kind", KINDS)
def test_vtk_reads_xdmf(
    files: dict[str, Path], kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pyvista = pytest.importorskip("pyvista")
    trajectory, metadata = load(files[kind])
    out = tmp_path / "x.xdmf"
    assert export(files[kind], "--format", "xdmf", *CHOICE, "-o", out) == 0
    reader = pyvista.get_reader(str(out))
    assert reader.number_time_points == metadata.frames
    for frame in (0, 1, metadata.frames - 1, 2):
        reader.set_active_time_point(frame)
        read = reader.read()
        grids = list(read) if isinstance(read, pyvista.MultiBlock) else [read]
        np.testing.assert_array_equal(grids[0].points, in_space(trajectory.positions[frame]))
        np.testing.assert_array_equal(cell_nodes(grids[0]), trajectory.mesh.cells)
        assert set(grids[0].celltypes) == {trajectory.mesh.cell_type}
        if trajectory.collider_positions is not None:
            np.testing.assert_array_equal(grids[1].points, in_space(trajectory.collider_positions[frame]))
    assert capfd.readouterr().err == ""


# --- npz --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_npz(files: dict[str, Path], kind: str, tmp_path: Path) -> None:
    trajectory, metadata = load(files[kind])
    out = tmp_path / "x.npz"
    assert export(files[kind], "--format", "npz", *CHOICE, "-o", out) == 0
    with np.load(out) as arrays:
        assert set(arrays) == set(named_arrays(KEY, trajectory, metadata))
        np.testing.assert_array_equal(arrays["positions"], trajectory.positions)
        np.testing.assert_array_equal(arrays["cells"], trajectory.mesh.cells)
        np.testing.assert_allclose(arrays["time"], metadata.dt * np.arange(metadata.frames))
        assert {
            n.removeprefix("material_"): float(arrays[n]) for n in arrays if n.startswith("material_")
        } == (trajectory.material)
        for name, values in trajectory.loads.items():
            np.testing.assert_array_equal(arrays[f"load_{name}"], values)
        for name, word in trajectory.tags.items():
            assert arrays[f"tag_{name}"] == word
        assert json.loads(str(arrays["metadata"]))["length_unit"] == metadata.length_unit
        assert arrays["key"] == KEY


# --- pyg --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_graph(files: dict[str, Path], kind: str, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    geometric = pytest.importorskip("torch_geometric.data")
    trajectory, metadata = load(files[kind])
    out = tmp_path / "x.pt"
    assert export(files[kind], "--format", "pyg", *CHOICE, "-o", out) == 0
    graph = geometric.Data.from_dict(torch.load(out, weights_only=True))
    graph.validate()
    nodes = len(trajectory.mesh.rest_positions)
    collider = trajectory.collider_positions
    path = np.empty((metadata.frames, 0, metadata.dimension)) if collider is None else collider
    together = np.concatenate([trajectory.positions, path], axis=1)
    np.testing.assert_array_equal(graph.positions, together.swapaxes(0, 1))
    np.testing.assert_array_equal(graph.pos[:nodes], trajectory.mesh.rest_positions)
    np.testing.assert_array_equal(graph.node_type, [*trajectory.mesh.node_type, *[2] * path.shape[1]])
    assert dict(zip(graph.material_names, graph.material[0].tolist(), strict=True)) == pytest.approx(
        trajectory.material
    )
    assert graph.is_undirected()
    assert not graph.has_self_loops()
    of_mesh = {tuple(sorted(edge)) for edge in graph.edge_index.T[graph.edge_type == 0].tolist()}
    corners = trajectory.mesh.cells.shape[1]
    expected = {
        tuple(sorted((int(cell[i]), int(cell[j]))))
        for cell in trajectory.mesh.cells
        for i in range(corners)
        for j in range(i)
    }
    assert of_mesh == expected
    edges = trajectory.collider_edges
    of_collider = graph.edge_index.T[graph.edge_type == 1] - nodes
    assert {tuple(sorted(edge)) for edge in of_collider.tolist()} == (
        set() if edges is None else set(map(tuple, edges.tolist()))
    )

    batch = geometric.Batch.from_data_list([graph, graph])
    assert batch.positions.shape == (2 * len(graph.pos), metadata.frames, metadata.dimension)
    assert batch.material.shape == (2, len(trajectory.material))
    cells = batch.face if corners == 3 else batch.tetra_index
    np.testing.assert_array_equal(
        cells.T, np.concatenate([trajectory.mesh.cells, trajectory.mesh.cells + len(graph.pos)])
    )
    if kind == "tetra":  # a load by node, and one that is not
        assert graph.load_push.shape == (7, 3)
        assert (graph.load_push[5:] == 0).all()
    if kind == "sheet":
        assert graph.load_centres.shape == (1, 2, 2)


def test_graphs_without_the_library(
    tetra_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch_geometric.data", None)
    assert export(tetra_file, "--format", "pyg", "-o", tmp_path / "x.pt") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: graphs need torch_geometric")
    assert "pip install 'm3gn-bench[pyg]'" in line
    assert list(tmp_path.iterdir()) == []


# --- huggingface ------------------------------------------------------------------------------------------
# In processes of their own whose folder is not the checkout: there, `import datasets` finds our room.


def installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


needs_hub = pytest.mark.skipif(not installed("datasets"), reason="the library 'datasets' is missing")
EXPORT = "from m3gn_bench.cli import run; run()"
COMPARE = """
import sys
import datasets
import numpy as np
from huggingface_hub import DatasetCard
from m3gn_bench.datasets.reader import TrajectoryDataset

folder, file = sys.argv[1:]
loaded = datasets.load_dataset(folder)
assert {split: len(rows) for split, rows in loaded.items()} == {"train": 8, "validation": 4, "test": 4}
for split, rows in loaded.with_format("numpy").items():
    own = TrajectoryDataset(file, "tetra_task", split)
    for key, trajectory, row in zip(own.keys, own, rows, strict=True):
        assert (row["key"], list(row["tasks"]), row["tag_object"]) == (key, ["tetra_task"], "wedge")
        mesh = trajectory.mesh
        for name, array in {
            "positions": trajectory.positions.swapaxes(0, 1),
            "collider_positions": trajectory.collider_positions.swapaxes(0, 1),
            "collider_edges": trajectory.collider_edges,
            "rest_positions": mesh.rest_positions,
            "cells": mesh.cells,
            "node_type": mesh.node_type,
            "load_push": trajectory.loads["push"],
            **{f"material_{name}": value for name, value in trajectory.material.items()},
        }.items():
            np.testing.assert_array_equal(row[name], array)
assert len({len(row["positions"]) for row in loaded["test"]}) == 2  # meshes of two sizes
card = DatasetCard.load(folder + "/README.md")
assert card.data.license == "cc-by-4.0"
assert [split["name"] for split in card.data.dataset_info["splits"]] == ["train", "validation", "test"]
assert {feature["name"] for feature in card.data.dataset_info["features"]} == set(loaded["test"].column_names)
assert "µm" in card.text
"""


def python(program: str, folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder, where Hugging Face's library may keep its files, too."""
    environment = {**os.environ, "HF_HOME": str(folder / ".home"), "HF_HUB_OFFLINE": "1"}
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def bigger(key: str, trajectory: Trajectory) -> Trajectory:
    """One of the trajectories with a node more."""
    if key != KEY:
        return trajectory
    mesh = trajectory.mesh
    more = replace(
        mesh,
        rest_positions=np.concatenate([mesh.rest_positions, [[2, 2, 2]]]).astype(np.float32),
        node_type=np.append(mesh.node_type, FREE).astype(np.uint8),
        cells=np.concatenate([mesh.cells, [[2, 3, 4, 5]]]).astype(np.int32),
    )
    added = np.full((len(trajectory.positions), 1, 3), 2, np.float32)
    return replace(trajectory, mesh=more, positions=np.concatenate([trajectory.positions, added], axis=1))


@needs_hub
def test_load_dataset(write_tetra: TetraWriter, tmp_path: Path) -> None:
    file = write_tetra(tmp_path / "tetra-smoke.h5", change=bigger)
    made = python(EXPORT, tmp_path, "export", file, "--format", "huggingface", "--json")
    assert (made.returncode, made.stderr) == (0, "")
    folder = tmp_path / "tetra-smoke-huggingface"
    assert json.loads(made.stdout) == {"format": "huggingface", "files": [str(folder)], "trajectories": 16}
    assert {str(path.relative_to(folder)) for path in folder.rglob("*.*")} == {
        "README.md",
        *(f"data/{split}.parquet" for split in ("train", "validation", "test")),
    }
    compared = python(COMPARE, tmp_path, folder, file)
    assert compared.returncode == 0, compared.stderr
    before = (folder / "README.md").stat().st_mtime_ns
    again = python(EXPORT, tmp_path, "export", file, "--format", "huggingface")
    assert again.returncode == 2
    assert again.stderr == f"error: {folder} is there already; use another folder\n"
    assert (folder / "README.md").stat().st_mtime_ns == before


@needs_hub
def test_trajectories_of_different_arrays_are_refused(write_tetra: TetraWriter, tmp_path: Path) -> None:
    def change(key: str, trajectory: Trajectory) -> Trajectory:
        return replace(trajectory, tags={}) if key == "validation_00002" else trajectory

    file = write_tetra(tmp_path / "tetra-smoke.h5", change=change)
    made = python(EXPORT, tmp_path, "export", file, "--format", "huggingface", "-o", tmp_path / "out")
    assert made.returncode == 2
    assert "validation_00002 do not have the same arrays" in made.stderr
    assert not [path for path in tmp_path.iterdir() if "out" in path.name]


@needs_hub
def test_damaged_rows_are_not_handed_on(tetra_file: Path, tmp_path: Path) -> None:
    file = Path(shutil.copy(tetra_file, tmp_path))
    with h5py.File(file, "r+") as opened:
        opened["trajectories/test_00000/positions"][2, 1] += 1
    made = python(EXPORT, tmp_path, "export", file, "--format", "huggingface")
    assert made.returncode == 2
    assert "test_00000 does not match its content hash" in made.stderr
    assert [path for path in tmp_path.iterdir() if path.name != ".home"] == [file]


@needs_hub
def test_the_current_folder_stays(tetra_file: Path, tmp_path: Path) -> None:
    made = python(EXPORT, tmp_path, "export", tetra_file, "--format", "huggingface", "-o", ".")
    assert (made.returncode, made.stderr) == (2, "error: . is there already; use another folder\n")


@needs_hub
def test_the_licence_of_others_is_no_name_of_the_hub_s(
    write_tetra: TetraWriter, tetra_metadata: Metadata, tmp_path: Path
) -> None:
    changes = {"variant": {"imported": "ggns"}, "licence": "that of the source"}
    metadata = tetra_metadata.model_copy(update=changes)
    file = write_tetra(tmp_path / "tetra.h5", metadata=metadata, only={KEY})
    assert python(EXPORT, tmp_path, "export", file, "--format", "huggingface", "-o", "out").returncode == 0
    card = (tmp_path / "out" / "README.md").read_text()
    assert "\nlicense: other\n" in card
    assert "| licence | that of the source |" in card


@needs_hub
def test_our_folder_may_not_stand_for_the_library(tetra_file: Path, tmp_path: Path) -> None:
    program = f"import os; os.chdir({str(ROOT)!r}); {EXPORT}"
    made = python(program, tmp_path, "export", tetra_file, "--format", "huggingface", "-o", tmp_path / "out")
    assert made.returncode == 2
    assert made.stderr.startswith(f"error: the folder {ROOT / 'datasets'} hides Hugging Face's library")
    assert not (tmp_path / "out").exists()


def test_dataset_without_the_library(
    tetra_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "datasets", None)
    assert export(tetra_file, "--format", "huggingface", "-o", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'm3gn-bench[hub]'" in line
    assert list(tmp_path.iterdir()) == []


# --- the command ------------------------------------------------------------------------------------------


def test_files_stand_beside_the_dataset(
    tetra_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = Path(shutil.copy(tetra_file, tmp_path / "tetra.h5"))
    assert export(source, "--format", "vtkhdf", "--split", "train", "--json") == 0
    names = [str(tmp_path / f"tetra-train_00000{end}") for end in (".vtkhdf", "-collider.vtkhdf")]
    assert json.loads(capsys.readouterr().out) == {
        "format": "vtkhdf",
        "files": names,
        "trajectory": "train_00000",
    }
    assert {str(path) for path in tmp_path.iterdir()} == {str(source), *names}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "csv"], "unknown format 'csv'; known: huggingface, npz, pyg, vtkhdf, xdmf"),
        (["--format", "npz", "--split", "dev"], "unknown split 'dev'; known: test, train, validation"),
        (["--format", "npz", "--index", "4"], "index 4 is out of range"),
        (["--format", "npz", "-o", "{file}"], "must end in .npz"),
        (["--format", "xdmf", "-o", "x.xmf"], "x.xmf must end in .xdmf"),
        (["--format", "xdmf", "-o", "{colon}"], "a path with a colon; rename it, or use vtkhdf"),
        (["--format", "huggingface", "--index", "0"], "leave out --split and --index"),
        (["--format", "npz", "-o", "{file}/x.npz"], "x.npz"),
        (["--format", "pyg", "-o", "/proc/x.pt"], "cannot write /proc/x.pt"),
        (["--format", "pyg", "-o", "/etc/passwd/x.pt"], "cannot write /etc/passwd/x.pt: "),
    ],
)
def test_refusals(
    tetra_file: Path,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = Path(shutil.copy(tetra_file, tmp_path / "a:b.h5" if "{colon}" in arguments else tmp_path))
    before = file.read_bytes()
    monkeypatch.chdir(tmp_path)
    filled = [part.format(file=file, colon="x.xdmf") for part in arguments]
    assert export(file, *filled) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert list(tmp_path.iterdir()) == [file]
    assert file.read_bytes() == before


@pytest.mark.parametrize("name", ["vtkhdf", "xdmf", "npz", "pyg"])
def test_damaged_data_are_not_handed_on(
    name: str, tetra_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = Path(shutil.copy(tetra_file, tmp_path))
    with h5py.File(file, "r+") as opened:
        opened["trajectories/test_00000/positions"][2, 1] += 1
    assert export(file, "--format", name) == 2
    assert "test_00000 does not match its content hash" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [file]


def test_interrupted_it_leaves_the_old_file(
    tetra_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(stream: Any, **arrays: np.ndarray) -> None:
        stream.write(b"half")
        raise KeyboardInterrupt

    out = tmp_path / "x.npz"
    out.write_text("old")
    monkeypatch.setattr(np, "savez_compressed", stop)
    assert export(tetra_file, "--format", "npz", "-o", out) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["x.npz"]
    assert out.read_text() == "old"
