"""Plain facts about tetrahedral meshes: volumes, surface, topology, angles, and the largest stable time step."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigsh

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


def stable_time_step(
    vertices: Floats,
    tetrahedra: Indices,
    *,
    youngs_modulus: float,
    poisson_ratio: float,
    density: float,
) -> float:
    """2 / omega_max [s] of the body at rest: beyond it, undamped central differences diverge.

    Linear tetrahedra whose pressure is averaged over the nodes, lumped masses. omega_max^2 is the largest
    eigenvalue of M^-1/2 K M^-1/2, which is applied cell by cell and never assembled.

    Args:
        vertices: [m], shape [nodes, 3].
        tetrahedra: positive volumes, shape [cells, 4].
        youngs_modulus: [Pa].
        poisson_ratio: below 0.5.
        density: [kg/m^3].
    """
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    lame = youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    nodes, corners = len(vertices), tetrahedra.ravel()
    edges = vertices[tetrahedra[:, 1:]] - vertices[tetrahedra[:, :1]]
    volumes = np.linalg.det(edges) / 6
    gradients = np.empty((len(tetrahedra), 4, 3))
    gradients[:, 1:] = np.linalg.inv(edges).transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(1)
    nodal_volumes = np.bincount(corners, np.repeat(volumes / 4, 4), nodes)
    root_masses = np.sqrt(density * nodal_volumes)[:, None]

    def scaled_stiffness(flat: Floats) -> Floats:
        displacements = flat.reshape(nodes, 3) / root_masses
        slope = np.einsum("cai,caj->cij", displacements[tetrahedra], gradients)
        divergence = np.trace(slope, axis1=1, axis2=2)
        nodal = np.bincount(corners, np.repeat(volumes * divergence / 4, 4), nodes) / nodal_volumes
        stress = mu * (slope + slope.transpose(0, 2, 1))
        stress[:, [0, 1, 2], [0, 1, 2]] += lame * nodal[tetrahedra].mean(1)[:, None]
        forces = np.einsum("cij,caj->cai", stress * volumes[:, None, None], gradients).reshape(-1, 3)
        gathered = np.stack([np.bincount(corners, forces[:, axis], nodes) for axis in range(3)], 1)
        return (gathered / root_masses).ravel()

    operator = LinearOperator((3 * nodes, 3 * nodes), matvec=scaled_stiffness, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=3 * nodes)
    largest = eigsh(operator, k=1, which="LA", v0=start, tol=1e-6, return_eigenvectors=False)
    return float(2 / np.sqrt(largest[0]))
