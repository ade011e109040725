"""The soft bodies that fall: six of our own, kept as data, and whatever mesh a user brings.

Tetrahedral meshing is not deterministic, so no dataset may depend on doing it again: our own meshes are data
with their hashes (folder `meshes`), and a user's surface is meshed once, in the process that reads it. The
scene holds the body, and worker processes get it with the scene, node for node.
"""

import hashlib
import importlib
import io
import json
import os
import secrets
import zipfile
import zlib
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from m3gn_bench.datasets.trajectory import hash_arrays
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.generators.errors import GeneratorError
from m3gn_bench.generators.meshes.geometry import (
    Floats,
    Indices,
    boundary_triangles,
    cell_volumes,
    component_count,
    enclosed_volume,
    is_closed,
    is_consistently_wound,
    normalised,
    reference_step,
    surface_nodes_first,
)

MESHES = Path(__file__).parent / "meshes"
HASHES = "hashes.json"  # beside the meshes
MAX_SURFACE_NODES = 350  # that a scene records
SURFACE_FORMATS = {
    ".stl",
    ".obj",
    ".ply",
    ".off",
    ".glb",
}  # by trimesh; .npz is our own, meshio reads the rest

# A user's surface: what to aim at, the better of which is kept.
SURFACE_NODES, EDGE_FACTOR, ENVELOPE = (304, 320), 1.15, 0.005

SMALLEST_CELL = 1e-12  # volume over the cube of the largest extent, below which a cell is flat
SMALLEST_EXTENT = 1e-3  # over the largest
SAME_PLACE = 1e-7  # over the largest extent
SMALLEST_VOLUME = 1e-9  # over the cube of the largest extent, below which a surface encloses nothing
SMALLEST_STEP = 2e-5  # [s], of `reference_step`; it asks for 25 times the work of our own objects
OWN_STEP, OWN_SUBSTEPS = 5e-4, 20  # the smallest of our own objects, and what it makes of a frame of 0.01 s


@dataclass(frozen=True, eq=False)
class SoftBody:
    """A body at rest as tetrahedra, its centre of mass at the origin, its largest extent 1, z upright.

    Attributes:
        name: of the object, or of the file that it came from.
        vertices: node positions, in units of the body's size, shape [nodes, 3], float64.
        tetrahedra: node indices of each cell, positive volumes, shape [cells, 4], int32.
        surface_nodes: the nodes 0..surface_nodes-1 lie on the surface; those are recorded. No other node does,
            unless the body is refined.
    """

    name: str
    vertices: Floats
    tetrahedra: Indices
    surface_nodes: int

    @cached_property
    def surface(self) -> Indices:
        """Surface triangles, counterclockwise seen from outside, shape [triangles, 3], int32."""
        return boundary_triangles(self.tetrahedra)

    def arrays(self) -> dict[str, np.ndarray]:
        """The body as named arrays, as stored and as hashed."""
        return {
            "vertices": np.asarray(self.vertices, "<f8"),
            "tetrahedra": np.asarray(self.tetrahedra, "<i4"),
            "surface_nodes": np.asarray(self.surface_nodes, "<i4"),
        }

    def content_hash(self) -> str:
        """SHA-256 over names, shapes, types and bytes of the arrays; the name does not count."""
        return hash_arrays(self.arrays()).hexdigest()

    def divided(self, parts: int) -> "SoftBody":
        """Every edge cut into `parts`, and so every cell into parts^3 of equal volume (edgewise subdivision:
        Edelsbrunner and Grayson, 2000). Old nodes keep their indices and `surface_nodes` its value, so that the same
        nodes can be recorded; new ones follow. One part: the body itself."""
        if parts == 1:
            return self
        corners = np.sort(self.tetrahedra, axis=1)  # in this order neighbours cut a common face alike
        points, cells = _division(parts)
        # A new node is known by the corners that it lies between and its weight at each of them.
        between = np.where(points > 0, corners[:, None], -1)
        order = np.argsort(between, axis=2)
        weights = np.broadcast_to(points, between.shape)
        names = np.concatenate([np.take_along_axis(x, order, 2) for x in (between, weights)], axis=2).reshape(
            -1, 8
        )
        is_old = names[:, 4:].max(1) == parts
        places = np.where(is_old, names[:, :4].max(1), 0)
        new, places_of_new = np.unique(names[~is_old], axis=0, return_inverse=True)
        places[~is_old] = len(self.vertices) + places_of_new.ravel()
        vertices = np.concatenate(
            [self.vertices, np.einsum("nk,nkd->nd", new[:, 4:] / parts, self.vertices[new[:, :4]])]
        )
        tetrahedra = places.reshape(-1, len(points))[:, cells].reshape(-1, 4).astype(np.int32)
        inverted = cell_volumes(vertices, tetrahedra) < 0
        tetrahedra[inverted] = tetrahedra[inverted][:, [0, 2, 1, 3]]
        return replace(self, vertices=vertices, tetrahedra=tetrahedra)


