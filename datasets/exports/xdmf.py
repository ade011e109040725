"""XDMF files: XML that describes a trajectory as a temporal collection of grids and points into the dataset file.

See https://www.xdmf.org/index.php/XDMF_Model_and_Format.
"""

from pathlib import Path
from xml.etree import ElementTree

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.exports.parts import (
    VTK_LINE,
    VTK_VERTEX,
    Part,
    StoredArray,
    frame_times,
    read_located,
)
from m3gn_bench.datasets.trajectory import VTK_TETRA, VTK_TRIANGLE
from m3gn_bench.datasets.writer import write_bytes_atomically

TOPOLOGIES = {
    VTK_VERTEX: {"TopologyType": "Polyvertex", "NodesPerElement": "1"},
    VTK_LINE: {"TopologyType": "Polyline", "NodesPerElement": "2"},
    VTK_TRIANGLE: {"TopologyType": "Triangle"},
    VTK_TETRA: {"TopologyType": "Tetrahedron"},
}
NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UChar"}


def export_xdmf(file: Path, key: str, out: Path) -> list[Path]:
    """Write an XDMF file for a trajectory: a temporal collection "mesh", and one "collider" if there is one.

    It points to the dataset file by a relative path: move them together.

    Args:
        file: the dataset file.
        key: the trajectory's name in it.
        out: the file to write.

    Returns:
        The file written.

    Raises:
        DatasetError: the dataset file is unusable, its path holds a colon, or `out` cannot be written.
    """
    located = read_located(file, key)
    origin = located.path_from(out)
    if ":" in origin:
        raise DatasetError(f"XDMF cannot point to {origin}: a path with a colon; rename it, or use vtkhdf")
    root = ElementTree.Element("Xdmf", Version="3.0")
    domain = ElementTree.SubElement(root, "Domain")
    for part in located.parts:
        collection = ElementTree.SubElement(
            domain, "Grid", Name=part.name, GridType="Collection", CollectionType="Temporal"
        )
        for frame, time in enumerate(frame_times(located.metadata)):
            _add_grid(collection, part, origin, frame, float(time))
    ElementTree.indent(root)
    write_bytes_atomically(out, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
    return [out]


def _add_grid(collection: ElementTree.Element, part: Part, origin: str, frame: int, time: float) -> None:
    """One frame of a part."""
    _, nodes, dimension = part.positions.shape
    grid = ElementTree.SubElement(collection, "Grid", Name=part.name, GridType="Uniform")
    ElementTree.SubElement(grid, "Time", Value=repr(time))
    cells = nodes if part.cells is None else part.cells.shape[0]
    topology = ElementTree.SubElement(
        grid, "Topology", TOPOLOGIES[part.cell_type], NumberOfElements=str(cells)
    )
    if part.cells is not None:
        _add_array(topology, part.cells, origin)
    geometry = ElementTree.SubElement(grid, "Geometry", GeometryType="XY" if dimension == 2 else "XYZ")
    slab = ElementTree.SubElement(
        geometry, "DataItem", ItemType="HyperSlab", Dimensions=f"{nodes} {dimension}"
    )
    # VTK's reader takes what stands first in here for the name of the data, and keeps the points until it changes.
    slab.append(ElementTree.Comment(f" frame {frame} "))
    selection = ElementTree.SubElement(slab, "DataItem", Format="XML", NumberType="Int", Dimensions="3 3")
    selection.text = f"{frame} 0 0  1 1 1  1 {nodes} {dimension}"  # start, stride, count
    _add_array(slab, part.positions, origin)
    for name, array in part.node_arrays.items():
        if len(array.shape) == 1:
            attribute = ElementTree.SubElement(
                grid, "Attribute", Name=name, AttributeType="Scalar", Center="Node"
            )
            _add_array(attribute, array, origin)


def _add_array(parent: ElementTree.Element, array: StoredArray, origin: str) -> None:
    """A whole array of the dataset file."""
    item = ElementTree.SubElement(
        parent,
        "DataItem",
        Format="HDF",
        NumberType=NUMBER_TYPES[array.dtype.kind],
        Precision=str(array.dtype.itemsize),
        Dimensions=" ".join(map(str, array.shape)),
    )
    item.text = f"{origin}:{array.path}"
