"""From a closed surface to tetrahedra: even clusters of its area (pyacvd), then fTetWild (pytetwild).

Both libraries are optional and imported where they are used. Clustering is deterministic, fTetWild is not, not
even on one thread: the same surface gives another mesh of the same quality each time. So a mesh is made once,
chosen among several, and kept as data. Sources: Valette, Chassery and Prost, "Generic remeshing of 3D
triangular meshes with metric-dependent discrete Voronoi diagrams", 2008; Hu et al., "Fast tetrahedral meshing
in the wild", 2020.
"""

import itertools
import warnings
from collections.abc import Iterable, Iterator
from contextlib import chdir
from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np

from m3gn_bench.generators.meshes.geometry import (
    Floats,
    Indices,
    boundary_triangles,
    cell_volumes,
    component_count,
    edge_uses,
    enclosed_volume,
    euler_characteristic,
    is_closed,
    normalised,
    reference_step,
    surface_nodes_first,
)

POINTS_PER_CLUSTER = 30  # of the surface that is clustered; below, the clusters are ragged
VOLUME_TOLERANCE = 0.15  # relative; flat triangles inside curved surfaces lose 2 % to 8 %
CENTROID_PULL = 0.02  # over the weight of the planes
STOP_ENERGY = 8.0  # of fTetWild: mean shape energy of the cells at which it stops improving


@dataclass(frozen=True)
class Recipe:
    """How a mesh is made: number of surface nodes to aim at, edge length of the tetrahedra over the mean edge
    of that surface, and fTetWild's envelope over the diagonal of the bounding box."""

    surface_nodes: int
    edge_factor: float
    envelope: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """A mesh whose surface nodes come first, centred, of largest extent 1, and its stable step [s]
    (see `reference_step`)."""

    recipe: Recipe
    vertices: Floats
    tetrahedra: Indices
    surface_nodes: int
    stable_step: float


def recipes(
    surface_nodes: Iterable[int], edge_factors: Iterable[float], envelopes: Iterable[float]
) -> list[Recipe]:
    """All combinations."""
    return [Recipe(*values) for values in itertools.product(surface_nodes, edge_factors, envelopes)]


def cluster_surface(vertices: Floats, triangles: Indices, nodes: int) -> tuple[Floats, Indices]:
    """A closed surface with evenly spread nodes, about as many as asked, that keeps edges and creases.

    Every cluster of the surface's area becomes a node, placed where the planes of its triangles come closest
    together: on an edge or a corner where the cluster has one, and a little outside of a curved surface, so that
    the volume is kept. Source of the placement: Garland and Heckbert, "Surface simplification using quadric
    error metrics", 1997.
    """
    import pyvista
    from pyacvd import Clustering

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd calls what pyvista has deprecated
        clustering = Clustering(pyvista.PolyData.from_regular_faces(vertices, triangles.astype(int)))
        while clustering.mesh.n_points < POINTS_PER_CLUSTER * nodes:
            clustering.subdivide(1)
        clusters = np.asarray(clustering.cluster(nodes))
        surface = clustering.create_mesh(moveclus=False, clean=False)
    fine = np.asarray(clustering.mesh.points, np.float64)
    facets = np.asarray(clustering.mesh.regular_faces)
    centroids = np.asarray(surface.points, np.float64)
    placed = _meeting_points(fine[facets], clusters[facets], centroids)
    return placed, np.asarray(surface.regular_faces, np.int32)


def _meeting_points(corners: Floats, clusters: Indices, centroids: Floats) -> Floats:
    """For each cluster the point closest to the planes of its triangles (area-weighted least squares), drawn
    weakly to the centroid, which decides where the planes do not, shape [clusters, 3].

    Args:
        corners: of the triangles, shape [triangles, 3, 3].
        clusters: of these corners; a triangle counts by a third for each, shape [triangles, 3].
        centroids: of the clusters, shape [clusters, 3].
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(areas, np.finfo(float).tiny)[:, None]
    planes = np.einsum("t,ti,tj->tij", areas, normals, normals)
    centres = corners.mean(1)
    quadrics = np.zeros((len(centroids), 3, 3))
    moments = np.zeros((len(centroids), 3))
    for corner in range(3):
        owner = clusters[:, corner]
        np.add.at(quadrics, owner, planes)
        np.add.at(moments, owner, np.einsum("tij,tj->ti", planes, centres - centroids[owner]))
    pull = CENTROID_PULL * np.trace(quadrics, axis1=1, axis2=2)
    quadrics[:, [0, 1, 2], [0, 1, 2]] += pull[:, None]
    return centroids + np.linalg.solve(quadrics, moments[..., None])[..., 0]


def tetrahedralise(
    vertices: Floats, triangles: Indices, *, edge_length: float, envelope: float
) -> tuple[Floats, Indices]:
    """The inside of a closed surface as tetrahedra of positive volume. Another mesh at every call."""
    from pytetwild import tetrahedralize

    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    with TemporaryDirectory() as scratch, chdir(scratch):  # fTetWild leaves a file where it runs
        nodes, cells = tetrahedralize(
            vertices,
            triangles,
            edge_length_fac=edge_length / diagonal,
            epsilon=envelope,
            stop_energy=STOP_ENERGY,
            num_threads=1,
        )
    nodes, cells = np.asarray(nodes, np.float64), np.asarray(cells, np.int32)
    inverted = cell_volumes(nodes, cells) < 0  # fTetWild counts the corners the other way round
    cells[inverted] = cells[inverted][:, [0, 2, 1, 3]]
    return nodes, cells


def candidates(vertices: Floats, triangles: Indices, sweep: Iterable[Recipe]) -> Iterator[Candidate]:
    """One mesh per recipe, without those that differ from the surface in topology or, by more than 15 %, in
    volume. The surface is closed, connected and faces outwards."""
    euler, volume = euler_characteristic(triangles), enclosed_volume(vertices, triangles)

    def alike(nodes: Floats, surface: Indices) -> bool:
        return (
            is_closed(surface)
            and euler_characteristic(surface) == euler
            and abs(enclosed_volume(nodes, surface) / volume - 1) < VOLUME_TOLERANCE
        )

    for recipe in sweep:
        coarse, facets = cluster_surface(vertices, triangles, recipe.surface_nodes)
        if not alike(coarse, facets):  # fTetWild would take minutes to repair what is lost anyway
            continue
        edges, _ = edge_uses(facets)
        mean_edge = np.linalg.norm(coarse[edges[:, 0]] - coarse[edges[:, 1]], axis=1).mean()
        nodes, cells = tetrahedralise(
            coarse, facets, edge_length=recipe.edge_factor * mean_edge, envelope=recipe.envelope
        )
        if not len(cells) or cell_volumes(nodes, cells).min() <= 0:
            continue
        if component_count(cells) == 1 and alike(nodes, boundary_triangles(cells)):
            nodes, cells, surface_nodes = surface_nodes_first(nodes, cells)
            nodes = normalised(nodes, cells)
            yield Candidate(recipe, nodes, cells, surface_nodes, reference_step(nodes, cells))