def _division(parts: int) -> tuple[np.ndarray, np.ndarray]:
    """A tetrahedron cut into parts^3: weights of the points at its corners, shape [points, 4], and the cells.

    With corners at 0, (n, 0, 0), (n, n, 0), (n, n, n) these are the cells of the unit cubes' Kuhn triangulation.
    """
    lattice = {
        point: number
        for number, point in enumerate(p for p in np.ndindex(*3 * [parts + 1]) if p[0] >= p[1] >= p[2])
    }
    cells = []
    for start in lattice:
        for axes in permutations(range(3)):
            path = [start]
            for axis in axes:
                path.append(tuple(x + (k == axis) for k, x in enumerate(path[-1])))
            if all(point in lattice for point in path):
                cells.append([lattice[point] for point in path])
    i, j, k = np.array(list(lattice)).T
    return np.stack([parts - i, i - j, j - k, k], axis=1), np.array(cells)


def object_names() -> tuple[str, ...]:
    """Names of our own objects, sorted."""
    return tuple(sorted(json.loads((MESHES / HASHES).read_text())))


def load_object(name: str, folder: Path = MESHES) -> SoftBody:
    """One of our own objects, its content compared with the hash it was published with.

    Raises:
        GeneratorError: there is no such object, its file is missing or is not what it was.
    """
    published = json.loads((folder / HASHES).read_text())
    if name not in published:
        raise GeneratorError(f'there is no object "{name}"; there are {", ".join(sorted(published))}')
    path = folder / f"{name}.npz"
    body = replace(_read_npz(path), name=name)
    if body.content_hash() != published[name]["sha256"]:
        raise GeneratorError(
            f"{path} is not the published mesh of {name}: its content does not have the SHA-256 of {HASHES}; "
            "install the package again, or give a mesh of your own with --mesh"
        )
    if cell_volumes(body.vertices, body.tetrahedra).min() <= 0:
        raise GeneratorError(f"{path}: a tetrahedron of {name} has no positive volume")
    return body


def write_object(body: SoftBody, path: Path) -> None:
    """Keeps a body so that `read_object` gives the very same one again, bit by bit.

    As .npz (what our own objects are kept in), or in a format of meshio's that stores float64, best .vtu.

    Raises:
        GeneratorError: meshio is missing or does not write this format.
        DatasetError: the operating system refuses (.npz).
    """
    if _is_npz(path):
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **body.arrays())  # type: ignore[arg-type]
        write_bytes_atomically(path, buffer.getvalue())
        return
    meshio = _optional("meshio", path)
    try:
        meshio.Mesh(body.vertices, [("tetra", body.tetrahedra)]).write(path)
    except (meshio.WriteError, KeyError, ValueError) as error:
        raise GeneratorError(f"{path} cannot be written: {error}; write .vtu or .npz") from error


