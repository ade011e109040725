"""VTKHDF files that ParaView and VTK step through in time, made of pointers into the dataset file.

The layout is that of a temporal UnstructuredGrid in VTK's specification
(https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html): one part,
whose cells are the same in all steps (offset 0) and whose points are not (offset frame * nodes). Points and
cells are HDF5 virtual datasets, so a file takes about twenty kilobytes.
"""

import io
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import DTypeLike

from m3gn_bench.datasets.exports.parts import Located, Part, StoredArray, frame_times, read_located
from m3gn_bench.datasets.schema import fixed_length
from m3gn_bench.datasets.writer import COMPRESSION, LIBVER, write_bytes_atomically

VERSION = (2, 0)  # of the format; the first with time
ZEROS = "third_coordinate"  # outside of the group that VTK reads


def export_vtkhdf(file: Path, key: str, out: Path) -> list[Path]:
    """Write a VTKHDF file for the mesh of a trajectory, and one beside it for the collider if there is one.

    They point to the dataset file by a relative path: move them together. Where the dataset file is missing,
    HDF5 reads fill values: all points are NaN. Velocities would be a copy and are left out; displacements
    are the points less the point data "rest_positions".

    Args:
        file: the dataset file.
        key: the trajectory's name in it.
        out: the file of the mesh; the collider's has "-collider" before the ending.

    Returns:
        The files written.

    Raises:
        DatasetError: the dataset file is unusable, or `out` cannot be written.
    """
    located = read_located(file, key)
    written = []
    for part in located.parts:
        path = out if part.name == "mesh" else out.with_stem(f"{out.stem}-{part.name}")
        write_bytes_atomically(path, _content(located, part, located.path_from(path)))
        written.append(path)
    return written


def _content(located: Located, part: Part, path: str) -> bytes:
    """The bytes of the file for a part, given the path from it to the dataset file."""
    metadata, trajectory = located.metadata, located.trajectory
    frames, nodes, dimension = part.positions.shape
    cells, corners = (nodes, 1) if part.cells is None else part.cells.shape
    origin = path.replace("%", "%%")  # HDF5 takes a single one for the start of a pattern
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver=(LIBVER, LIBVER)) as file:
        provenance = {
            "scene": metadata.scene,
            "trajectory": located.key,
            "content_hash": trajectory.content_hash(),
            "length_unit": metadata.length_unit,
            "time_unit": metadata.time_unit,
            "licence": metadata.licence,
        }
        file.attrs.update({name: fixed_length(value) for name, value in provenance.items()})
        if dimension == 2:
            file.create_dataset(ZEROS, (frames * nodes, 1), "f4", fillvalue=0)  # takes no space
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(VERSION)
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")
        for name, value in (("Points", nodes), ("Cells", cells), ("ConnectivityIds", cells * corners)):
            root[f"NumberOf{name}"] = np.array([value])
        _virtual_points(root, "Points", origin, part.positions)
        root.create_dataset("Types", (cells,), "u1", fillvalue=part.cell_type)  # takes no space
        root.create_dataset("Offsets", data=corners * np.arange(cells + 1), **COMPRESSION)
        if part.cells is None:
            root["Connectivity"] = np.arange(nodes)
        else:  # as 64 bits, like the offsets: VTK wants both of one kind
            _virtual(root, "Connectivity", origin, part.cells, "i8")

        still = np.zeros(frames, np.int64)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"] = frame_times(located.metadata)
        steps["NumberOfParts"] = still + 1
        steps["PartOffsets"] = still
        steps["PointOffsets"] = nodes * np.arange(frames)
        steps["CellOffsets"] = steps["ConnectivityIdOffsets"] = still[:, None]
        for name, array in part.node_arrays.items():
            place = f"PointData/{name}"
            if len(array.shape) == 2:
                _virtual_points(root, place, origin, array)
            else:
                _virtual(root, place, origin, array, array.dtype)
            steps[f"PointDataOffsets/{name}"] = still
        for name, number in trajectory.material.items():
            root[f"FieldData/{name}"] = np.array([number])
            steps[f"FieldDataOffsets/{name}"] = still
    return buffer.getvalue()


def _virtual_points(group: h5py.Group, name: str, origin: str, array: StoredArray) -> None:
    """Vectors [..., dim] of the dataset file as the rows of an array [n, 3], without a copy."""
    dimension = array.shape[-1]
    rows = int(np.prod(array.shape[:-1]))
    layout = h5py.VirtualLayout((rows, 3), array.dtype)
    layout[:, :dimension] = h5py.VirtualSource(origin, array.path, array.shape, array.dtype)
    if dimension == 2:  # not the fill value: that shows what is missing
        zeros = group.file[ZEROS]
        layout[:, 2:] = h5py.VirtualSource(".", zeros.name, zeros.shape, zeros.dtype)[:rows]
    group.create_virtual_dataset(name, layout, fillvalue=np.nan)


def _virtual(group: h5py.Group, name: str, origin: str, array: StoredArray, dtype: DTypeLike) -> None:
    """An array of the dataset file as a flat one of another type, without a copy."""
    layout = h5py.VirtualLayout((int(np.prod(array.shape)),), dtype)
    layout[:] = h5py.VirtualSource(origin, array.path, array.shape, array.dtype)
    group.create_virtual_dataset(name, layout, fillvalue=0)
