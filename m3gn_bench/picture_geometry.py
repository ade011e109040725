"""The geometry of pictures: surfaces of meshes, their lines, and how points are projected onto the paper."""

import math

import numpy as np
from numpy.typing import NDArray

from m3gn_bench.datasets.trajectory import VTK_TRIANGLE, Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int32]


def surface(mesh: Mesh) -> Indices:
    """Triangles that can be seen: all of them, or the faces that belong to one tetrahedron only, [faces, 3]."""
    if mesh.cell_type == VTK_TRIANGLE:
        return mesh.cells
    faces = mesh.cells[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[counts == 1])]


def _edges(faces: Indices) -> Indices:
    """The three edges of every triangle, one triangle after the other, shape [3 faces, 2]."""
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)


def wireframe(faces: Indices) -> Indices:
    """All edges of triangles, each once, shape [edges, 2]."""
    return np.unique(_edges(faces), axis=0)


def outline(faces: Indices) -> Indices:
    """Edges that belong to one triangle only, shape [edges, 2]; empty for a closed surface."""
    unique, counts = np.unique(_edges(faces), axis=0, return_counts=True)
    return unique[counts == 1]


def silhouette(faces: Indices, facing: NDArray[np.bool_]) -> Indices:
    """Edges between triangles that face the camera and others, shape [edges, 2].

    Args:
        faces: of a closed surface, shape [faces, 3].
        facing: which of them face the camera, shape [faces].
    """
    unique, number, counts = np.unique(_edges(faces), axis=0, return_inverse=True, return_counts=True)
    towards = np.bincount(number.ravel(), np.repeat(facing, 3), len(unique))
    return unique[(towards > 0) & (towards < counts)]


def rings(edges: Indices) -> list[list[int]]:
    """The closed lines that the edges form, each as a list of nodes; [] where an edge is part of none."""
    neighbours: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    if any(len(others) != 2 for others in neighbours.values()):
        return []
    found = []
    while neighbours:
        ring = [min(neighbours)]
        while further := [node for node in sorted(neighbours.pop(ring[-1])) if node in neighbours]:
            ring.append(further[0])
        found.append(ring)
    return found


def triangle_areas(positions: Array, faces: Indices) -> Array:
    """Areas of triangles in two or three dimensions, shape [..., faces]."""
    corners = positions[..., faces, :]
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    gram = (a * a).sum(-1) * (b * b).sum(-1) - (a * b).sum(-1) ** 2
    return 0.5 * np.sqrt(np.maximum(gram, 0))


def round_length(length: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(digit for digit in (1, 2, 5) if digit * power <= length * (1 + 1e-9))


class Camera:
    """An orthographic projection; in two dimensions the identity."""

    def __init__(self, dimension: int, azimuth: float, elevation: float) -> None:
        a, e = math.radians(azimuth), math.radians(elevation)
        self.flat = dimension == 2
        self.axes = np.array(  # right, up, towards the camera
            [
                [-math.sin(a), math.cos(a), 0],
                [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)],
                [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)],
            ]
        )

    def __call__(self, points: Array) -> Array:
        """Coordinates to the right and upwards, shape [..., 2]."""
        return points if self.flat else points @ self.axes[:2].T

    def in_space(self, points: Array) -> Array:
        """Coordinates to the right, upwards and towards the camera, shape [..., 3]."""
        return points @ self.axes.T

    def normals_and_depths(self, positions: Array, faces: Indices) -> tuple[Array, Array]:
        """In the camera's axes, of triangles in space: unit normals, and how near they are.

        Normals point outwards where the surface is closed.
        """
        corners = self.in_space(positions)[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume = (normals * (corners[:, 0] - corners.mean((0, 1)))).sum()
        lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        return (-1 if volume < 0 else 1) * normals / lengths, corners[..., 2].mean(1)