def read_object(path: Path) -> SoftBody:
    """A user's own object, scaled so that its largest extent is 1, its centre of mass at the origin.

    A tetrahedral mesh (.npz by `write_object`, or .vtu, .vtk, .msh, ... by meshio) is used as it is: nodes are
    reordered, those of the surface first, and unused ones dropped; cells that are all inverted are turned. It is
    refused where slivers would make the simulation 25 times as long as that of our own objects. A
    closed surface (.stl, .obj, .ply, .off, .glb, or triangles in a format of meshio's) is remeshed to at most
    350 nodes and filled with tetrahedra. That is not deterministic: read a surface once, in one process, and
    keep the result with `write_object` where the same data are to be made again.

    Raises:
        GeneratorError: the file cannot be read, or what it holds is not one solid body of a usable size; the
            message says what is wrong and what to do.
    """
    if not path.is_file():
        raise GeneratorError(f"{path}: there is no such file; give a tetrahedral mesh or a closed surface")
    if _is_npz(path):
        stored = _read_npz(path)
        return _from_tetrahedra(path, stored.vertices, stored.tetrahedra)
    if path.suffix.lower() in SURFACE_FORMATS:
        return _from_surface(path, *_read_surface(path))
    vertices, cells = _read_cells(path)
    if "tetra" in cells:
        return _from_tetrahedra(path, vertices, cells["tetra"])
    return _from_surface(path, vertices, cells["triangle"])


def read_or_keep_object(path: Path, folder: Path) -> SoftBody:
    """`read_object`, but of a file that was read before, the body that was made of it then.

    It is kept in `folder` under the name of the file and a hash of its content, so that a dataset that is
    interrupted, or made again, has the same tetrahedra.

    Raises:
        GeneratorError: see `read_object`.
    """
    if _is_npz(path) or not path.is_file():
        return read_object(path)
    kept = folder / f"{path.stem}-{hashlib.sha256(path.read_bytes()).hexdigest()[:8]}.npz"
    if not kept.is_file():
        own = kept.with_stem(f".{kept.stem}-{secrets.token_hex(8)}")
        write_object(read_object(path), own)
        try:
            with suppress(FileExistsError):  # of two runs at once, the first to finish keeps it for both
                os.link(own, kept)
        finally:
            own.unlink()
    return replace(read_object(kept), name=path.stem)


def _optional(library: str, path: Path) -> Any:
    """An optional library, imported for the sake of this file."""
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise GeneratorError(f"{path} needs {library}: pip install 'm3gn-bench[mesh]'") from error


def _is_npz(path: Path) -> bool:
    return path.suffix.lower() == ".npz"


def _read_npz(path: Path) -> SoftBody:
    try:
        with np.load(path, allow_pickle=False) as stored, np.errstate(invalid="ignore"):
            tetrahedra = stored["tetrahedra"].astype(np.int32)
            if tetrahedra.shape[1:] != (4,) or (tetrahedra != stored["tetrahedra"]).any():
                raise ValueError(f"tetrahedra of shape {tetrahedra.shape} are not four numbers of nodes each")
            vertices = stored["vertices"].astype(np.float64)
            return SoftBody(path.stem, vertices, tetrahedra, int(stored["surface_nodes"]))
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise GeneratorError(f"{path} is damaged, or no mesh that write_object wrote: {error}") from error


def _read_surface(path: Path) -> tuple[Floats, Indices]:
    trimesh = _optional("trimesh", path)
    mesh = _parsed(path, lambda: trimesh.load_mesh(path, process=False))
    triangles = getattr(mesh, "faces", None)
    if triangles is None or not len(triangles):
        raise GeneratorError(f"{path} holds no triangles; export it as a surface mesh, not as a point cloud")
    return np.asarray(mesh.vertices, np.float64), np.asarray(triangles, np.int32)


