"""Plain facts about tetrahedral meshes: volumes, surface, topology, angles, and the largest stable time step."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from m3gn_bench.generators.solvers.tetrahedra import TetrahedralSolid

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]

ROUND_OFF = 1e-12
# The facet opposite each corner of a tetrahedron of positive volume, counterclockwise seen from outside.
OUTWARD_FACETS = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def cell_volumes(vertices: Floats, tetrahedra: ArrayLike) -> Floats:
    """Signed volumes, shape [cells]: positive where corner 3 sees the corners 0, 1, 2 counterclockwise."""
    corners = vertices[np.asarray(tetrahedra)]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def enclosed_volume(vertices: Floats, triangles: ArrayLike) -> float:
    """Volume inside a closed surface by the divergence theorem; negative where triangles face inwards."""
    corners = vertices[np.asarray(triangles)]
    return float(np.linalg.det(corners).sum() / 6)


def boundary_triangles(tetrahedra: Indices) -> Indices:
    """Facets that belong to one tetrahedron only, facing outwards, in the order of their cells; [triangles, 3].

    Every tetrahedron must have a positive volume.
    """
    facets = tetrahedra[:, OUTWARD_FACETS].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True)
    return facets[np.sort(first[counts == 1])]


def centre_of_mass(vertices: Floats, tetrahedra: Indices) -> Floats:
    """Centre of a body of even density, shape [3]."""
    return np.average(vertices[tetrahedra].mean(1), axis=0, weights=cell_volumes(vertices, tetrahedra))


def smallest_dihedral_angle(vertices: Floats, tetrahedra: Indices) -> float:
    """Smallest angle between two facets of one tetrahedron [degrees]."""
    corners = vertices[tetrahedra][:, OUTWARD_FACETS]
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    first, second = np.triu_indices(4, 1)
    cosines = -(normals[:, first] * normals[:, second]).sum(-1)
    return float(np.degrees(np.arccos(np.clip(cosines.max(), -1, 1))))


def edge_uses(triangles: Indices) -> tuple[Indices, Indices]:
    """Undirected edges [edges, 2] and the number of triangles at each [edges]."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique, counts.astype(np.int32)


def is_closed(triangles: Indices) -> bool:
    """Whether every edge belongs to exactly two triangles."""
    return bool((edge_uses(triangles)[1] == 2).all())


def is_consistently_wound(triangles: Indices) -> bool:
    """Whether neighbouring triangles run through their common edge in opposite directions."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return len(np.unique(edges, axis=0)) == len(edges)


def euler_characteristic(triangles: Indices) -> int:
    """Vertices - edges + triangles: 2 for a closed connected surface without handles."""
    return len(np.unique(triangles)) - len(edge_uses(triangles)[0]) + len(triangles)


def component_count(cells: Indices) -> int:
    """Number of parts that share no facet: an edge for triangles [cells, 3], a triangle for tetrahedra.

    Cells that meet in less than a facet only would hang together like a hinge.
    """
    corners = cells.shape[1]
    facets = np.sort(np.concatenate([np.delete(cells, corner, axis=1) for corner in range(corners)]), axis=1)
    _, facet = np.unique(facets, axis=0, return_inverse=True)
    owner = np.tile(np.arange(len(cells)), corners)
    links = coo_array((np.ones(len(owner)), (owner, facet.ravel())))
    return int(connected_components(links @ links.T, directed=False, return_labels=False))


def surface_nodes_first(vertices: Floats, tetrahedra: Indices) -> tuple[Floats, Indices, int]:
    """The mesh without unused nodes, those of the surface before those inside, and the number of the former."""
    surface = np.unique(boundary_triangles(tetrahedra))
    kept = np.concatenate([surface, np.setdiff1d(tetrahedra, surface)])
    place = np.full(len(vertices), -1, np.int32)
    place[kept] = np.arange(len(kept))
    return vertices[kept], place[tetrahedra], len(surface)


def normalised(vertices: Floats, tetrahedra: Indices) -> Floats:
    """Vertices with the centre of mass at the origin and a largest extent of 1; a fixed point of itself."""
    centre = centre_of_mass(vertices, tetrahedra)
    extent = np.ptp(vertices, axis=0).max()
    if np.abs(centre).max() < ROUND_OFF and abs(extent - 1) < ROUND_OFF:
        return vertices
    return (vertices - centre) / extent


def reference_step(vertices: Floats, tetrahedra: Indices) -> float:
    """2 / omega_max [s], beyond which undamped central differences diverge, of an object of size 1 scaled to
    0.5 m, E = 1 MPa, nu = 0.3, 1000 kg/m^3."""
    body = TetrahedralSolid(
        0.5 * vertices,
        tetrahedra,
        density=1000.0,
        youngs_modulus=1e6,
        poisson_ratio=0.3,
        element="nodal pressure",
    )
    return 2 / body.highest_frequency