def _read_cells(path: Path) -> tuple[Floats, dict[str, Indices]]:
    """Vertices, and the cells by kind, among them tetrahedra or triangles."""
    meshio = _optional("meshio", path)
    mesh = _parsed(path, lambda: meshio.read(path))
    cells = {kind: np.asarray(block, np.int32) for kind, block in mesh.cells_dict.items() if len(block)}
    foreign = cells.keys() - {"vertex", "line", "triangle", "tetra"}
    if foreign:
        raise GeneratorError(
            f"{path} holds cells of kind {', '.join(sorted(foreign))}; export linear tetrahedra or triangles only"
        )
    if not cells.keys() & {"tetra", "triangle"}:
        raise GeneratorError(f"{path} holds neither tetrahedra nor triangles; export the mesh with its cells")
    return np.asarray(mesh.points, np.float64), cells


def _parsed(path: Path, read: Callable[[], Any]) -> Any:
    """What another library makes of the file. Whatever it raises means that it cannot; meshio prints and exits."""
    printed = io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            return read()
    except (Exception, SystemExit) as error:
        reason = " ".join(printed.getvalue().split()) if isinstance(error, SystemExit) else str(error)
        raise GeneratorError(
            f"{path} cannot be read: {reason or type(error).__name__}; is the file whole, and does its name end as "
            "its format wants?"
        ) from error


def _require_finite(path: Path, vertices: Floats) -> None:
    broken = ~np.isfinite(vertices).all(1)
    if broken.any():
        raise GeneratorError(
            f"{path}: {broken.sum()} of {len(vertices)} nodes have coordinates that are not finite (the first "
            f"is node {broken.argmax()}); export the mesh again"
        )


def _require_shape(path: Path, vertices: Floats, cells: Indices, kind: str) -> None:
    """Finite three-dimensional nodes of some extent, and cells that refer to them."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise GeneratorError(f"{path}: nodes must have three coordinates, not shape {vertices.shape}")
    if not len(cells):
        raise GeneratorError(f"{path} holds no {kind}")
    if cells.min() < 0 or cells.max() >= len(vertices):
        raise GeneratorError(
            f"{path}: {kind} refer to node {cells.max() if cells.min() >= 0 else cells.min()}, but there are "
            f"{len(vertices)} nodes; the file is damaged"
        )
    _require_finite(path, vertices)
    extents = np.ptp(vertices[np.unique(cells)], axis=0)
    if extents.min() <= SMALLEST_EXTENT * extents.max():
        raise GeneratorError(
            f"{path} is flat: it extends over {' x '.join(f'{extent:.3g}' for extent in extents)}; a soft body "
            "needs an extent in every direction"
        )


def _require_stable_step(path: Path, step: float, advice: str) -> None:
    """A user's object whose simulation takes not unreasonably longer than that of our own."""
    if step < SMALLEST_STEP:
        raise GeneratorError(
            f"{path}: its worst tetrahedron allows the solver steps of {step:.1g} s only, which are about "
            f"{OWN_SUBSTEPS * OWN_STEP / step:.0f} per frame, while our own objects need {OWN_SUBSTEPS}; {advice}"
        )


def _from_tetrahedra(path: Path, vertices: Floats, tetrahedra: Indices) -> SoftBody:
    """The body of a user's tetrahedral mesh, checked."""
    _require_shape(path, vertices, tetrahedra, "tetrahedra")
    volumes = cell_volumes(vertices, tetrahedra)
    if (volumes < 0).all():  # some programs count the corners the other way round
        tetrahedra, volumes = tetrahedra[:, [0, 2, 1, 3]], -volumes
    flat = volumes <= SMALLEST_CELL * np.ptp(vertices[np.unique(tetrahedra)], axis=0).max() ** 3
    if flat.any():
        raise GeneratorError(
            f"{path}: {flat.sum()} of {len(tetrahedra)} tetrahedra are flat or inverted (the first is cell "
            f"{flat.argmax()}), while others are not; mesh the object again, or give its surface as .stl"
        )
    parts = component_count(tetrahedra)
    if parts > 1:
        raise GeneratorError(
            f"{path} holds {parts} parts that share no triangle; give one connected body, and merge nodes at "
            "the same place"
        )
    surface = boundary_triangles(tetrahedra)
    if not (is_closed(surface) and is_consistently_wound(surface)):
        raise GeneratorError(
            f"{path}: tetrahedra overlap or touch in an edge only; mesh the object again, or give its surface "
            "as .stl"
        )
    vertices, tetrahedra, surface_nodes = surface_nodes_first(vertices, tetrahedra)
    if surface_nodes > MAX_SURFACE_NODES:
        raise GeneratorError(
            f"{path} has {surface_nodes} surface nodes, at most {MAX_SURFACE_NODES} are allowed; mesh it more "
            "coarsely, or give its surface as .stl, which is then done for you"
        )
    vertices = normalised(vertices, tetrahedra)
    _require_stable_step(
        path,
        reference_step(vertices, tetrahedra),
        "mesh it more evenly, without slivers and thin walls, or give its surface as .stl, which is then done for you",
    )
    return SoftBody(path.stem, vertices, tetrahedra, surface_nodes)


def _from_surface(path: Path, vertices: Floats, triangles: Indices) -> SoftBody:
    """The body inside a user's surface, checked, remeshed and filled with tetrahedra."""
    _require_shape(path, vertices, triangles, "triangles")
    vertices, triangles = _merged(vertices, triangles)
    if not is_closed(triangles):
        raise GeneratorError(
            f"{path}: the surface is not closed (some edges do not belong to exactly two triangles); fill the "
            "holes, e.g. with the 3D-print tools of Blender"
        )
    parts = component_count(triangles)
    if parts > 1:
        raise GeneratorError(f"{path} holds {parts} separate surfaces; unite them, or keep only one")
    if not is_consistently_wound(triangles):
        raise GeneratorError(
            f"{path}: some triangles face inwards and others outwards; recalculate the normals and export again"
        )
    volume = enclosed_volume(vertices, triangles)
    if volume < 0:
        triangles = triangles[:, ::-1].copy()
    if abs(volume) <= SMALLEST_VOLUME:
        raise GeneratorError(f"{path}: the surface encloses no volume; give the surface of a solid body")
    for library in ("pyvista", "pyacvd", "pytetwild"):
        _optional(library, path)
    from m3gn_bench.generators.meshes.remeshing import candidates, recipes

    usable = [
        candidate
        for candidate in candidates(vertices, triangles, recipes(SURFACE_NODES, [EDGE_FACTOR], [ENVELOPE]))
        if candidate.surface_nodes <= MAX_SURFACE_NODES
    ]
    if not usable:
        raise GeneratorError(
            f"{path}: its shape does not survive at {MAX_SURFACE_NODES} surface nodes; thicken thin walls and "
            "remove what is finer than about a twentieth of its size, or give a tetrahedral mesh"
        )
    best = max(usable, key=lambda candidate: candidate.stable_step)
    _require_stable_step(path, best.stable_step, "thicken thin walls and blunt sharp edges")
    return SoftBody(path.stem, best.vertices, best.tetrahedra, best.surface_nodes)


def _merged(vertices: Floats, triangles: Indices) -> tuple[Floats, Indices]:
    """The surface with one node at each place, in units of its extent, without unused nodes and without
    triangles that are but an edge: a file of separate triangles becomes a surface."""
    corners = vertices[triangles].reshape(-1, 3)
    corners = (corners - corners.min(0)) / np.ptp(corners, axis=0).max()
    _, first, places = np.unique(
        np.round(corners / SAME_PLACE), axis=0, return_index=True, return_inverse=True
    )
    merged = places.reshape(-1, 3).astype(np.int32)
    ordered = np.sort(merged, axis=1)
    return corners[first], merged[(ordered[:, 1:] != ordered[:, :-1]).all(1)]
